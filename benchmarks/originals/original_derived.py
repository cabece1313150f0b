"""Evaluators derived from ScanNet's for other data, each on the synthetic problems of ``original_instances``."""

from __future__ import annotations

import json
import types
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from original_code import Ask, Original, load, recorded, without_gpu
from original_instances import HERE, Answer, Given, answered, emptied, keep, of_archives, of_arrays, rows_of
from synthetic_instances import Problem, classes_of, masked_of, scored

from su3d_bench.core.types import Int64Array
from su3d_bench.metrics.instance import average_precision
from su3d_bench.metrics.protocols.model import ProtocolRules

OPENSCAN = "Evaluation/MaskClustering/evaluation/evaluate.py"
OPENSUN3D = "challenge_track_1/benchmark_scripts/eval_utils/eval_script_inst.py"
ASPECTS = ("affordance", "property", "type", "manner", "synonym", "requirement", "element", "material")


def segment3d(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """Segment3D's script with the one class of its ScanNet++ set-up, 0."""
    module = load(checkout / "benchmark/evaluate_semantic_instance.py", [checkout], absent=["plyfile", "imageio"])
    named = {"dataset": "scannetpp", "output_file": str(folder / "answer.txt")}
    return of_arrays(module, folder, rules, [0], np.zeros_like, **named)


def openscan(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """OpenScan's copy of MaskClustering's script, with the lists of an aspect as its constants."""
    without_gpu()
    script = checkout / OPENSCAN
    lists = load(script.parent / f"constants_{rules.name.removeprefix('openscan-')}.py", [])
    words = ["--pred_path", str(folder / "pred"), "--gt_path", str(folder / "gt"), "--dataset", "scannet"]
    words += ["--output_file", str(folder / "answer.txt")]
    module = load(script, [script.parents[1]], words, replaced={"evaluation.constants": vars(lists)})
    return of_archives(module, folder, rules, classes_of(rules)[0], list(module.VALID_CLASS_IDS))


def openyolo3d(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """Open-YOLO 3D's script for Replica; classes are indices into its list, or one behind it."""
    module = load(checkout / "evaluate/replica/eval_semantic_instance.py", [checkout], absent=["plyfile", "imageio"])
    known = module.VALID_CLASS_IDS.tolist()

    def convert(ids: Int64Array) -> Int64Array:
        return np.array([known.index(one) if one in known else len(known) for one in ids.tolist()], np.int64)

    rows = [known.index(classes_of(rules)[0][one]) for one in range(4)]
    return of_arrays(module, folder, rules, rows, convert, output_file=str(folder / "answer.txt"))


def opensun3d(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The OpenSUN3D challenge's script, over object numbers; its averages as fractions."""
    module = load(checkout / OPENSUN3D, [checkout / "challenge_track_1"], absent=["plyfile", "imageio"])
    module.compute_averages = partial(module.compute_averages, factor=1)
    return of_arrays(module, folder, rules, [0], np.ones_like)


def scannetpp(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """The ScanNet++ benchmark's script, over run lengths and vertices that are left out."""
    module = load(checkout / "semantic/eval/eval_instance.py", [checkout], absent=["munch"])
    of_file = {"scan_mesh_mask_path": property(lambda scene: folder / f"left_out/{scene.name}.txt")}
    module.ScannetppScene_Release = type("Scene", (types.SimpleNamespace,), of_file | {"__init__": _named})
    encode = load(checkout / "common/utils/rle.py", []).rle_encode
    info = module.instance_utils.get_label_info(
        [entry.name for entry in rules.classes], [entry.name for entry in rules.scored]
    )
    ids, _ = classes_of(rules)
    tables, averages = recorded(module, "evaluate_matches"), recorded(module, "compute_averages")

    def ask(problem: Problem) -> Answer:
        pred, truth, left_out = (emptied(folder / name) for name in ("pred", "gt", "left_out"))
        for s, scene in enumerate(problem):
            one, lines = Given.of(scene, ids), []
            np.savetxt(truth / f"{s}.txt", np.where(one.values > 0, one.values - 1000, -1), fmt="%d")  # lines from 0
            np.savetxt(left_out / f"{s}.txt", masked_of(scene), fmt="%d")
            for k, mask in enumerate(one.masks):
                (pred / f"{s}_{k}.json").write_text(json.dumps(encode(mask.astype(np.uint8))))
                lines.append(f"{s}_{k}.json {one.class_ids[k] - 1} {float(one.scores[k])!r}\n")
            (pred / f"{s}.txt").write_text("".join(lines))
        files = [[where / f"{s}.txt" for s in range(len(problem))] for where in (pred, truth)]
        module.evaluate(*files, pred, folder, info, module.instance_utils.Instance_Eval_Opts())
        return answered(tables[-1], averages[-1], rows_of(rules))

    return ask


def _named(scene: Any, name: str, data_root: Path) -> None:
    scene.name = name


def ours(rules: ProtocolRules, problem: Problem) -> Answer:
    """This program's answer from points with labels."""
    curve: Any = average_precision.combine([scored(rules, scene).counts for scene in problem], rules.thresholds)  # type: ignore[misc]
    return np.array([curve.ap, curve.ap50, curve.ap25, *curve.table[rows_of(rules)].ravel()], float)


def drawn(seed: int, index: int) -> Problem:
    """A problem whose instances all have a number, as points with labels need."""
    problem = HERE["drawn"](seed, index)
    for scene in problem:
        if any(number == 0 for _, number, _ in scene["truth"]):
            scene["truth"] = [[slot, number or 1000 - 1 - k, n] for k, (slot, number, n) in enumerate(scene["truth"])]
    return problem


ORIGINALS = (
    Original(("class-agnostic-segment3d",), "benchmark/evaluate_semantic_instance.py", segment3d, **HERE),
    Original(tuple(f"openscan-{aspect}" for aspect in ASPECTS), OPENSCAN, openscan, **HERE),
    Original(("replica-openmask3d",), "evaluate/replica/eval_semantic_instance.py", openyolo3d, **HERE),
    Original(("opensun3d-challenge",), OPENSUN3D, opensun3d, **HERE),
    Original(("scannetpp-instance",), "semantic/eval/eval_instance.py", scannetpp, drawn, ours, keep),
)
