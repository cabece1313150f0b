"""HOV-SG's semantic segmentation: the vote of five neighbours and the metrics, on synthetic labelled clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from original_code import Ask, Original, load
from synthetic_points import OTHER, VOID, Problem, classes_of, scored

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine

FILE = "hovsg/utils/eval_utils.py"
VALUES = ("mIoU", "F-mIoU", "mAcc", "pAcc")
ABSENT = ("hydra", "omegaconf", "open3d", "open_clip", "plyfile", "segment_anything", "torchmetrics")


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index`` with two clouds: void, ignored classes true and called, missing classes, shared positions."""
    rng = np.random.default_rng([seed, index, 13])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        there = rng.choice(OTHER, rng.integers(1, 5), replace=False)
        clouds = [rng.integers(0, 1000, (rng.integers(low, 20), 3)) for low in (1, 5)]
        clouds[1][-1] = clouds[0][0]
        scenes.append(
            {
                "truth": rng.choice([*there, *there, OTHER, VOID], len(clouds[0])).tolist(),
                "called": rng.choice([*there, *there, *range(OTHER + 1)], len(clouds[1])).tolist(),
                "places_mm": clouds[0].tolist(),
                "own_mm": clouds[1].tolist(),
            }
        )
    return scenes


def hovsg(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The functions of the script in its order: it also needs CLIP and reads clouds from files."""
    utils = load(checkout / FILE, [checkout], absent=[*ABSENT, "hovsg.utils.clip_utils"])
    metric = load(checkout / "hovsg/utils/metric.py", [])
    measures = (metric.mean_iou, metric.frequency_weighted_iou, metric.mean_accuracy, metric.pixel_accuracy)
    id_of = {slot: number for slot, (number, _) in classes_of(rules).items()} | {VOID: 0}
    ignored = [-1, 0, *(entry.id for entry in rules.classes if rules.is_ignored(entry.name))]

    def ask(problem: Problem) -> Float64Array:
        rows = []
        for scene in problem:
            own, seen = (
                np.column_stack([np.array(scene[places]) / 1000, [id_of[slot] for slot in scene[slots]]])
                for places, slots in (("own_mm", "called"), ("places_mm", "truth"))
            )
            called = utils.knn_interpolation(own, seen, k=5)[:, -1].reshape(-1, 1)
            rows.append([measure(called, seen[:, -1:], ignore=ignored) for measure in measures])
        if np.isnan(rows).any():
            raise ArithmeticError("it divides by zero if a scene has no scored class")
        return np.array(rows, float)

    return ask


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program."""
    found = combine(rules, {str(s): scored(rules, scene) for s, scene in enumerate(problem)}, with_intervals=False)
    return np.array([[found.per_scene[str(s)][name] for name in VALUES] for s in range(len(problem))], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """Its answers are in tests/cases/originals_semantic already."""
    raise SystemExit("no new cases of these problems; compare without --cases")


ORIGINALS = (Original(("replica-hovsg",), FILE, hovsg, drawn, ours, keep),)
