"""Truth and maps of an evaluation against files, as whoever explains its errors takes them: points with places.

Files of ground truth number points and say nothing of where they are. Which mask lies on which object is known from the
numbers, so that each point gets a place of its own, a metre from any other: the nearest point of a map is the same one.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, printable, shown
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import Float32Array, GroundTruth, LabelSet
from su3d_bench.evaluation.request import Request, ValuesForm
from su3d_bench.evaluation.scoring import map_of
from su3d_bench.evaluation.truth import TextTruths, VertexTruth, text_scenes
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.predictions.own_runs import OwnRuns, read_stored
from su3d_bench.predictions.scenes import Source
from su3d_bench.runs.finished import FinishedRun

ROW = 256  # places along an axis before the next row begins


class FilesOfTruth:
    """The truth of a run that was scored against files, which must still be those that they were."""

    def __init__(self, run: FinishedRun) -> None:
        self._run = run

    def truth(self, scene: str, rules: ProtocolRules) -> GroundTruth:
        """The truth of a scene under a protocol, each point at a place of its own."""
        found = self._texts.of_scene(rules, scene.partition("/")[2])
        assert isinstance(found, VertexTruth)
        return _at_places(rules, found, scene)

    def prediction(self, scene: str, method: str, rules: ProtocolRules, n_points: int) -> Prediction:
        """The map of a method on the same places."""
        return map_of(read_stored(self._run.folder.job(scene, method).prediction), places(n_points), rules)

    @cached_property
    def _texts(self) -> TextTruths:
        record, run = self._run.record.ground_truth, self._run
        if record is None or record.path is None or not Path(record.path).is_dir():
            raise DataError(
                f"{run.name}: its ground truth, {printable(str(record and record.path), 200)}, is not here; run this "
                "where the folder lies, or evaluate again with --out"
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
        said: ValuesForm | None = next((form for form in _FORMS if form == record.values), None)
        protocols = tuple(run.protocols)
        request = Request((run.folder.path,), ground_truth=folder, truth_values=said, protocols=protocols)
        return TextTruths(request, [Source(run.folder.path, OwnRuns(), tuple(scenes))])


_FORMS: tuple[ValuesForm, ...] = ("classes", "instances", "numbers")


def places(n: int) -> Float32Array:
    """Places (n, 3) a metre apart, the same for the same number.

    >>> places(2).tolist()
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    number = np.arange(n)
    return np.stack([number % ROW, number // ROW % ROW, number // ROW**2], axis=1).astype(np.float32)


def _at_places(rules: ProtocolRules, truth: VertexTruth, scene: str) -> GroundTruth:
    """Instances keep their numbers where a protocol goes by them; elsewhere they are numbered through."""
    instance = truth.values % INSTANCES_PER_CLASS
    if rules.class_agnostic is None:
        is_object = truth.values >= INSTANCES_PER_CLASS
        distinct, number = np.unique(truth.values[is_object], return_inverse=True)
        if len(distinct) >= INSTANCES_PER_CLASS:
            raise ConfigError(f"{printable(scene, 100)}: has {len(distinct)} objects; errors of up to 999 are told")
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
