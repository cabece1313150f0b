"""The ground truth of an evaluation: a dataset's, text files in the layout of ScanNet's benchmark, or OpenLex3D's.

Each kind opens its scenes, finds the prediction of each, and states which protocols are meant for it. What only
datasets need is imported when they are opened, so that scoring text files starts faster.
"""

from __future__ import annotations

import fnmatch
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, GroundTruthMissing, shown, suggest
from su3d_bench.core.interfaces import HasSurface, IsAligned, NamesCategories
from su3d_bench.core.registry import GROUND_TRUTH_FILES
from su3d_bench.core.types import Float32Array, GroundTruth, Int64Array
from su3d_bench.datasets.openlex3d.release import FACE_CORNERS, VISIBLE, OpenLexRelease
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.compatibility import TruthFacts, truth_incompatibility
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS
from su3d_bench.metrics.open_vocabulary.score import TextQuery
from su3d_bench.metrics.protocols.loading import headline_protocols
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import Truth
from su3d_bench.predictions.formats import Match, Source, is_known, match_scenes, planned_scenes
from su3d_bench.questions.query_files import VARIANT as QUERY_OBJECTS
from su3d_bench.questions.query_files import query_truth, read_query_file
from su3d_bench.questions.question_files import is_foreign, read_external_queries
from su3d_bench.runs.scenes import data_root
from su3d_bench.store.records import TruthRecord

NOT_INTENDED = "is not meant for"
LARGEST_VALUE = 10_000 * INSTANCES_PER_CLASS  # as in the instance metric


@dataclass(frozen=True)
class VertexTruth:
    """Ground truth of points without coordinates: ``values`` (N,) are class id * 1000 + instance, or class ids.

    ``doubts``: reasons to doubt that the labels are those of the protocol.
    """

    values: Int64Array
    labels: Int64Array
    doubts: tuple[str, ...]


class SceneTruths(ABC):
    """The ground truth of every scene of an evaluation, and the prediction of each that has one.

    ``where`` is its name in messages; ``has_points``: its points have coordinates; ``headlines``: the protocol that
    scores it by default, if declared.
    """

    has_points = True
    headlines: tuple[str, ...] = ()
    where: str
    dataset_name: str | None
    scenes: tuple[str, ...]
    matches: list[Match]
    remarks: list[str]

    @property
    @abstractmethod
    def record(self) -> TruthRecord:
        """The ground truth as recorded in a run."""

    @property
    def target(self) -> str:
        """The prefix of scene addresses in the settings of a run."""
        return self.dataset_name or GROUND_TRUTH_FILES

    def address(self, scene: str) -> str:
        """The address of the scene in a run."""
        return f"{self.dataset_name or GROUND_TRUTH_FILES}/{scene}"

    @abstractmethod
    def digest(self, scene: str) -> str:
        """A key of the data of a scene."""

    def add_queries(self, path: Path) -> None:
        """Also score the texts in a file, over the objects that they refer to."""
        raise ConfigError("evaluate: --queries needs the objects of a dataset; name one with --dataset")

    @abstractmethod
    def incompatibility(self, rules: ProtocolRules, *, is_named: bool) -> str | None:
        """Why no prediction can be scored under a protocol; None if one can."""

    @abstractmethod
    def of_scene(self, rules: ProtocolRules, scene: str) -> Truth | VertexTruth:
        """The ground truth of a scene for a protocol; ``GroundTruthMissing`` if there is none in its form."""


# ---- datasets


class DatasetTruths(SceneTruths):
    """Ground truth with coordinates, read on demand; that of one scene is cached."""

    def __init__(self, request: Request, sources: Sequence[Source]) -> None:
        self._target = request.dataset or _dataset_of(sources)
        self._dataset = open_dataset(self._target)
        self.headlines = headline_protocols(self._dataset)
        self.where = self.dataset_name = name = str(self._dataset.name)
        known = list(self._dataset.scenes())
        requested = choose_scenes(request.scenes, known, name) if _are_all(request.scenes, known) else []
        matches, self.remarks = match_scenes(sources, known, name, name, requested)
        matched = [match.scene for match in matches]
        if request.scenes:
            scenes = choose_scenes(request.scenes, list(dict.fromkeys([*known, *matched])), name)
        elif all(_is_of_one_scene(source.path) for source in sources):
            scenes = matched
        else:
            planned = planned_scenes(sources, name)
            scenes = [*dict.fromkeys([*matched, *(known if planned is None else planned)])]
        self.scenes = tuple(scenes)
        self.matches = [match for match in matches if match.scene in scenes]
        self._queries: Mapping[str, tuple[TextQuery, ...]] | None = None
        self._queries_digest: str | None = None
        self._kept: dict[tuple[str, str], GroundTruth] = {}

    @property
    def record(self) -> TruthRecord:
        return TruthRecord(self.dataset_name, None, queries=self._queries_digest)

    @property
    def target(self) -> str:
        return self._target

    def digest(self, scene: str) -> str:
        return str(self._dataset.digest(scene))

    def add_queries(self, path: Path) -> None:
        if not self._dataset.variants:
            super().add_queries(path)
        self._queries = read_external_queries(path) if is_foreign(path) else read_query_file(path)
        self._queries_digest = digest_file(path)

    def incompatibility(self, rules: ProtocolRules, *, is_named: bool) -> str | None:
        if rules.ground_truth == QUERY_OBJECTS:
            return no_queries_reason(is_named=is_named) if self._queries is None else None
        if not is_named and (self.dataset_name not in rules.datasets or not rules.by_default):
            return f"{NOT_INTENDED} {self.dataset_name} unless it is named"
        return truth_incompatibility(rules, TruthFacts.of_dataset(self._dataset))

    def of_scene(self, rules: ProtocolRules, scene: str) -> Truth:
        if rules.ground_truth != QUERY_OBJECTS:
            truth = self._truth(scene, rules.ground_truth)
            if not rules.asks:
                return truth
            from su3d_bench.questions.ground_truths import question_truth

            return question_truth(rules, self._dataset, scene, truth)
        assert self._queries is not None
        if scene not in self._queries:
            raise GroundTruthMissing(f"{self.where}/{scene}: the query file has no queries for this scene")
        truth = self._truth(scene, self._dataset.variants[0])
        dataset, where = self._dataset, f"{self.where}/{scene}"
        is_grouped = rules.kind == "grounding" and isinstance(dataset, NamesCategories)
        class_of = dataset.nyu40_class if is_grouped else None
        needs_axes = rules.box_axes == "aligned" and isinstance(dataset, IsAligned)
        alignment = dataset.axis_alignment(scene) if needs_axes else None
        return query_truth(truth, self._queries[scene], where, class_of, alignment)

    def vertices(self, scene: str, n: int | None) -> Float32Array:
        """The points (V, 3) of masks over ``n`` vertices: those of the ground truth, unless only the mesh has ``n``."""
        points = self._truth(scene, self._dataset.variants[0]).points
        if len(points) != n and isinstance(self._dataset, HasSurface):
            with suppress(DataError):  # no mesh
                vertices = self._dataset.surface(scene).vertices
                return vertices if len(vertices) == n else points
        return points

    def _truth(self, scene: str, variant: str) -> GroundTruth:
        if (scene, variant) not in self._kept:
            self._kept = {key: truth for key, truth in self._kept.items() if key[0] == scene}
            self._kept[scene, variant] = self._dataset.ground_truth(scene, variant)
        return self._kept[scene, variant]


def no_queries_reason(*, is_named: bool) -> str:
    return "needs --queries FILE" if is_named else f"{NOT_INTENDED} scenes without queries"


def _dataset_of(sources: Sequence[Source]) -> str:
    """The dataset prefix of the prediction names."""
    names = [name for source in sources for name in source.scenes]
    of_names = {name.partition("/")[0] for name in names if "/" in name}
    if len(of_names) == 1:
        return of_names.pop()
    hint = dataset_of_names(names)
    what = f"--dataset {hint}" if hint else "--dataset NAME"
    raise ConfigError(f"evaluate: no ground truth given; name it with {what} or --ground-truth DIR")


def open_dataset(name: str) -> Any:
    """The dataset called ``name`` with its default settings, in the data root."""

    dataset_class = registry.load("dataset", name)
    return dataset_class(data_root(), dataset_class.Options())


def _is_of_one_scene(path: Path) -> bool:
    """Whether a path has one scene only: a file, or the folder of one method and scene in a run."""
    return path.is_file() or (path / "prediction.npz").is_file()


def _are_all(words: Sequence[str], known: Sequence[str]) -> bool:
    """Whether every one of ``words`` names a listed scene, not one generated on demand."""
    return bool(words) and all(word.rpartition("/")[2] in known for word in words)


def choose_scenes(words: Sequence[str], known: Sequence[str], where: str) -> list[str]:
    """The scenes of ``known`` that match ``words``, names or patterns; a dataset before a slash is ignored."""
    chosen: dict[str, None] = {}
    for word in words:
        pattern = word.rpartition("/")[2]
        matching = [scene for scene in known if fnmatch.fnmatchcase(scene, pattern)]
        if not matching:
            hint = suggest(pattern, known)
            raise DataError(f"no scene of {where} matches '{word}'{hint}")
        chosen.update(dict.fromkeys(matching))
    return list(chosen)


def dataset_of_names(scenes: Iterable[str]) -> str | None:
    """The dataset whose scenes have such names; None if unknown.

    >>> dataset_of_names(["scene0011_00", "scene0011_01"]), dataset_of_names(["a"])
    ('scannet', None)
    """
    names = list(scenes)
    for dataset in registry.names("dataset"):
        form = getattr(registry.load("dataset", dataset), "scene_names", None)
        if form is not None and names and all(re.fullmatch(form, name) for name in names):
            return dataset
    return None


# ---- OpenLex3D


class OpenLexTruths(SceneTruths):
    """OpenLex3D's labels and queries of one dataset, whose own data are in the data root."""

    def __init__(self, request: Request, sources: Sequence[Source]) -> None:
        assert request.ground_truth is not None
        self._path, self.dataset_name = request.ground_truth, None
        self.where = shown(request.ground_truth)
        self._release = _labelled_release(request, sources)
        self._kept: dict[tuple[str, str], Truth] = {}
        known = self._release.scenes()
        self.scenes = tuple(choose_scenes(request.scenes, known, self.where)) if request.scenes else known
        requested = self.scenes if request.scenes else ()
        name = self._release.dataset
        is_named = any(scene.startswith(f"{name}/") for source in sources for scene in source.scenes)
        matches, self.remarks = match_scenes(sources, known, name if is_named else None, self.where, requested)
        self.matches = [match for match in matches if match.scene in self.scenes]

    @property
    def record(self) -> TruthRecord:
        return TruthRecord(None, str(self._path))

    def digest(self, scene: str) -> str:
        return self._release.digest(scene)

    def incompatibility(self, rules: ProtocolRules, *, is_named: bool) -> str | None:
        return None if rules.ground_truth in (VISIBLE, FACE_CORNERS) else f"{NOT_INTENDED} the labels of OpenLex3D"

    def of_scene(self, rules: ProtocolRules, scene: str) -> Truth:
        if (scene, rules.ground_truth) not in self._kept:
            self._kept = {key: truth for key, truth in self._kept.items() if key[0] == scene}
            self._kept[scene, rules.ground_truth] = self._release.truth(scene, rules.ground_truth)
        return self._kept[scene, rules.ground_truth]


def _labelled_release(request: Request, sources: Sequence[Source]) -> OpenLexRelease:
    """The labels of the named dataset, otherwise of the only one that the scenes or the predictions fit."""
    assert request.ground_truth is not None
    where, folder = shown(request.ground_truth), request.ground_truth
    each = {name: OpenLexRelease(folder, data_root(), name) for name in OpenLexRelease.datasets_at(folder)}
    if request.dataset is not None:
        if request.dataset not in each:
            hint = suggest(request.dataset, each)
            raise ConfigError(f"{where}: has no labels for '{request.dataset}', only for {', '.join(each)}{hint}")
        return each[request.dataset]
    if len(each) == 1:
        return next(iter(each.values()))
    asked = request.scenes or [scene for source in sources for scene in source.scenes]
    fitting = [
        name
        for name, release in each.items()
        if any(one.partition("/")[0] == name or _names_one(one, release.scenes()) for one in asked)
    ]
    if len(fitting) != 1:
        raise ConfigError(f"{where}: has labels for {', '.join(each)}; choose one with --dataset NAME")
    return each[fitting[0]]


def _names_one(word: str, scenes: Sequence[str]) -> bool:
    """Whether a scene, a pattern of scenes or a prediction's name fits one of ``scenes``."""
    return "/" not in word and (bool(fnmatch.filter(scenes, word)) or is_known(word, scenes))
