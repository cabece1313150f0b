"""VoteNet's evaluation of boxes on synthetic problems."""

from __future__ import annotations

import contextlib
import json
import sys
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import numpy as np
from original_code import STOPS, Ask, Original, load, silence
from places import CASES
from synthetic_boxes import SLOTS, Problem, Scene, names_of, scored

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.instance.boxes import PLACES, THRESHOLDS
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine

OFF = 0.0002  # sides of true boxes are on half millimetres


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: boxes near the true ones, next to them, duplicates, other classes, none, a missing class, a
    scene without a true box, rotations of either sign.

    No side of a predicted box coincides with one of a true box: there the original clips wrongly, and a box has an
    IoU of 3.6 with itself.
    """
    rng = np.random.default_rng([seed, index])
    n_found = iter(rng.permutation(100) / 100)
    return [_drawn_scene(rng, n_found) for _ in range(rng.integers(1, 4))]


def _drawn_scene(rng: np.random.Generator, confidences: Any) -> Scene:
    true = [
        {
            "slot": int(rng.choice(SLOTS)),
            "middle": _short(rng.uniform(0, 3, 3)),
            "sizes": _short(rng.uniform(0.3, 2, 3)),
        }
        for _ in range(rng.integers(0, 6))
    ]
    nowhere = {"slot": int(rng.choice(SLOTS)), "middle": [1.0, 1.0, 1.0], "sizes": [1.0, 1.0, 1.0]}
    found: list[dict[str, Any]] = []
    for _ in range(rng.choice([0, 1, 3, 5, 8])):
        of = true[int(rng.integers(len(true)))] if true else nowhere
        away, by = rng.choice([0.02, 0.05, 0.2, 0.6, 5.0], 2, p=[0.24, 0.24, 0.24, 0.24, 0.04])
        one = {
            "slot": of["slot"] if rng.random() < 0.8 else int(rng.choice(SLOTS)),
            "middle": [round(one + OFF, 4) for one in _short(of["middle"] + away * rng.normal(size=3))],
            "sizes": _short(of["sizes"] * np.exp(by * rng.normal(size=3))),
        }
        if found and rng.random() < 0.15:
            one = {**found[-1]}  # the same box again, with another confidence
        found.append({**one, "score": float(next(confidences))})
    return {"heading": float(rng.choice([0.0, round(rng.uniform(-4, 4), 3)])), "true": true, "found": found}


def _short(metres: Float64Array) -> list[float]:
    return [float(one) for one in metres.round(3)]


def votenet(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """AP and recall at each threshold of each true slot, and their means, by VoteNet's calculator.

    Its processes are replaced by threads. For a class that is called but nowhere true it divides by zero, and the mean
    over the classes is undefined.
    """
    absent = ["trimesh", "plyfile", "matplotlib"]
    module = load(checkout / "models/ap_helper.py", [checkout / "utils", checkout / "models"], absent=absent)
    sys.modules["eval_det"].Pool = ThreadPool  # type: ignore[attr-defined]

    def ask(problem: Problem) -> Float64Array:
        answer = []
        for threshold in THRESHOLDS:
            judge = module.APCalculator(threshold)
            found, true = [], []
            for scene in problem:
                for boxes, kind in ((found, "found"), (true, "true")):
                    boxes.append([])
                    for one in scene[kind]:
                        length, height, width = one["sizes"]
                        corners = module.get_3d_box((length, width, height), scene["heading"], one["middle"])
                        boxes[-1].append((one["slot"], corners, *([one["score"]] if kind == "found" else [])))
            judge.step(found, true)
            values = judge.compute_metrics()
            is_true = {one["slot"] for scene in problem for one in scene["true"]}
            for kind, mean in (("Average Precision", "mAP"), ("Recall", "AR")):
                of_slots = [values[f"{k} {kind}"] if k in is_true else np.nan for k in SLOTS]
                answer.append([*of_slots, values[mean] if _is_whole(problem) else np.nan])
        return np.array(answer, float).ravel()

    return ask


def _is_whole(problem: Problem) -> bool:
    """Whether every called class is true somewhere."""
    called, true = ({one["slot"] for scene in problem for one in scene[kind]} for kind in ("found", "true"))
    return called <= true


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program."""
    found = combine(rules, {str(s): scored(rules, scene) for s, scene in enumerate(problem)}, with_intervals=False)
    names = [name for _, name in names_of(rules).values()]
    answer = []
    for place in PLACES:
        for kind in ("AP", "recall"):
            mean = found.metrics[kind + place] if _is_whole(problem) else np.nan
            answer.append([*(found.per_class[name][kind + place] for name in names), mean])
    return np.array(answer, float).ravel()


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems that it answers."""
    kept, index = list[dict[str, object]](), 0
    while len(kept) < n:
        problem = drawn(seed, index)
        index += 1
        with contextlib.suppress(*STOPS), silence():
            answer = [None if value != value else float(value) for value in ask(problem)]
            kept.append({"scenes": problem, "answer": answer})
    lines = ",\n".join(json.dumps(one, separators=(",", ":")) for one in kept)
    source = (
        "models/ap_helper.py and utils/eval_det.py of facebookresearch/votenet, at the commit in the protocol's file"
    )
    (CASES / "boxes01_votenet.json").write_text(f'{{"source": "{source}",\n"problems": [\n{lines}]}}\n')


ORIGINALS = (Original(("replica-boxes",), "models/ap_helper.py", votenet, drawn, ours, keep),)
