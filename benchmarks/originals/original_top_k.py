"""ScanNet++'s semantic script on synthetic problems of vertices with several labels and ranked classes.

A problem is a list of scenes. A scene has the ``labels`` of every vertex, three lines of the list of classes or -1 for
none, its ``ranked`` classes, one line or three, and the vertices that are ``left_out``.
"""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import numpy as np
from original_code import Ask, Original, load
from original_instances import emptied

from su3d_bench.core.types import Float64Array, GroundTruth, LabelSet
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions.base import VertexLabels

Scene = dict[str, Any]

FILE = "semantic/eval/eval_semantic.py"
N_CLASSES = 15  # the first classes of the list occur
TOP = (1, 3)


def drawn(seed: int, index: int) -> list[Scene]:
    """Problem ``index``: vertices with one, several, equal or no labels, one or three ranked classes, vertices that are
    left out, but never a single one, at which the original fails, nor scenes of one, which it reads as several.
    """
    rng = np.random.default_rng([seed, index, 11])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        n, there = int(rng.integers(2, 40)), rng.choice(N_CLASSES, rng.integers(1, 5))
        labels = rng.choice(np.append(there, -1), (n, 3))
        labels = np.take_along_axis(labels, np.argsort(labels < 0, axis=1, kind="stable"), axis=1)  # none at the end
        ranked = np.where(rng.random((n, 3)) < 0.4, np.maximum(labels, 0), rng.integers(0, N_CLASSES, (n, 3)))
        left_out = rng.permutation(n)[: rng.choice([0, 2, n // 3])]
        scenes.append(
            {
                "labels": labels.tolist(),
                "ranked": ranked[:, : rng.choice(TOP)].tolist(),
                "left_out": left_out.tolist() if len(left_out) > 1 else [],
            }
        )
    return scenes


def scannetpp(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The mean IoU and that of the first classes, top 1 and top 3, with the number of classes of the protocol."""
    module = load(checkout / FILE, [checkout], absent=["munch"])
    of_file = {"scan_mesh_mask_path": property(lambda scene: folder / f"left_out/{scene.name}.txt")}
    module.ScannetppScene_Release = type("Scene", (types.SimpleNamespace,), of_file | {"__init__": _named})

    def ask(problem: list[Scene]) -> Float64Array:
        pred, truth, left_out = (emptied(folder / name) for name in ("pred", "gt", "left_out"))
        for s, scene in enumerate(problem):
            labels = np.array(scene["labels"])
            np.savetxt(truth / f"{s}.txt", np.where(labels < 0, -100, labels), fmt="%d", delimiter=",")
            np.savetxt(pred / f"{s}.txt", scene["ranked"], fmt="%d", delimiter=",")
            np.savetxt(left_out / f"{s}.txt", scene["left_out"], fmt="%d")
        names = [str(s) for s in range(len(problem))]
        found = module.eval_semantic(names, pred, truth, folder, len(rules.classes), -100, list(TOP))
        return np.array([[found[k].miou, *found[k].ious[:N_CLASSES]] for k in TOP], float)

    return ask


def _named(scene: Any, name: str, data_root: Path) -> None:
    scene.name = name


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under a protocol of kind ``top-k``."""
    labels, ranked = np.array(scene["labels"]), np.array(scene["ranked"], np.int32)
    ids = np.array([entry.id for entry in rules.classes] + [0], np.int32)  # the last for none
    every = ids[labels]
    every[scene["left_out"]] = -1
    points = np.column_stack([np.arange(len(labels)), np.zeros((len(labels), 2))]).astype(np.float32)
    space = LabelSet(rules.label_space, *zip(*((one.id, one.name) for one in rules.classes), strict=True))
    truth = GroundTruth(
        points, every[:, 0], np.zeros(len(labels), np.int32), space, rules.ground_truth, "made", every_semantic=every
    )
    further = ranked[:, 1:] if ranked.shape[1] > 1 else None
    prediction = VertexLabels(ranked[:, 0], further, "line").on(points, rules)
    return score_scene(rules, truth, prediction, None)


def ours(rules: ProtocolRules, problem: list[Scene]) -> Float64Array:
    """The same by this program."""
    found = combine(rules, {str(s): scored(rules, scene) for s, scene in enumerate(problem)}, with_intervals=False)
    names = [entry.name for entry in rules.classes[:N_CLASSES]]
    keys = ("IoU", "top-3 IoU")
    return np.array(
        [[found.metrics[f"{key[:-3]}mIoU"], *(found.per_class[name][key] for name in names)] for key in keys], float
    )


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """Its answers are in tests/cases/scannetpp02_semantic already."""
    raise SystemExit("no file of cases for these problems; compare without --cases")


ORIGINALS = (Original(("scannetpp-semantic", "rooms-top-k"), FILE, scannetpp, drawn, ours, keep),)
