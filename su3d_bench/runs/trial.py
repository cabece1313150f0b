"""A method tried on two frames of a built-in room, with perfect masks, as a run goes about it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.config import KeyPath, Setting, Settings
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.types import DenseFeatures
from su3d_bench.metrics.metric import n_predictions
from su3d_bench.runs.planning.plan import make_plan
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


@dataclass(frozen=True)
class Trial:
    """What a method made of the two frames; ``n_instances`` None where its map has none."""

    method: str
    scene: str
    n_frames: int
    kind: str
    n_points: int
    n_instances: int | None
    has_features: bool


def try_method(target: str) -> Trial:
    """What the method at ``target`` makes of two frames; a ``ConfigError`` with what went wrong where it fails."""
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
        return Trial(method, SCENE, 2, type(prediction).__name__, len(prediction.points), n_instances, has_features)
