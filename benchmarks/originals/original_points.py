"""Original evaluators with one class per point, each on the same synthetic problems."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import pickle
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from original_code import STOPS, Ask, Original, load, of_python_3, recorded, silence, without_gpu
from places import CASES
from synthetic_points import BETWEEN, BEYOND, OTHER, VOID, Problem, classes_of, ids_of, scored, scored_text

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import ProtocolResult, combine

SHORT = (",", ":")
OF_CONCEPTGRAPHS = {
    "mIoU": "miou", "F-mIoU": "fmiou", "mAcc": "recall", "mPrecision": "precision", "mF1-conceptgraphs": "f1score"
}  # fmt: skip


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index`` on identical points: missing classes, void, no predictions, wrong classes, ids of no class."""
    rng = np.random.default_rng([seed, index])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        there = rng.choice(8, rng.integers(1, 5), replace=False)
        truth = rng.choice([*there, *there, OTHER, BEYOND, BETWEEN, VOID], n := int(rng.integers(1, 18)))
        guess = rng.choice([*range(BETWEEN + 1), VOID], n)
        if rng.random() < 0.1:
            guess = truth = np.full(n, rng.choice([OTHER, BEYOND, BETWEEN, VOID]))
        scenes.append({"truth": truth.tolist(), "called": np.where(rng.random(n) < 0.5, truth, guess).tolist()})
    return scenes


def drawn_in_space(seed: int, index: int) -> Problem:
    """Problem ``index`` with three clouds (ground truth, prediction, points to score); some points coincide.

    The prediction only has classes that are scored and true in the scene.
    """
    rng = np.random.default_rng([seed, index, 3])
    scenes = []
    for _ in range(rng.integers(1, 4)):
        there = rng.choice(8, rng.integers(1, 5), replace=False)
        clouds = [rng.integers(0, 1000, (rng.integers(4, 14), 3)) for _ in range(3)]
        for cloud in clouds:
            cloud[-1] = clouds[0][rng.integers(len(clouds[0]))]
        truth = [*there, *rng.choice([*there, OTHER], len(clouds[0]))][: len(clouds[0])]
        scored = sorted({int(one) for one in truth} - {OTHER})
        scenes.append(
            {
                "truth": [int(one) for one in truth],
                "called": rng.choice(scored, len(clouds[1])).tolist(),
                **{key: cloud.tolist() for key, cloud in zip(("places_mm", "own_mm", "seen_mm"), clouds, strict=True)},
            }
        )
    return scenes


def scannet(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """ScanNet's script on text files; with the lists of BenchmarkScripts/ScanNet200 if the protocol has 200."""
    code = of_python_3(checkout / "BenchmarkScripts", folder / "code")
    script = code / "3d_evaluation/evaluate_semantic_label.py"
    module = load(script, [code], ["--pred_path", str(folder), "--gt_path", str(folder)], ["plyfile", "imageio"])
    if len(rules.classes) > 100:
        lists = load(code / "ScanNet200/scannet200_constants.py", [])
        module.CLASS_LABELS, module.VALID_CLASS_IDS = lists.CLASS_LABELS_200, np.array(lists.VALID_CLASS_IDS_200)
        module.UNKNOWN_ID = np.max(module.VALID_CLASS_IDS) + 1
    of_slot = ids_of(rules)

    def ask(problem: Problem) -> Float64Array:
        confusion = np.zeros((module.UNKNOWN_ID + 1,) * 2, np.ulonglong)
        for scene in problem:
            for name in ("called", "truth"):
                np.savetxt(folder / f"{name}.txt", [of_slot[k] for k in scene[name]], fmt="%d")
            module.evaluate_scan(str(folder / "called.txt"), str(folder / "truth.txt"), confusion)
        found = [module.get_iou(of_slot[k], confusion) for k in range(OTHER)]
        return np.array([one[0] if isinstance(one, tuple) else one for one in found], float)

    return ask


def our_classes(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The IoU of each slot from text files, infinite if points with labels give another."""
    names = [name for slot, (_, name) in classes_of(rules).items() if slot != OTHER]
    rows = [_ours(rules, problem, way).per_class for way in (scored_text, scored)]
    text, points = np.array([[of_way.get(name, {}).get("IoU", np.nan) for name in names] for of_way in rows], float)
    return np.where((text == points) | np.isnan(text) & np.isnan(points), text, np.inf)


def _ours(rules: ProtocolRules, problem: Problem, way: Callable[..., SceneScore] = scored) -> ProtocolResult:
    return combine(rules, {str(s): way(rules, scene) for s, scene in enumerate(problem)}, with_intervals=False)


def conceptgraphs(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """ConceptGraphs' script, starting from files of maps and clouds.

    Instead of the text encoder, each class has its own axis; the clouds are passed in rather than read from
    HDF5, and the GPU's nearest-neighbour search is replaced by a sequential float32 search.
    """
    import torch

    without_gpu()
    clouds: dict[str, Any] = {}
    n_classes = 52
    model = types.SimpleNamespace(to=lambda device: model, encode_text=lambda text: torch.eye(n_classes))
    replaced = {
        "open_clip": {
            "create_model_and_transforms": lambda *_: (model, None, None),
            "get_tokenizer": lambda name: lambda prompts: torch.zeros(len(prompts)),
        },
        "chamferdist.chamfer": {"knn_points": _nearest},
        "gradslam.structures.pointclouds": {
            "Pointclouds": types.SimpleNamespace(load_pointcloud_from_h5=lambda path: clouds[str(path)])
        },
        "conceptgraph.utils.vis": {"get_random_colors": lambda n: np.zeros((n, 3))},
    }
    script = checkout / "conceptgraph/scripts/eval_replica_semseg.py"
    module = load(script, [checkout], absent=["matplotlib"], replaced=replaced)
    names = [module.REPLICA_CLASSES[k] for k in module.REPLICA_EXISTING_CLASSES]
    place = {slot: names.index(name) for slot, (_, name) in classes_of(rules).items()}
    answers = recorded(module, "compute_metrics")
    n_exclude = rules.name.rpartition("ex")[2]
    words = module.get_parser().parse_args(["--pred_exp_name", "made", "--device", "cpu", "--n_exclude", n_exclude])
    words.replica_root, words.replica_semantic_root = folder / "maps", folder / "truth"

    def ask(problem: Problem) -> Float64Array:
        clouds.clear()
        module.REPLICA_SCENE_IDS = module.REPLICA_SCENE_IDS_ = [str(s) for s in range(len(problem))]
        for s, scene in enumerate(problem):
            semantic = folder / f"truth/{s}/Sequence_1"
            semantic.mkdir(parents=True, exist_ok=True)
            np.savetxt(semantic / "traj_w_c.txt", np.eye(4).reshape(1, 16))
            kinds = torch.zeros(len(scene["truth"]), len(module.REPLICA_CLASSES))
            for row, slot in enumerate(scene["truth"]):
                kinds[row, module.REPLICA_EXISTING_CLASSES[place[slot]]] = 1
            clouds[str(semantic / "saved-maps-gt")] = _cloud(scene["places_mm"], kinds)
            clouds[str(folder / f"maps/{s}/rgb_cloud")] = _cloud(scene["seen_mm"], None)
            _write_map(folder / f"maps/{s}/pcd_saves/full_pcd_made.pkl.gz", scene, place, n_classes)
        n_before = len(answers)
        before = Path.cwd()
        os.chdir(folder)  # it writes its tables here
        try:
            module.main(words)
        finally:
            os.chdir(before)
        rows = [[np.mean(one[key]) for key in OF_CONCEPTGRAPHS.values()] for one in answers[n_before:]]
        if np.isnan(rows[-1]).any():
            raise ArithmeticError("its means cover no class if no scene has a scored point")
        return np.array(rows[-1:] + rows[:-1], float)  # all scenes first

    return ask


def _nearest(of: Any, to: Any, **_: Any) -> Any:
    """The result of the GPU's search for one neighbour: squared distances in float32, the first in a tie."""
    squared = ((of[0][:, None] - to[0][None]) ** 2).sum(-1)
    return types.SimpleNamespace(idx=squared.argmin(dim=1)[None, :, None])


def _cloud(places_mm: Sequence[Sequence[int]], embeddings: Any) -> Any:
    import torch

    points = torch.from_numpy((np.array(places_mm) / 1000).astype(np.float32))[None]
    return types.SimpleNamespace(
        points_padded=points, colors_padded=points, embeddings_padded=None if embeddings is None else embeddings[None]
    )


def _write_map(file: Path, scene: dict[str, Any], place: dict[int, int], n_classes: int) -> None:
    box, objects = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)]), []
    called, own = np.array(scene["called"]), (np.array(scene["own_mm"]) / 1000).astype(np.float32).astype(np.float64)
    for slot in sorted(set(called.tolist())):
        feature, points = np.eye(n_classes, dtype=np.float32)[place[slot]], own[called == slot]
        objects.append(
            {"clip_ft": feature, "text_ft": feature, "pcd_np": points, "bbox_np": box, "pcd_color_np": points}
        )
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(gzip.compress(pickle.dumps({"objects": objects, "bg_objects": None})))


def our_means(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The means over the classes, of all scenes and of each."""
    found = _ours(rules, problem)
    rows = [found.metrics, *(found.per_scene[str(s)] for s in range(len(problem)))]
    return np.array([[row[name] for name in OF_CONCEPTGRAPHS] for row in rows], float)


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems that it answers, all different."""
    kept, index, is_of_space = list[dict[str, Any]](), 0, rules.metric == "conceptgraphs"
    while len(kept) < n:
        problem = (drawn_in_space if is_of_space else drawn)(seed, index)
        index += 1
        with contextlib.suppress(*STOPS), silence():
            values = ask(problem)
            names = list(OF_CONCEPTGRAPHS) if is_of_space else [name for _, name in classes_of(rules).values()][:OTHER]
            first = values[0] if is_of_space else values
            answer = {name: float(value) for name, value in zip(names, first, strict=True) if value == value}
            if answer not in [one["answer"] for one in kept]:
                kept.append({"scenes": problem, "answer": answer})
    rewritten(rules.name, kept)


def rewritten(name: str, kept: list[dict[str, Any]]) -> None:
    """The file of point cases with those of one protocol replaced."""
    file = CASES / "originals_semantic.json"
    content = {**json.loads(file.read_text()), name: kept}
    blocks = [
        f'"{key}": [\n' + ",\n".join(json.dumps(one, separators=SHORT) for one in rows) + "]"
        for key, rows in content.items()
    ]
    file.write_text("{" + ",\n".join(blocks) + "}\n")


SCRIPT = "BenchmarkScripts/3d_evaluation/evaluate_semantic_label.py"
ORIGINALS = (
    Original(("scannet-semantic", "scannet200-semantic"), SCRIPT, scannet, drawn, our_classes, keep),
    Original(
        ("replica-conceptgraphs-ex6", "replica-conceptgraphs-ex4", "replica-conceptgraphs-ex1"),
        "conceptgraph/scripts/eval_replica_semseg.py",
        conceptgraphs,
        drawn_in_space,
        our_means,
        keep,
    ),
)
