"""POPE's script on synthetic answers whether an object is there, one file of questions over all scenes."""

from __future__ import annotations

import io
import json
import runpy
from pathlib import Path

import numpy as np
from original_code import Ask, Original

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.presence import SAMPLINGS, PresenceCounts, measured

FILE = "evaluate.py"
MEASURES = {"accuracy": "acc", "precision": "precision", "recall": "recall", "F1": "f1", "yes-rate": "yes_ratio"}
Problem = list[dict[str, list[int]]]  # of each scene, whether each object is ``there`` and answered with ``yes``


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: scenes with few or no questions, mostly right, wrong or equal answers."""
    rng = np.random.default_rng([seed, index, 17])
    scenes = []
    for _ in range(rng.integers(1, 5)):
        there = rng.random(rng.integers(0, 12)) < rng.choice([0.1, 0.5, 0.5, 0.9])
        is_right = rng.random(len(there)) < rng.choice([0.1, 0.5, 0.8, 0.8])
        yes = np.where(is_right, there, ~there) if rng.random() < 0.9 else np.full(len(there), rng.random() < 0.5)
        scenes.append({"there": there.astype(int).tolist(), "yes": yes.astype(int).tolist()})
    return scenes


def pope(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The script unedited: its two file names are empty, and opening them gives the labels and the answers."""

    def ask(problem: Problem) -> Float64Array:
        words = {1: "yes", 0: "no"}
        lines = [
            "\n".join(json.dumps({key: words[value]}) for scene in problem for value in scene[name])
            for name, key in (("yes", "answer"), ("there", "label"))
        ]
        files = iter(map(io.StringIO, lines))
        names = runpy.run_path(str(checkout / FILE), init_globals={"open": lambda *_: next(files)})
        return np.array([names[key] for key in MEASURES.values()], float)

    return ask


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program, for the first of the samplings."""
    counts = []
    for scene in problem:
        there, yes = (np.array(scene[name], bool) for name in ("there", "yes"))
        counts.append(PresenceCounts(np.zeros(len(there), np.int64), there, yes, np.zeros(len(there))))
    values = measured(counts, np.ones((1, len(counts)), np.int64))
    return np.array([values[f"{name} {SAMPLINGS[0]}"][0] for name in MEASURES], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """Its answers are in tests/cases/presence01_pope already."""
    raise SystemExit("no new cases of these problems; compare without --cases")


DATA = ("rooms", "replica", "scannet", "scannetpp", "hm3dsem")
ORIGINALS = (Original(tuple(f"{name}-presence" for name in DATA), FILE, pope, drawn, ours, keep),)
