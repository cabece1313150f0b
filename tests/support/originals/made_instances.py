"""Made problems of instances, which original evaluators and this program both answer: runs of points and masks.

A problem is a list of scenes. A scene has its ``truth`` as [class, number, length] of runs of points and ``masks`` with
a class, a score and runs [start, end]. Classes are slots: four that are scored, -2 one that is not, -1 void.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, GroundTruth, Int64Array, LabelSet
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene

Scene = dict[str, Any]
Problem = list[Scene]
VOID, LEFT_OUT = -1, -2
SCORED = (0, 1, 2, 3)
LENGTHS = (20, 60, 99, 100, 101, 150, 200, 400)  # around the minimum size of 100 points


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: one to three scenes with ties, duplicates, empty and small masks, void and missing classes."""
    rng = np.random.default_rng([seed, index])
    one_score = np.float32(rng.random())
    return [_drawn_scene(rng, one_score) for _ in range(rng.integers(1, 4))]


def _drawn_scene(rng: np.random.Generator, one_score: np.float32) -> Scene:
    truth: list[list[int]] = []
    for number in range(1, rng.integers(2, 9)):
        slot = int(rng.choice([*SCORED, 0, LEFT_OUT, VOID]))
        truth.append([slot, 0 if slot == VOID else number, int(rng.choice(LENGTHS))])
    starts = np.cumsum([0, *(length for *_, length in truth)]).tolist()
    masks: list[dict[str, Any]] = []
    for _ in range(rng.choice([0, 1, 2, 4, 6, 8])):
        if masks and rng.random() < 0.15:
            mask = {**masks[int(rng.integers(len(masks)))]}  # a duplicate, under its own or another score
        else:
            run = int(rng.integers(len(truth)))
            slot = (
                truth[run][0] if rng.random() < 0.7 and truth[run][0] != VOID else int(rng.choice([*SCORED, LEFT_OUT]))
            )
            mask = {"slot": slot, "runs": _drawn_runs(rng, starts, run)}
        mask["score"] = float(one_score if rng.random() < 0.3 else np.float32(rng.random()))
        masks.append(mask)
    return {"truth": truth, "masks": masks}


def _drawn_runs(rng: np.random.Generator, starts: list[int], run: int) -> list[list[int]]:
    first, last = starts[run], starts[run + 1]
    if rng.random() < 0.2:
        return [[first, last]]
    start = int(rng.integers(max(0, first - 60), last))
    runs = [[start, int(rng.integers(start, min(starts[-1], last + 60) + 1))]]
    if rng.random() < 0.2:  # a second part elsewhere
        beyond = int(rng.integers(runs[0][1], starts[-1] + 1))
        runs.append([beyond, min(starts[-1], beyond + int(rng.integers(0, 200)))])
    return [one for one in runs if one[0] < one[1]] or [[first, first + 1]]


def members(mask: dict[str, Any]) -> Int64Array:
    """The points of a mask, ascending."""
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(*run) for run in mask["runs"])])


def columns_of(scene: Scene) -> tuple[Int64Array, Int64Array]:
    """The slot (N,) and the instance number (N,) of every point."""
    slot, number, length = (np.array(column) for column in zip(*scene["truth"], strict=True))
    return np.repeat(slot, length), np.repeat(number, length)


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under a protocol of instances."""
    ids, names = classes_of(rules)
    slots, numbers = columns_of(scene)
    known = [one for one in ids if one != VOID]
    labels = LabelSet(rules.label_space, tuple(ids[one] for one in known), tuple(names[one] for one in known))
    points = _points(len(slots))
    semantic = np.array([ids[one] for one in slots.tolist()], np.int32)
    truth = GroundTruth(points, semantic, numbers.astype(np.int32), labels, rules.ground_truth, "made")
    masks = [members(mask) for mask in scene["masks"]]
    confidences = np.array([mask["score"] for mask in scene["masks"]], float)
    called = [names[mask["slot"]] for mask in scene["masks"]]
    return score_scene(rules, truth, Instances.of(points, masks, confidences, labels=called), None)


def _points(n: int) -> Float32Array:
    """A point a metre, so that each has one neighbour within reach: itself."""
    points = np.zeros((n, 3), np.float32)
    points[:, 0] = np.arange(n)
    return points


def classes_of(rules: ProtocolRules) -> tuple[dict[int, int], dict[int, str]]:
    """The ids and names that a protocol has for the slots."""
    if not rules.classes:
        return {VOID: 0, LEFT_OUT: 1, 0: 4, 1: 7, 2: 11, 3: 21}, {one: f"c{one}" for one in (LEFT_OUT, VOID, *SCORED)}
    first = 0 if rules.name == "scannet200-instance" else 3
    step = 3 if rules.name.startswith("openscan") else 7  # the next would be the first again among 21
    entries = {k: rules.scored[(step * k + first) % len(rules.scored)] for k in SCORED}
    left = [entry for entry in rules.classes if rules.is_ignored(entry.name)]
    return (
        {VOID: 0, LEFT_OUT: left[0].id if left else 900, **{k: one.id for k, one in entries.items()}},
        {LEFT_OUT: left[0].name if left else "nothing", **{k: one.name for k, one in entries.items()}},
    )
