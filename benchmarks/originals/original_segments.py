"""panopticapi, the evaluator of COCO's panoptic task, and SemanticKITTI's, on synthetic problems of labelled points."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
from original_code import STOPS, Ask, Original, load, silence
from places import CASES
from synthetic_segments import (
    LEFT_OUT,
    N_SCORED,
    N_THINGS,
    OTHER,
    UNLABELLED,
    Problem,
    Scene,
    classes_of,
    has_left_out,
    our_qualities,
)

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.protocols.model import ProtocolRules

FILE = "panopticapi/evaluation.py"
KITTI = "mmdet3d/evaluation/functional/panoptic_seg_eval.py"
OVERALL = ("pq", "sq", "rq")


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: crowds, void, excluded points, masks without a scored class, overlaps of one half; numbers
    that restart with each class or are large, things in several parts, shuffled points, scenes of one point or of void.
    """
    rng = np.random.default_rng([seed, index, 7])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        sizes = rng.integers(1, 7, rng.integers(2, 8)) if rng.random() < 0.95 else np.ones(1, int)
        kinds = [UNLABELLED] if rng.random() < 0.05 else [0, 0, 1, 2, 3, 3, 4, OTHER, UNLABELLED, LEFT_OUT]
        of_part = rng.choice(kinds, len(sizes))
        number = rng.choice([1, 2, 300, 999], len(sizes)) if rng.random() < 0.5 else np.arange(len(sizes)) + 1
        is_crowd = rng.random(len(sizes)) < 0.25
        part = np.repeat(np.arange(len(sizes)), sizes)
        owner = np.where(
            rng.random(len(part)) < rng.choice([0.0, 0.3, 0.5]), rng.integers(-1, len(sizes), len(part)), part
        )
        there, owner = np.unique(np.append(owner, -1), return_inverse=True)
        guess = rng.integers(0, OTHER + 1, len(sizes))
        called = np.where((rng.random(len(sizes)) < 0.7) & (of_part >= 0), of_part, guess)[there[1:]]
        number = np.where(is_crowd | (of_part < 0) | (of_part >= N_THINGS), 0, number)
        order = rng.permutation(len(part)) if rng.random() < 0.3 else np.arange(len(part))
        scenes.append(
            {
                "truth": of_part[part][order].tolist(),
                "instance": number[part][order].tolist(),
                "owner": (owner[:-1] - 1)[order].tolist(),
                "called": called.tolist(),
            }
        )
    return scenes


def panopticapi(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The script on pairs of one-line images, one pixel per point, each scene in a separate process."""
    from PIL import Image

    module = load(checkout / FILE, [checkout])
    of_slot = classes_of(rules)
    categories = {entry.id: {"isthing": int(entry.name not in rules.stuff)} for entry in rules.scored}

    def written(name: str, values: Float64Array, segments: list[dict[str, Any]]) -> dict[str, Any]:
        ids = values.astype(np.int64)
        image = np.stack([ids % 256, ids // 256 % 256, ids // 65536], axis=-1).astype(np.uint8)[None]
        Image.fromarray(image).save(folder / name)
        return {"image_id": 1, "file_name": name, "segments_info": segments}

    def images(scene: Scene) -> tuple[dict[str, Any], dict[str, Any]]:
        truth, instance, owner = (np.array(scene[key]) for key in ("truth", "instance", "owner"))
        kept = truth != LEFT_OUT if has_left_out(rules) else np.ones(len(truth), bool)
        truth, instance, owner = truth[kept], instance[kept], owner[kept]
        called = np.append(scene["called"], -1).astype(int)[owner]
        pair = []
        for name, slot, number in (("truth.png", truth, instance), ("found.png", called, owner + 1)):
            is_in = (slot >= 0) & (slot < N_SCORED)
            number = np.where(slot < N_THINGS, number, 0)
            ids = np.where(is_in, 1000 * (slot + 1) + number, 0)
            segments = [
                {
                    "id": key,
                    "category_id": of_slot[key // 1000 - 1][0],
                    "iscrowd": int(key % 1000 == 0 and key // 1000 <= N_THINGS),
                }
                for key in np.unique(ids[is_in]).tolist()
            ]
            for one in segments:
                one["area"] = int((ids == one["id"]).sum())
            pair.append(written(name, ids, segments))
        return pair[0], pair[1]

    def ask(problem: Problem) -> Float64Array:
        stat = module.PQStat()
        for scene in problem:
            stat += module.pq_compute_single_core(0, [images(scene)], str(folder), str(folder), categories)
        rows, of_class = [], {}
        for is_thing in (None, True, False):
            row, each = stat.pq_average(categories, isthing=is_thing)
            rows += [row[key] for key in OVERALL]
            of_class |= each
        slots = [of_class[number] for number, _ in list(of_slot.values())[:N_SCORED]]
        return np.array([*rows, *(slot[key] for slot in slots for key in OVERALL)], float)

    return ask


def semantic_kitti(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """mmdetection3d's evaluator of classes by index, with one class more for void, which it ignores."""
    module = load(checkout / KITTI, [checkout], absent=["mmengine", "mmengine.logging"])
    names = [entry.name for entry in rules.scored]
    things = [name for name in names if name not in rules.stuff]
    at = [names.index(name) for _, name in list(classes_of(rules).values())[:N_SCORED]]
    index_of = np.array([*at, *[len(names)] * 3])  # of OTHER, -2 and -1: void

    def ask(problem: Problem) -> Float64Array:
        judge = module.EvalPanoptic(
            [*names, "void"], things, list(rules.stuff), rules.min_region_size, 1 << 20, {}, [len(names)]
        )
        true, found = [], []
        for scene in problem:
            owner = np.array(scene["owner"])
            slots = np.array(scene["truth"]), np.append(scene["called"], UNLABELLED).astype(int)[owner]
            for kept, slot, number in zip((true, found), slots, (np.array(scene["instance"]), owner + 1), strict=True):
                number = np.where((slot < 0) | (slot >= N_THINGS), 0, number)  # stuff is one segment
                kept.append({"pts_semantic_mask": index_of[slot], "pts_instance_mask": number})
        answer = judge.evaluate(true, found)
        keys = ["pq", "sq_mean", "rq_mean", *(f"{name}_{part}" for part in ("things", "stuff") for name in OVERALL)]
        means = [answer[key] for key in keys]
        each = judge.get_pq()[3:]
        return np.array([*means, *(values[k] for k in at for values in each)], float)

    return ask


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems with a new answer."""
    file = CASES / "panoptic03_labelled_points.json"
    kept: dict[str, dict[str, Any]] = {}
    for problem in (drawn(seed, index) for index in itertools.count()):
        try:
            with silence():
                answer = [float(value) for value in ask(problem)]
        except STOPS:
            continue
        kept.setdefault(str(answer), {"scenes": problem, "answer": answer})
        if len(kept) == n:
            break
    content = {**(json.loads(file.read_text()) if file.is_file() else {}), rules.name: [*kept.values()]}
    blocks = [
        f'"{name}": [\n' + ",\n".join(json.dumps(one, separators=(",", ":")) for one in rows) + "]"
        for name, rows in content.items()
    ]
    file.write_text("{" + ",\n".join(blocks) + "}\n")


API = ("rooms", "replica", "scannet", "scannet200", "scannetpp", "hm3dsem")
ORIGINALS = (
    Original(tuple(f"{name}-panoptic" for name in API), FILE, panopticapi, drawn, our_qualities, keep),
    Original(("scannet-panoptic-oneformer3d",), KITTI, semantic_kitti, drawn, our_qualities, keep),
)
