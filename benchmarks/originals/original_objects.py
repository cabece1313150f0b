"""OVO's evaluation on synthetic problems of objects that vote for nearby vertices, or with one class per vertex."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
from original_code import STOPS, Ask, Original, load, silence, without_gpu
from original_instances import emptied
from original_points import SHORT, rewritten
from synthetic_objects import GROUPS, N_SLOTS, NONE, OVERALL, Problem, our_means, slots_of

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.protocols.model import ProtocolRules

FILE = "ovo/utils/eval_utils.py"
LISTS = {
    "replica-ovo51": "Replica/eval_info",
    "scannet-ovo20": "ScanNet/eval_info",
    "scannet-ovo200": "ScanNet/eval_info_200",
}


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index`` in slots, the last for unnamed objects: void, missing classes, objects without a class.

    Objects are numbered in any order; points of the map coincide or are as far from a vertex as others.
    """
    rng = np.random.default_rng([seed, index, 5])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        there = rng.choice(N_SLOTS, rng.integers(1, 5), replace=False)
        kinds = [NONE] if rng.random() < 0.05 else [*there, *there, NONE]
        truth = rng.choice(kinds, n := int(rng.integers(1, 18)))
        scene: dict[str, Any] = {"truth": truth.tolist()}
        if rng.random() < 0.3:
            called = np.where(rng.random(n) < 0.5, truth, rng.choice([*there, N_SLOTS - 1, NONE], n))
            scenes.append(scene | {"called": called.tolist()})
            continue
        n_objects, n_points = int(rng.integers(1, 6)), int(rng.integers(7, 60))
        owner = rng.integers(-1, n_objects, n_points)
        owner[:5] = rng.integers(0, n_objects, 5)  # it fails if fewer than five points vote
        step = int(rng.choice([1, 125, 250]))
        places = rng.integers(0, 1000 // step, (n, 3)) * step
        own = rng.integers(-100 // step, 1100 // step, (n_points, 3)) * step
        own = np.where(rng.random((n_points, 1)) < 0.3, own[rng.integers(0, n_points, n_points)], own)
        scenes.append(
            scene
            | {
                "places_mm": places.tolist(),
                "own_mm": own.tolist(),
                "ids": rng.choice(99, n_objects, replace=False).tolist(),
                "owner": owner.tolist(),
                "of_object": rng.choice([*there, *there, rng.integers(N_SLOTS), NONE], n_objects).tolist(),
            }
        )
    return scenes


def ovo(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The script on files with one class per vertex, written for objects as by run_eval.py; its lists of classes are
    read from its own settings."""
    import torch
    import yaml

    without_gpu()
    module = load(checkout / FILE, [checkout], absent=["seaborn", "matplotlib", "pandas"])
    info = yaml.safe_load((checkout / f"data/working/configs/{LISTS[rules.name]}.yaml").read_text())
    info.setdefault("num_classes", len(info["class_names_reduced"]))
    void = -1 if -1 in info["map_to_reduced"] else 0  # not a vertex label in ScanNet
    ids = [entry.id if entry.id in info["map_to_reduced"] else None for entry in rules.classes]  # not the background
    place = np.array([info["map_to_reduced"].get(one, info["num_classes"] - 1) for one in ids] + [-1])

    def labels_of(scene: dict[str, Any]) -> Float64Array:
        if "called" in scene:
            return place[scene["called"]]
        ids = np.array([*scene["ids"], -1])
        own, seen = ((np.array(scene[key]) / 1000).astype(np.float32) for key in ("own_mm", "places_mm"))
        owner = torch.tensor(ids[scene["owner"]])
        of_vertex, *_ = module.match_labels_to_vtx(owner, torch.tensor(own), torch.tensor(seen))
        return place[[scene["of_object"][scene["ids"].index(one)] for one in of_vertex.tolist()]]

    def ask(problem: Problem) -> Float64Array:
        problem = slots_of(rules, problem)
        pred, truth = emptied(folder / "pred"), emptied(folder / "gt")
        for s, scene in enumerate(problem):
            (pred / f"{s}.txt").write_text("\n".join(str(int(one)) for one in labels_of(scene)))
            (truth / f"{s}.txt").write_text(
                "\n".join(str(void if one < 0 else ids[one] or void) for one in scene["truth"])
            )
        scenes = [str(s) for s in range(len(problem))]
        _, confusion = module.eval_semantics(pred, truth, scenes, info, verbose=False, return_metrics=True)
        iou, has_iou, weights, acc, has_acc = module.iou_acc_from_confmat(
            confusion, info["num_classes"], info["ignore"]
        )
        means = [np.mean(iou[has_iou]), np.mean(acc[has_acc])]
        means += [np.sum(one[has_iou] * weights[has_iou]) / weights[has_iou].sum() for one in (iou, acc)]
        third = len(iou) // 3
        for k in range(len(GROUPS)):
            rows = slice(third * k, third * (k + 1))
            means += [np.mean(one[rows][has_iou[rows]]) for one in (iou, acc)]
        return np.array(means, float)

    return ask


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems with a new answer."""
    kept: dict[str, str] = {}
    names = [*OVERALL, *(f"{group} {key}" for group in GROUPS for key in OVERALL[:2])]
    for problem in (drawn(seed, index) for index in itertools.count()):
        try:
            with silence():
                values = ask(problem)
        except STOPS:
            continue
        answer = {key: None if value != value else float(value) for key, value in zip(names, values, strict=True)}
        kept.setdefault(
            str(answer), json.dumps({"scenes": slots_of(rules, problem), "answer": answer}, separators=SHORT)
        )
        if len(kept) == n:
            break
    rewritten(rules.name, [json.loads(text) for text in kept.values()])


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program."""
    return our_means(rules, slots_of(rules, problem))


ORIGINALS = (Original(tuple(LISTS), FILE, ovo, drawn, ours, keep),)
