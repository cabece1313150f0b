"""ScanNet's script on synthetic text query problems, with each query of a scene as a separate scene."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
from original_code import Ask, Original, load, of_python_3, recorded, silence
from original_instances import SCANNET, emptied
from places import CASES
from synthetic_queries import Problem, objects_of, scored

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.protocols.model import ProtocolRules

ASKED, OTHER = 3, 4  # labels of the two classes; other objects are not void, so masks on them are wrong


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: objects of several queries or none, equal cosines, duplicate or empty masks, queries without
    an object, large ids, scenes without one.
    """
    rng = np.random.default_rng([seed, index])
    scenes = []
    for _ in range(rng.integers(1, 3)):
        ids = [int(one) for one in rng.permutation(rng.integers(1, 7)) + rng.choice([0, 0, 900])]
        share = 0.85 if rng.random() < 0.95 else 0.0
        objects = [[one if rng.random() < share else -1, int(rng.integers(1, 12))] for one in ids]
        starts = np.cumsum([0, *(length for _, length in objects)]).tolist()
        there = [one for one, _ in objects if one >= 0] or [99]  # an object without points
        queries = [sorted(rng.choice(there, min(len(there), n), replace=False).tolist()) for n in rng.integers(0, 4, 3)]
        masks: list[list[int]] = []
        for _ in range(rng.choice([0, 2, 4, 7])):
            run = int(rng.integers(len(objects)))
            start = int(rng.integers(max(0, starts[run] - 1), starts[run] + 2))
            end = int(rng.integers(start + 1, starts[run + 1] + 3))
            near = [min(start, starts[-1] - 1), min(max(end, start + 1), starts[-1])]
            masks.append(masks[-1] if masks and rng.random() < 0.15 else near)
        cosines = np.round(rng.uniform(-1, 1, (len(masks), len(queries))), rng.choice([0, 1, 12])).tolist()
        scenes.append({"objects": objects, "queries": queries, "masks": masks, "cosines": cosines})
    return scenes


def scannet(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """AP, AP50, AP25 and the AP at each threshold of the query's objects, with the protocol's minimum size."""
    code = of_python_3(checkout / "BenchmarkScripts", folder / "code")
    words = ["--pred_path", str(folder / "pred"), "--gt_path", str(folder / "gt")]
    module = load(code / "3d_evaluation/evaluate_semantic_instance.py", [code], words, ["plyfile", "imageio"])
    module.CLASS_LABELS, module.VALID_CLASS_IDS = ["object", "other"], np.array([ASKED, OTHER])
    module.ID_TO_LABEL = {ASKED: "object", OTHER: "other"}
    module.opt.min_region_sizes = np.array([rules.min_region_size])
    tables, averages = recorded(module, "evaluate_matches"), recorded(module, "compute_averages")

    def ask(problem: Problem) -> Float64Array:
        pred, truth, names = emptied(folder / "pred"), emptied(folder / "gt"), []
        (pred / "masks").mkdir()
        for s, scene in enumerate(problem):
            objects = objects_of(scene)
            for q, ids in enumerate(scene["queries"]):
                names.append(f"{s}_{q}.txt")
                values = np.where(np.isin(objects, ids), ASKED * 1000 + 1 + objects, OTHER * 1000 + 1)
                np.savetxt(truth / names[-1], values, fmt="%d")
                lines = []
                cosines = [row[q] for row in scene["cosines"]]
                for k in np.argsort(-np.array(cosines), kind="stable").tolist():  # in a submission's ranking order
                    mask = scene["masks"][k]
                    file = f"masks/{s}_{q}_{k:03d}.txt"
                    np.savetxt(pred / file, np.isin(np.arange(len(objects)), np.arange(*mask)), fmt="%d")
                    lines.append(f"{file} {ASKED} {cosines[k]!r}\n")
                (pred / names[-1]).write_text("".join(lines))
        files = [[str(where / name) for name in names] for where in (pred, truth)]
        module.evaluate(*files, str(pred), str(folder / "answer.txt"))
        of_object = averages[-1]["classes"]["object"]
        means = [float(of_object[name]) for name in ("ap", "ap50%", "ap25%")]
        return np.array([*means, *tables[-1][0][0]], float)

    return ask


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The same by this program."""
    curve = scored(rules, problem)
    return np.array([curve.ap, curve.ap50, curve.ap25, *curve.table[0]], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems with a new answer."""
    kept: dict[str, str] = {}
    for problem in (drawn(seed, index) for index in itertools.count()):
        with silence():
            answer = [None if value != value else float(value) for value in ask(problem)]
        kept.setdefault(str(answer), json.dumps({"scenes": problem, "answer": answer}, separators=(",", ":")))
        if len(kept) == n:
            break
    source = "evaluate_semantic_instance.py of ScanNet/ScanNet, at the commit in the protocol's file"
    text = f'{{"source": "{source}",\n"problems": [\n' + ",\n".join(kept.values()) + "]}\n"
    (CASES / "queries01_scannet.json").write_text(text)


ORIGINALS = (Original(("query-ap",), SCANNET, scannet, drawn, ours, keep),)
