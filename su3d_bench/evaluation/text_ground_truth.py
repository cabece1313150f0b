"""Ground truth in text files: class ids, class id * 1000 + instance, or object numbers only.

ScanNet's scripts read a file as class ids or as class id * 1000 + instance, depending on the evaluation; OpenSUN3D's
files have object numbers only. The values decide only if a single reading is possible.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from su3d_bench.core import registry
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, converted, printable, reading, shown
from su3d_bench.core.maps import Prediction
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float32Array, GroundTruth, Int64Array, LabelSet
from su3d_bench.evaluation.ground_truth import (
    LARGEST_VALUE,
    NOT_INTENDED,
    SceneTruths,
    VertexTruth,
    choose_scenes,
    dataset_of_names,
    no_queries_reason,
)
from su3d_bench.evaluation.result import Request, ValuesForm
from su3d_bench.evaluation.scoring import map_of
from su3d_bench.formats.arrays import MAX_POINTS, integer_lines
from su3d_bench.metrics.compatibility import ID_LISTS, LARGEST_NYU40_ID, TruthFacts, list_of_ids, truth_incompatibility
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS, values_of_numbers
from su3d_bench.metrics.instance.score import OBJECT
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.predictions.base import scene_files
from su3d_bench.predictions.formats import Source, match_scenes
from su3d_bench.predictions.run_predictions import OWN_RUNS, read_stored
from su3d_bench.questions.query_files import VARIANT as QUERY_OBJECTS
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.records import TruthRecord

LARGEST_LABEL = 1357  # of scannetv2-labels.combined.tsv, the longest known list of classes
FORMS: dict[ValuesForm, str] = {
    "classes": "class ids only",
    "instances": "class id * 1000 + instance",
    "numbers": "object numbers only",
}
BEYOND = (OBJECT + 1) * INSTANCES_PER_CLASS  # values of the label 2: no object if values are object numbers
FLAG = "--ground-truth-values"


@dataclass(frozen=True)
class TruthValues:
    """The range of the nonzero values of all scenes, 0 and 0 without any; ``stated``: their configured form."""

    lowest: int
    highest: int
    stated: ValuesForm | None

    @classmethod
    def of(cls, scenes: Iterable[Int64Array], stated: ValuesForm | None) -> TruthValues:
        annotated = [values[values > 0] for values in scenes if values.any()]
        lowest = min((int(values.min()) for values in annotated), default=0)
        return cls(lowest, max((int(values.max()) for values in annotated), default=0), stated)

    def form(self, rules: ProtocolRules) -> ValuesForm | None:
        """The form of the values under a protocol; None if it is ambiguous and not configured.

        From 1000 to the largest class id they may be instances of class 1. Then values below 1000 indicate class ids if
        a protocol needs no instances, because as instances they would have no class.
        """
        if self.stated is not None:
            return self.stated
        if rules.class_agnostic == "numbered":
            return "numbers"
        if self.highest < INSTANCES_PER_CLASS:
            return "classes"
        if self.highest > max([LARGEST_LABEL, *(entry.id for entry in rules.classes)]):
            return "instances"
        return None if rules.needs_instances or self.lowest >= INSTANCES_PER_CLASS else "classes"

    def incompatibility(self, rules: ProtocolRules) -> str | None:
        """Why a protocol cannot score against these values; None if it can."""
        form, values = self.form(rules), f"the values of the ground truth, {self.lowest} to {self.highest},"
        if form is None:
            return (
                f"{values} may be {FORMS['classes']}, or {FORMS['instances']} of class 1; choose with {FLAG} "
                "classes or instances (numbers: object numbers only)"
            )
        if form == "numbers" and (rules.class_agnostic in {None, "scored"}):
            return f"needs classes, and {values} are {FORMS['numbers']}"
        if form != "classes" or not rules.needs_instances:
            return None
        if not self.highest:
            return "needs instances, and every value of the ground truth is 0: nothing is annotated"
        are = f"are configured as {FORMS['classes']}" if self.stated else f"are {FORMS['classes']}"
        return (
            f"needs instances, and {values} {are}: {FORMS['instances']} is never below 1000; if they are "
            f"{FORMS['numbers']}, use {FLAG} numbers"
        )

    def doubts(self, rules: ProtocolRules) -> tuple[str, ...]:
        """Reasons to doubt that the labels are those of a protocol."""
        if self.form(rules) == "numbers":
            line = f"values of the ground truth from {BEYOND} up are background, as in OpenSUN3D's script"
            return (line,) if self.highest >= BEYOND else ()
        largest = self.largest_label(rules)
        if rules.ground_truth == "nyu40-vertices" and largest > LARGEST_NYU40_ID:
            return (
                f"the ground truth has the label {largest}, NYU40 ends at {LARGEST_NYU40_ID}: are these raw ids "
                "of ScanNet200? points of other classes are void",
            )
        if rules.ground_truth == "scannet200-vertices" and largest <= LARGEST_NYU40_ID:
            return (f"the largest label of the ground truth is {largest}: are these NYU40 ids?",)
        return ()

    def largest_label(self, rules: ProtocolRules) -> int:
        """The largest class id among the values."""
        return self.highest // INSTANCES_PER_CLASS if self.form(rules) == "instances" else self.highest

    def read(self, values: Int64Array, rules: ProtocolRules) -> tuple[Int64Array, Int64Array]:
        """The values (N,) of a scene as a protocol scores them, and the label (N,) of each point, 0 for none.

        Object numbers become 1001, 1002, ... in ascending order, as do all instances under a protocol that uses only
        object numbers.
        """
        form = self.form(rules)
        if form == "classes":
            return values, values
        if form == "numbers":
            values = values_of_numbers(values)
        if form == "numbers" or rules.class_agnostic == "numbered":
            is_object = values >= INSTANCES_PER_CLASS
            number = np.unique(values[is_object], return_inverse=True)[1]
            values = np.zeros(len(values), np.int64)
            values[is_object] = OBJECT * INSTANCES_PER_CLASS + 1 + number
        return values, values // INSTANCES_PER_CLASS


class TextTruths(SceneTruths):
    """Labels of points without coordinates; the meaning of the values is configured, or inferred from all scenes."""

    has_points = False

    def __init__(self, request: Request, sources: Sequence[Source]) -> None:
        assert request.ground_truth is not None
        every_file = text_scenes(request.ground_truth)
        self.where = shown(request.ground_truth)
        chosen = choose_scenes(request.scenes, list(every_file), self.where) if request.scenes else list(every_file)
        self._files = {scene: every_file[scene] for scene in chosen}
        self.scenes = tuple(chosen)
        self.dataset_name = dataset_of_names(chosen)
        if request.dataset is not None:
            self.dataset_name = str(registry.load("dataset", request.dataset).name)
        left_out = set(every_file) - set(chosen)
        sources = [
            replace(source, scenes=tuple(name for name in source.scenes if name not in left_out)) for source in sources
        ]
        requested = chosen if request.scenes else ()
        self.matches, self.remarks = match_scenes(sources, chosen, self.dataset_name, self.where, requested)
        self._values = {match.scene: read_values(self._files[match.scene]) for match in self.matches}
        self._said = request.ground_truth_values
        self._path = request.ground_truth
        self._range = self._all = TruthValues.of(self._values.values(), self._said)
        if self.matches and self.dataset_name is None and not request.protocols:
            raise ConfigError(
                f"{self.where}: unknown label set; name the protocol with --protocol or the dataset with --dataset"
            )

    @property
    def record(self) -> TruthRecord:
        return TruthRecord(None, str(self._path), self._said)

    def digest(self, scene: str) -> str:
        return digest_file(self._files[scene])

    def incompatibility(self, rules: ProtocolRules, *, is_named: bool) -> str | None:
        if rules.ground_truth == QUERY_OBJECTS:
            return no_queries_reason(is_named=is_named)
        if rules.asks and not is_named:
            return f"{NOT_INTENDED} texts"
        if not is_named and (self.dataset_name not in rules.datasets or not rules.by_default):
            return f"{NOT_INTENDED} {self.dataset_name}"
        facts = TruthFacts(self.where, None, (), has_points=False)
        reason = truth_incompatibility(rules, facts) or self._range.incompatibility(rules)
        if reason is not None or is_named or rules.ground_truth not in ID_LISTS:
            return reason
        if self._range.form(rules) == "numbers":
            return None
        variant = list_of_ids(largest := self._range.largest_label(rules))
        if variant == rules.ground_truth:
            return None
        other = "; name the protocol if they are of its own list" if largest <= LARGEST_NYU40_ID else ""
        return f"the labels of the ground truth go up to {largest}, as {ID_LISTS[variant]}{other}"

    def of_scene(self, rules: ProtocolRules, scene: str) -> VertexTruth:
        if scene not in self._values:  # a missed scene: the doubts cover all scored scenes
            self._values |= {name: read_values(file) for name, file in self._files.items() if name not in self._values}
            self._all = TruthValues.of(self._values.values(), self._said)
        if self._all.form(rules) != self._range.form(rules):
            raise DataError(
                f"{self.where}: the values of scenes without a prediction go up to {self._all.highest}, those of the "
                f"others to {self._range.highest}; choose their form with {FLAG} classes, instances or numbers"
            )
        values, labels = self._range.read(self._values[scene], rules)
        return VertexTruth(values, labels, self._all.doubts(rules))


def text_scenes(folder: Path) -> dict[str, Path]:
    """Scene -> its file in a folder of ground truth."""
    if not folder.is_dir():
        raise DataError(f"{shown(folder)}: no such folder; give the one with <scene>.txt, one value per point")
    with converted(PredictionError, DataError):
        files = scene_files(folder, (".txt",))
    if odd := next((name for name in files if not name.isprintable()), None):
        raise DataError(f"{shown(folder)}: contains a file '{printable(odd, 80)}'; name files after scenes")
    if not files:
        raise DataError(f"{shown(folder)}: has no .txt file; expected <scene>.txt, one value per point")
    return files


def read_values(path: Path) -> Int64Array:
    """One value per point of a scene: a class id, or class id * 1000 + instance."""
    where = shown(path)
    with converted(PredictionError, DataError), reading(where, DataError):
        values = integer_lines(file_bytes(path), where).astype(np.int64)
    if not 0 < len(values) <= MAX_POINTS:
        raise DataError(f"{where}: has {len(values)} values; expected one per point of the scene")
    is_wrong = (values < 0) | (values > LARGEST_VALUE)
    if is_wrong.any():
        line = int(np.argmax(is_wrong))
        raise DataError(f"{where}:{line + 1}: {int(values[line])} is out of range; expected class id * 1000 + instance")
    return values


# ---- the ground truth and maps of a run, with point positions for error attribution
# Ground-truth files index points and have no coordinates. The indices state which mask lies on which object, so each
# point gets its own position, at least a metre from any other: the nearest point of a map is then the same point.

ROW = 256  # positions along an axis before the next row begins


class GroundTruthFiles:
    """The ground truth of a run that was scored against files, which must not have changed."""

    def __init__(self, run: FinishedRun) -> None:
        self._run = run

    def truth(self, scene: str, rules: ProtocolRules) -> GroundTruth:
        """The ground truth of a scene under a protocol, each point at its own position."""
        found = self._texts.of_scene(rules, scene.partition("/")[2])
        assert isinstance(found, VertexTruth)
        return _at_places(rules, found, scene)

    def prediction(self, scene: str, method: str, rules: ProtocolRules, n_points: int) -> Prediction:
        """The map of a method at the same positions."""
        return map_of(read_stored(self._run.folder.job(scene, method).prediction), places(n_points), rules)

    @cached_property
    def _texts(self) -> TextTruths:
        record, run = self._run.record.ground_truth, self._run
        if record is None or record.path is None or not Path(record.path).is_dir():
            raise DataError(
                f"{run.name}: its ground truth, {printable(str(record and record.path), 200)}, is missing; restore the "
                "folder, or evaluate again with --out"
            )
        folder = Path(record.path)
        files = text_scenes(folder)
        scenes = [scene.partition("/")[2] for scene in run.scenes]
        for address, scene in zip(run.scenes, scenes, strict=True):
            if scene not in files or digest_file(files[scene]) != run.record.data_digests.get(address):
                raise DataError(
                    f"{shown(folder)}: the ground truth of {printable(scene, 80)} is not the one of {run.name}; "
                    "evaluate again with --out"
                )
        stated: ValuesForm | None = next((form for form in FORMS if form == record.values), None)
        protocols = tuple(run.protocols)
        request = Request((run.folder.path,), ground_truth=folder, ground_truth_values=stated, protocols=protocols)
        return TextTruths(request, [Source(run.folder.path, OWN_RUNS, tuple(scenes))])


def places(n: int) -> Float32Array:
    """Positions (n, 3) at least a metre apart, always the same for the same n.

    >>> places(2).tolist()
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    number = np.arange(n)
    return np.stack([number % ROW, number // ROW % ROW, number // ROW**2], axis=1).astype(np.float32)


def _at_places(rules: ProtocolRules, truth: VertexTruth, scene: str) -> GroundTruth:
    """Instances keep their numbers if a protocol uses only these; otherwise they are numbered consecutively."""
    instance = truth.values % INSTANCES_PER_CLASS
    if rules.class_agnostic not in {"everything", "numbered"}:
        is_object = truth.values >= (1 if rules.void == "groups" else INSTANCES_PER_CLASS)
        distinct, number = np.unique(truth.values[is_object], return_inverse=True)
        if len(distinct) >= INSTANCES_PER_CLASS:
            raise ConfigError(f"{printable(scene, 100)}: has {len(distinct)} objects; at most 999 are supported")
        instance = np.zeros(len(truth.values), np.int64)
        instance[is_object] = number + 1
    ids = dict.fromkeys(entry.id for entry in rules.classes)
    name_of = {entry.id: entry.name for entry in rules.classes}
    return GroundTruth(
        points=places(len(truth.values)),
        semantic=truth.labels.astype(np.int32),
        instance=instance.astype(np.int32),
        labels=LabelSet(rules.label_space, tuple(ids), tuple(name_of[each] for each in ids)),
        variant=rules.ground_truth,
        source="files without coordinates",
    )
