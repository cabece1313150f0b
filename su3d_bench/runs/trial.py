"""Trial of a user-defined method on two frames of a built-in room, or of every function of a user-defined dataset."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from su3d_bench.core.config import KeyPath, Setting, Settings
from su3d_bench.core.errors import ConfigError, DataError, PlugInError
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.datasets.frame_checks import check_frames, facts_of
from su3d_bench.metrics.metric import n_predictions
from su3d_bench.runs.plan import make_plan
from su3d_bench.runs.plugins import is_built_in, place_of
from su3d_bench.runs.runner import run_plan
from su3d_bench.store.predictions import read_prediction

SCENE = "rooms/living0"
ASKED: dict[KeyPath, Any] = {
    ("scenes",): [SCENE],
    ("profile",): "oracle",
    ("protocols",): ["rooms-instance"],
    ("stride",): 4,
    ("dataset", "rooms", "n_frames"): 8,
    ("jobs",): 1,
    ("executor",): "inline",
    ("pictures",): False,
}
N_FRAMES = 2


@dataclass(frozen=True)
class Trial:
    """The map of a method after two frames; ``n_instances`` is None if its map has no instances."""

    method: str
    scene: str
    n_frames: int
    kind: str
    n_points: int
    n_instances: int | None
    has_features: bool


def try_method(target: str) -> Trial:
    """The map of the method at ``target`` after two frames; a ``ConfigError`` with the reason if it fails."""
    asked = {**ASKED, ("methods",): [target]}
    settings = Settings(tuple(Setting(path, value, "the trial") for path, value in asked.items()))
    with tempfile.TemporaryDirectory(prefix="su3d-trial-") as folder:
        plan = make_plan(settings, (), Path(folder) / "run")
        result = run_plan(plan, lambda event: None)
        if result.failures:
            raise ConfigError(result.failures[0][2])
        (method,) = plan.methods
        prediction = read_prediction(plan.folder.job(SCENE, method).prediction)
        n_instances = None if isinstance(prediction, DenseFeatures) else n_predictions(prediction)
        has_features = prediction.features is not None
        return Trial(
            method, SCENE, N_FRAMES, type(prediction).__name__, len(prediction.points), n_instances, has_features
        )


def try_dataset(dataset: Any, scene: str) -> None:
    """Call every function of a user-defined ``dataset`` for ``scene`` once, and read two frames.

    A ``PlugInError`` at the first invalid return value, and whatever its own code raises; missing data, such as a file
    or the ground truth, are left to the check of the whole scene.
    """
    if is_built_in(type(dataset)):
        return
    asked = [partial(_try_frames, dataset), dataset.files, dataset.digest]
    asked += [partial(_try_truth, dataset, variant) for variant in dataset.variants]
    for ask in (*asked, dataset.instance_mesh):
        with suppress(DataError, OSError):
            ask(scene)


def _try_truth(dataset: Any, variant: str, scene: str) -> None:
    space = dataset.ground_truth(scene, variant).labels.space
    if space != dataset.label_space:
        raise PlugInError(
            f"{_place(dataset, 'ground_truth')}: its labels are of '{space}', but the class has label_space = "
            f"'{dataset.label_space}'"
        )


def _try_frames(dataset: Any, scene: str) -> None:
    for stride in (1, 2):
        info, frames = dataset.info(scene, stride), dataset.frames(scene, stride)
        if len(frames) != info.n_frames:
            raise PlugInError(
                f"{_place(dataset, 'frames')} returned {len(frames)} frames at stride {stride}, but its info has "
                f"n_frames {info.n_frames}"
            )
        if stride == 1:
            n_frames = len(frames)
            facts = [facts_of(frames[k]) for k in range(min(N_FRAMES, n_frames))]
        elif len(frames) != -(-n_frames // stride):
            raise PlugInError(
                f"{_place(dataset, 'frames')} returned {len(frames)} frames at stride {stride}, but {n_frames} at 1; "
                "expected every stride-th frame, starting with the first"
            )
    for finding in check_frames(facts):
        if finding.severity == "error" and finding.check in ("pose", "intrinsics", "size"):
            raise PlugInError(f"{_place(dataset, 'frames')}: {finding.where}: {finding.text}")


def _place(dataset: Any, name: str) -> str:
    return place_of(type(dataset), name, getattr(dataset, name))
