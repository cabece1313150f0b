"""Original evaluators of instances, each on the same synthetic problems."""

from __future__ import annotations

import contextlib
import json
import shutil
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from original_code import STOPS, Ask, Original, load, of_python_3, recorded, silence, without_gpu
from places import CASES
from synthetic_instances import (
    BEYOND,
    LEFT_OUT,
    NO_CLASS,
    SCORED,
    UNKNOWN,
    VOID,
    Problem,
    Scene,
    classes_of,
    columns_of,
    is_text_only,
    members_of,
    scored,
    scored_text,
    values_of,
)

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.instance import average_precision
from su3d_bench.metrics.protocols.model import ProtocolRules

SCANNET = "BenchmarkScripts/3d_evaluation/evaluate_semantic_instance.py"
SHORT = (",", ":")
MAX_CLASSES = 200  # classes in a list
Answer = Float64Array  # AP, AP50, AP25, then the AP of each slot at each threshold


LENGTHS = (1, 20, 60, 99, 100, 101, 150, 200, 400)  # around the minimum size of 100 points
SLOTS = (*SCORED, *SCORED, 0, LEFT_OUT, NO_CLASS, NO_CLASS, BEYOND)
SCORES = (0.0, 1.0, -0.5, 2.0, 1e-12)


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: one to three scenes with ties, duplicates, empty and small masks, and missing classes; void,
    objects and masks without a class or above every list, objects in several parts, with numbers that restart with each
    class, of 0 or up to 999; shuffled points; scenes of one point, without an object, or with masks of class 0 only.
    """
    rng = np.random.default_rng([seed, index])
    one_score = np.float32(rng.random())
    return [_drawn_scene(rng, one_score) for _ in range(rng.integers(1, 4))]


def _drawn_scene(rng: np.random.Generator, one_score: np.float32) -> Scene:
    numbering, is_bare, has_classes = (
        rng.choice(["apart", "restarting", "any"]),
        rng.random() < 0.05,
        rng.random() > 0.1,
    )
    truth: list[list[int]] = []
    for place in range(1, rng.integers(2, 9)):
        slot = VOID if is_bare else int(rng.choice([*SLOTS, VOID]))
        number = {"apart": place, "restarting": int(rng.integers(1, 4)), "any": int(rng.integers(0, 1000))}[numbering]
        truth.append([slot, 0 if slot == VOID else number, int(rng.choice(LENGTHS))])
    if rng.random() < 0.03:
        truth = [[*truth[0][:2], 1]]
    starts = np.cumsum([0, *(length for *_, length in truth)]).tolist()
    masks: list[dict[str, Any]] = []
    for _ in range(rng.choice([0, 1, 2, 4, 6, 8])):
        if masks and rng.random() < 0.15:
            mask = {**masks[int(rng.integers(len(masks)))]}  # a duplicate, with the same or another score
        else:
            run = int(rng.integers(len(truth)))
            is_own = rng.random() < 0.7 and truth[run][0] != VOID
            slot = truth[run][0] if is_own else int(rng.choice(SLOTS))
            mask = {"slot": slot if has_classes else NO_CLASS, "runs": _drawn_runs(rng, starts, run)}
        drawn_score = rng.choice(SCORES) if rng.random() < 0.15 else np.float32(rng.random())
        mask["score"] = float(one_score if rng.random() < 0.3 else drawn_score)
        masks.append(mask)
    order = int(rng.integers(1000)) if rng.random() < 0.3 else None
    masked = sorted(rng.integers(0, starts[-1] + 1, 2).tolist()) if rng.random() < 0.3 else [0, 0]
    return {"truth": truth, "masks": masks, "order": order, "masked": masked}


def _drawn_runs(rng: np.random.Generator, starts: list[int], run: int) -> list[list[int]]:
    if (kind := rng.random()) < 0.06:
        return [] if kind < 0.03 else [[0, starts[-1]]]
    first, last = starts[run], starts[run + 1]
    if kind < 0.25:  # the whole of it, or a half: an IoU of a threshold
        return [[first, last if kind < 0.2 else (first + last + 1) // 2]]
    start = int(rng.integers(max(0, first - 60), last))
    runs = [[start, int(rng.integers(start, min(starts[-1], last + 60) + 1))]]
    if rng.random() < 0.2:  # a second part elsewhere
        beyond = int(rng.integers(runs[0][1], starts[-1] + 1))
        runs.append([beyond, min(starts[-1], beyond + int(rng.integers(0, 200)))])
    return [one for one in runs if one[0] < one[1]] or [[first, first + 1]]


@dataclass(frozen=True)
class Given:
    """A scene in the evaluators' form: ``values`` (N,) class * 1000 + number, and K masks with classes and scores."""

    values: Int64Array
    masks: BoolArray
    class_ids: Int64Array
    scores: Float64Array

    @classmethod
    def of(cls, scene: Scene, ids: dict[int, int], *, are_numbers: bool = False) -> Given:
        values = values_of(scene, ids, are_numbers=are_numbers)
        masks = np.zeros((len(scene["masks"]), len(values)), bool)
        for row, members in zip(masks, members_of(scene), strict=True):
            row[members] = True
        class_ids = np.array([ids[mask["slot"]] for mask in scene["masks"]], np.int64)
        return cls(values, masks, class_ids, np.array([mask["score"] for mask in scene["masks"]], float))

    def write_truth(self, file: Path) -> None:
        np.savetxt(file, self.values, fmt="%d")


def emptied(folder: Path) -> Path:
    """The folder, emptied."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def answered(table: Any, averages: dict[str, Any], rows: list[int]) -> Answer:
    """An answer from an original's table (1, C, T) and averages."""
    means = [averages[name] for name in ("all_ap", "all_ap_50%", "all_ap_25%")]
    return np.array([*means, *np.asarray(table)[0][rows].ravel()], float)


def scannet(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """ScanNet's script, over text files."""
    code = of_python_3(checkout / "BenchmarkScripts", folder / "code")
    script = code / "3d_evaluation/evaluate_semantic_instance.py"
    words = ["--pred_path", str(folder / "pred"), "--gt_path", str(folder / "gt")]
    module = load(script, [code], words, ["plyfile", "imageio"])
    ids, _ = classes_of(rules)
    rows = [module.VALID_CLASS_IDS.tolist().index(ids[one]) for one in SCORED]
    tables, averages = recorded(module, "evaluate_matches"), recorded(module, "compute_averages")

    def answer(problem: Problem, *, are_ones: bool) -> Answer:
        pred, truth = emptied(folder / "pred"), emptied(folder / "gt")
        (pred / "masks").mkdir()
        for s, scene in enumerate(problem):
            one, lines = Given.of(scene, ids), []
            one.write_truth(truth / f"{s}.txt")
            for k, mask in enumerate(one.masks):
                np.savetxt(pred / f"masks/{s}_{k:03d}.txt", mask, fmt="%d")
                lines.append(f"masks/{s}_{k:03d}.txt {one.class_ids[k]} {float(one.scores[k])!r}\n")
            (pred / f"{s}.txt").write_text("".join(lines))
        files = [[str(where / f"{s}.txt") for s in range(len(problem))] for where in (pred, truth)]
        module.evaluate(*files, str(pred), str(folder / "answer.txt"))
        return answered(tables[-1], averages[-1], rows)

    return both_rankings(rules, answer)


def of_arrays(
    module: types.ModuleType,
    folder: Path,
    rules: ProtocolRules,
    classes: list[int],
    ids_of_script: Callable[[Any], Any] = np.asarray,
    **named: Any,
) -> Ask:
    """Scripts that take masks, scores and classes as arrays; ``ids_of_script`` converts our class ids to theirs."""
    tables, averages = recorded(module, "evaluate_matches"), recorded(module, "compute_averages")
    ids, _ = classes_of(rules)

    def answer(problem: Problem, *, are_ones: bool) -> Answer:
        truth, predicted = emptied(folder / "gt"), {}
        for s, scene in enumerate(problem):
            one = Given.of(scene, ids, are_numbers=rules.class_agnostic == "numbered")
            one.write_truth(truth / f"{s}.txt")
            predicted[str(s)] = {
                "pred_masks": one.masks.T,
                "pred_scores": np.ones(len(one.scores)) if are_ones else one.scores,
                "pred_classes": ids_of_script(one.class_ids),
            }
        module.evaluate(predicted, str(truth), **named)
        table = tables[-1][0] if isinstance(tables[-1], tuple) else tables[-1]
        return answered(table, averages[-1], classes)

    return both_rankings(rules, answer)


def both_rankings(rules: ProtocolRules, answer: Callable[..., Answer]) -> Ask:
    """The answer by the protocol's confidences, then by those of the prediction."""

    def ask(problem: Problem) -> Answer:
        return np.concatenate([answer(problem, are_ones=rules.confidence == "ones"), answer(problem, are_ones=False)])

    return ask


def openmask3d(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """OpenMask3D's script for ScanNet200, by both rankings."""
    home = checkout / "openmask3d/evaluation"
    module = load(home / "eval_semantic_instance.py", [home], absent=["plyfile", "imageio"])
    return of_arrays(
        module, folder, rules, rows_of(rules), dataset="scannet200", output_file=str(folder / "answer.txt")
    )


def rows_of(rules: ProtocolRules) -> list[int]:
    """The rows of the slots in the table of a protocol."""
    if rules.class_agnostic is not None:
        return [0]
    ids, places = classes_of(rules)[0], [entry.id for entry in rules.scored]
    return [places.index(ids[one]) for one in SCORED]


def maskclustering(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """MaskClustering's script, with --no_class if the protocol has no classes; by both rankings."""
    without_gpu()
    of_data = "scannetpp" if "scannetpp" in rules.datasets else "scannet"
    words = ["--pred_path", str(folder / "pred"), "--gt_path", str(folder / "gt"), "--dataset", of_data]
    words += ["--output_file", str(folder / "class_agnostic.txt"), *([] if rules.names_masks else ["--no_class"])]
    module = load(checkout / "evaluation/evaluate.py", [checkout], words)
    # for ScanNet++ it is quadratic in 1,554 classes, seconds per problem; classes in no problem are undefined
    module.CLASS_LABELS, module.VALID_CLASS_IDS = (
        module.CLASS_LABELS[:MAX_CLASSES],
        module.VALID_CLASS_IDS[:MAX_CLASSES],
    )
    known = list(module.VALID_CLASS_IDS)
    ids = UNKNOWN | {LEFT_OUT: 2, **{k: known[7 * k + 3] for k in SCORED}}  # 2 is not one of its classes
    return of_archives(module, folder, rules, ids, known)


def of_archives(
    module: types.ModuleType, folder: Path, rules: ProtocolRules, ids: dict[int, int], known: list[int]
) -> Ask:
    """MaskClustering's script and its copies, over archives."""
    rows = [known.index(ids[one]) for one in SCORED] if rules.names_masks else [0]
    tables, averages = recorded(module, "evaluate_matches"), recorded(module, "compute_averages")

    def answer(problem: Problem, *, are_ones: bool) -> Answer:
        pred, truth = emptied(folder / "pred"), emptied(folder / "gt")
        for s, scene in enumerate(problem):
            one = Given.of(scene, ids)
            one.write_truth(truth / f"{s}.txt")
            arrays = {"pred_masks": one.masks.T, "pred_classes": one.class_ids}
            scores = np.ones(len(one.scores)) if are_ones else one.scores
            np.savez(pred / f"{s}.npz", pred_score=scores, **arrays)
        files = [
            [str(pred / f"{s}.npz") for s in range(len(problem))],
            [f"{truth}/{s}.txt" for s in range(len(problem))],
        ]
        module.evaluate(*files, str(pred), str(folder / "answer.txt"))
        return answered(tables[-1], averages[-1], rows)

    return both_rankings(rules, answer)


def open3dis(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """Open3DIS' evaluator: its 198 classes of ScanNet200, or its 84 of ScanNet++; by both rankings."""
    home = checkout / "open3dis"
    module = load(home / "evaluation/scannetv2_inst_eval.py", [checkout], absent=["plyfile"])
    ids, names = classes_of(rules)
    if is_scannetpp := "scannetpp" in rules.datasets:
        lists = load(home / "dataset/scannetpp.py", [])
        labels, every = lists.INSTANCE_BENCHMARK84_SCANNET_PP, lists.SEMANTIC_INSTANCE_BENCHMARK84_SCANNET_PP
        numbers = {one: every.index(names[one]) for one in (LEFT_OUT, *SCORED)}
    else:
        labels = load(home / "dataset/scannet200.py", []).INSTANCE_CAT_SCANNET_200
        numbers = {LEFT_OUT: 0, **{one: labels.index(names[one]) + 2 for one in SCORED}}  # 0 and 1: wall and floor
    numbers[BEYOND] = 5000
    first = 16 if is_scannetpp else 2  # classes before those of instances
    kind = "scannetpp_benchmark" if is_scannetpp else "scannet200"
    judge = module.ScanNetEval(class_labels=labels, use_label=rules.names_masks, dataset_name=kind)
    tables = recorded(judge, "evaluate_matches")
    rows = [numbers[one] - first for one in SCORED] if rules.names_masks else [0]

    def answer(problem: Problem, *, are_ones: bool) -> Answer:
        semantic, instance, predicted = [], [], []
        for s, scene in enumerate(problem):
            slots, number = columns_of(scene)
            semantic.append(np.array([numbers.get(one, -100) for one in slots.tolist()], np.int32))
            instance.append(np.where(slots == VOID, -100, number - 1).astype(np.int32))
            one = Given.of(scene, ids)
            predicted.append(
                [
                    {
                        "scan_id": str(s),
                        "label_id": numbers.get(mask["slot"], -100) - first + 1,
                        "conf": 1.0 if are_ones else mask["score"],
                        "pred_mask": row,
                    }
                    for mask, row in zip(scene["masks"], one.masks, strict=True)
                ]
            )
        averages = judge.evaluate(predicted, semantic, instance, str(folder))
        return answered(tables[-1][0], averages, rows)

    return both_rankings(rules, answer)


def ours(rules: ProtocolRules, problem: Problem) -> Answer:
    """This program's answer by both rankings, from text files; infinite if points with labels give another."""
    answers = []
    for ranked in (rules, rules.model_copy(update={"confidence": "prediction"})):
        answer = _answer(ranked, scored_text(ranked, problem))
        if not any(is_text_only(ranked, scene) for scene in problem):
            of_points = _answer(ranked, [scored(ranked, scene | {"masked": [0, 0]}) for scene in problem])
            answer = np.where((answer == of_points) | np.isnan(answer) & np.isnan(of_points), answer, np.inf)
        answers.append(answer)
    return np.concatenate(answers)


def _answer(rules: ProtocolRules, scores: list[Any]) -> Answer:
    curve = average_precision.combine([score.counts for score in scores], rules.thresholds)
    return np.array([curve.ap, curve.ap50, curve.ap25, *curve.table[rows_of(rules)].ravel()], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems in the file of cases that it answers."""
    file = CASES / "originals_instance.json"
    content = json.loads(file.read_text())
    kept: dict[str, list[float | None]] = {}
    for number, problem in content["problems"].items():
        with contextlib.suppress(*STOPS), silence():
            kept[number] = [None if value != value else float(value) for value in ask(problem)[:3]]
        if len(kept) == n:
            break
    content["answers"] = dict(sorted({**content["answers"], rules.name: kept}.items()))
    parts = [f'{{"origin": {json.dumps(content["origin"])}']
    for name in ("problems", "answers"):
        lines = [f'"{key}": {json.dumps(value, separators=SHORT)}' for key, value in content[name].items()]
        parts.append(f'"{name}": {{\n' + ",\n".join(lines) + "}")
    file.write_text(",\n".join(parts) + "}\n")


HERE = {"drawn": drawn, "ours": ours, "keep": keep}
ORIGINALS = (
    Original(("scannet-instance",), SCANNET, scannet, **HERE),
    Original(("scannet200-instance",), "openmask3d/evaluation/eval_semantic_instance.py", openmask3d, **HERE),
    Original(
        ("class-agnostic-maskclustering", "scannetpp-open-vocabulary"), "evaluation/evaluate.py", maskclustering, **HERE
    ),
    Original(
        ("class-agnostic-open3dis", "class-agnostic-open3dis-scannetpp", "scannetpp-open-vocabulary"),
        "open3dis/evaluation/scannetv2_inst_eval.py",
        open3dis,
        **HERE,
    ),
)
