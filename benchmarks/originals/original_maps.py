"""HOV-SG's and OpenLex3D's scripts on synthetic files of Replica and maps; they need plyfile, queries also faiss.

Open3D orders the voxels of a cloud by chance, unless it has one thread as here.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import json
import os
import tempfile
import types
from pathlib import Path
from typing import Any

import numpy as np
from original_code import STOPS, Ask, Original, load, recorded, silence
from original_instances import emptied
from original_points import SHORT
from places import CASES
from synthetic_maps import DIMENSIONS, ORIGINAL, PROMPTS, RELEASE, Problem, PromptEncoder, Scene, values_of, written
from threadpoolctl import threadpool_limits

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.metrics.protocols.model import ProtocolRules

HYDRA = {"hydra": {"main": lambda **_: lambda function: function}}
SEABORN = {"seaborn": {"color_palette": lambda *_, n_colors: [(0.0, 0.0, 0.0)] * n_colors}}
LEX_SCRIPT, LEX_QUERIES = (f"openlex3d/scripts/evaluate_{name}.py" for name in ("segmentation", "queries"))
HOVSG_FUNCTIONS = ("mean_iou", "frequency_weighted_iou", "mean_accuracy", "pixel_accuracy")


def _mesh(rng: np.random.Generator) -> tuple[Scene, Int64Array]:
    """A mesh whose objects share corners and positions, some of them not listed; and the positions of its vertices."""
    ids = rng.choice(60, rng.integers(2, 6), replace=False)
    vertices = rng.integers(0, rng.integers(6, 20), (rng.integers(8, 50), 3)) * 16
    vertices[-2:] = vertices[:2]
    faces = [rng.choice(len(vertices), rng.integers(3, 5), replace=False).tolist() for _ in range(rng.integers(6, 70))]
    kinds = rng.choice([*range(1, 102), 0, -1], len(ids)).tolist()
    listed = {str(one): kind for one, kind in zip(ids, kinds, strict=True) if rng.random() < 0.75}
    scene = {
        "per_m": int(rng.choice([1000, 1024])),  # on binary fractions more distances are equal
        "vertices": vertices.tolist(),
        "faces": faces,
        "owner": rng.choice(ids, len(faces)).tolist(),
        "listed": listed,
    }
    return scene, vertices


def _near(rng: np.random.Generator, vertices: Int64Array, n: int) -> Int64Array:
    """Positions on vertices, halfway between two, beside them, and of one another."""
    one, other = (vertices[rng.integers(0, len(vertices), n)] for _ in range(2))
    places = np.where(rng.random((n, 1)) < 0.3, (one + other) // 2, one)
    beside = rng.random((n, 1)) < 0.4
    places = np.where(beside, places + rng.integers(-2, 3, (n, 3)) * 8, places)
    return np.asarray(np.where(rng.random((n, 1)) < 0.15, places[rng.integers(0, n, n)], places))


def drawn_for_hovsg(seed: int, index: int) -> Problem:
    """Problem ``index``: objects with coincident points, on the corners of faces and between them."""
    rng, scenes = np.random.default_rng([seed, index, 6]), []
    for _ in range(rng.integers(1, 3)):
        scene, vertices = _mesh(rng)
        there = [kind for kind in scene["listed"].values() if kind > 0] or [1]
        sizes = rng.integers(1, 40, rng.integers(1, 6))
        points = _near(rng, vertices, int(sizes.sum()))
        scene["clouds"] = [part.tolist() for part in np.split(points, np.cumsum(sizes)[:-1])]
        scene["called"] = rng.choice([*there, *there, 0, rng.integers(1, 102)], len(sizes)).tolist()
        scenes.append(scene)
    return scenes


def drawn_for_openlex3d(seed: int, index: int) -> Problem:
    """Problem ``index``: objects with labels that are not listed, voxels of two points, visible points between both."""
    rng, scenes = np.random.default_rng([seed, index, 7]), []
    for _ in range(rng.integers(1, 3)):
        scene, vertices = _mesh(rng)
        ids = rng.permutation(list({0, *rng.choice(60, 2).tolist(), *scene["owner"]})).tolist()
        tiers = [rng.choice(PROMPTS, n, replace=False).tolist() for n in rng.integers(0, 4, 3 * len(ids))]
        clutter = [rng.choice(ids, rng.integers(0, 2)).tolist() for _ in ids]
        objects = {str(one): [*tiers[3 * k : 3 * k + 3], clutter[k]] for k, one in enumerate(ids)}
        scene["objects"] = {one: labels for one, labels in objects.items() if rng.random() < 0.85}
        scene["visible"] = [*_near(rng, vertices, int(rng.integers(5, 40))).tolist(), [9000, 0, 0]]
        n_objects, n_points = int(rng.integers(1, 7)), int(rng.choice([2, 3, rng.integers(4, 150)]))
        scene["cloud"] = _near(rng, vertices, n_points).tolist()
        scene["index"] = rng.integers(0, n_objects, n_points).tolist()
        scene["features"] = rng.normal(size=(n_objects, DIMENSIONS)).round(3).tolist()
        scenes.append(scene)
    return scenes


def drawn_with_queries(seed: int, index: int) -> Problem:
    """Problem ``index`` with texts that ask for objects, some of them without points."""
    rng, scenes = np.random.default_rng([seed, index, 8]), drawn_for_openlex3d(seed, index)
    for scene in scenes:
        ids = [*map(int, scene["objects"]), *set(scene["owner"]), 99]
        texts = rng.choice(PROMPTS, rng.integers(1, 5), replace=False).tolist()
        scene["queries"] = {text: rng.permutation(list({*rng.choice(ids, 3).tolist()})).tolist() for text in texts}
    return scenes


def hovsg(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """Its main function on the files of each scene; the features of objects and classes are axes."""
    others = ["omegaconf", "open_clip", "segment_anything", "torchmetrics", "cv2", "matplotlib.pyplot", "PIL"]
    script = checkout / "application/eval/evaluate_sem_seg.py"
    module = load(script, [checkout], absent=others, replaced=HYDRA | {"sklearn.manifold": {"TSNE": None}})
    model = types.SimpleNamespace(eval=lambda: None)
    module.open_clip = types.SimpleNamespace(create_model_and_transforms=lambda *_, **__: (model, None, None))
    axis = {"background": 0, **dict(zip(replica_label_set().names, replica_label_set().ids, strict=True))}
    module.text_prompt = lambda _, __, features, labels, **___: features[:, [axis[name] for name in labels]]
    answers = [recorded(module, name) for name in HOVSG_FUNCTIONS]
    colours = folder / "colours.json"
    colours.write_text(json.dumps({one: [0, 0, 0] for one in range(-1, 102)}))
    clip = types.SimpleNamespace(type="ViT-H-14", checkout="", checkpoint="")

    def ask(problem: Problem) -> Float64Array:
        root = emptied(folder / "files")
        for one in answers:
            one.clear()
        with contextlib.chdir(root):  # it writes a file of colours
            for name in written(root, problem):
                words = {"feature_map_path": root / "maps" / name, "replica_color_map": colours, "device": "cpu"}
                place = {"replica_dataset_gt_path": str(root / ORIGINAL), "scene_name": name.replace("room", "room_")}
                main = types.SimpleNamespace(**words, **place, dataset="replica")
                module.main(types.SimpleNamespace(main=main, models=types.SimpleNamespace(clip=clip)))
        rows = np.array(answers, float).T
        if not np.isfinite(rows).all():
            raise ArithmeticError("it divides by zero")
        return rows

    return ask


def openlex3d(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """Its main function on the files of each scene, with its own settings and given text features."""
    import yaml

    module = load(checkout / LEX_SCRIPT, [checkout], absent=["omegaconf"], replaced=HYDRA | SEABORN)
    module.load_model = _given_texts
    results: list[dict[str, Any]] = []
    module.save_results = lambda **found: results.append(found["results"])
    settings = yaml.safe_load((checkout / "openlex3d/config/eval_segmentation.yaml").read_text())["evaluation"]
    is_ranking = rules.metric == "openlex3d-ranking"
    settings |= {"freq": not is_ranking, "set_ranking": is_ranking, "output_path": "", "algorithm": "given"}

    def ask(problem: Problem) -> Float64Array:
        root, before = emptied(folder / "files"), len(results)
        os.environ["OMP_NUM_THREADS"] = "1"
        with threadpool_limits(1):
            for name in written(root, problem):
                paths = {"path": root / ORIGINAL, "openlex3d_path": root / RELEASE}
                dataset = types.SimpleNamespace(name="replica", scene=name, **paths)
                evaluation = types.SimpleNamespace(**settings | {"predictions_path": root / "maps" / name})
                module.main(types.SimpleNamespace(dataset=dataset, evaluation=evaluation, model=None))
        part = "ranking" if is_ranking else "freq"
        return np.array([[found[part][name] for name in rules.value_names] for found in results[before:]], float)

    return ask


def _given_texts(settings: object) -> Any:
    base: Any = importlib.import_module("openlex3d.models.base").VisualLanguageEncoder
    texts = {"compute_text_features": lambda self, prompts, **_: PromptEncoder().encode_texts(prompts)}
    return type("Given", (base,), texts)()


def openlex3d_queries(rules: ProtocolRules, checkout: Path, folder: Path) -> Ask:
    """Its matches of each scene and their AP, with its own settings and given text features; needs faiss."""
    import yaml

    module = load(checkout / LEX_QUERIES, [checkout], absent=["omegaconf"], replaced=HYDRA | SEABORN)
    vars(importlib.import_module("openlex3d.core.cosine_similarity"))["load_model"] = _given_texts
    vars(importlib.import_module("openlex3d.core.align_masks"))["use_gpu"] = False
    settings = yaml.safe_load((checkout / "openlex3d/config/eval_query.yaml").read_text())
    settings["evaluation"]["predictions_path"] = folder / "files/maps"
    parts = {name: types.SimpleNamespace(**settings[name]) for name in ("masks", "evaluation")}
    dataset = types.SimpleNamespace(name="replica", path=folder / "files" / ORIGINAL)
    paths = types.SimpleNamespace(openlex_gt_path=folder / "files" / RELEASE, output_path=folder / "out")
    words = types.SimpleNamespace(**parts, dataset=dataset, paths=paths, model=None)

    def ask(problem: Problem) -> Float64Array:
        matches: dict[str, Any] = {}
        for name in written(emptied(folder / "files"), problem):
            matches |= module.get_matches_for_scene(words, name)[0]
        found = module.compute_ap_averages(module.compute_ap(matches)[0], factor=1)
        return np.array([[found[key] for key in ("all_ap", "all_ap_50%", "all_ap_25%")]], float)

    return ask


def ours(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The values of each scene, of queries those of all scenes."""
    with tempfile.TemporaryDirectory() as folder, silence():
        return values_of(rules, problem, Path(folder))


def keep(rules: ProtocolRules, ask: Ask, seed: int, n: int) -> None:
    """The original's answers to the first ``n`` problems with a new answer."""
    drawn = next(one.drawn for one in ORIGINALS if rules.name in one.protocols)
    kept: dict[str, str] = {}
    for problem in (drawn(seed, index) for index in itertools.count()):
        with silence():
            try:
                values = ask(problem)
            except STOPS:
                continue
        answer = [[None if one != one else one for one in row] for row in values.tolist()]
        kept.setdefault(str(answer), json.dumps({"scenes": problem, "answer": answer}, separators=SHORT))
        if len(kept) == n:
            break
    file = CASES / "originals_maps.json"
    content = json.loads(file.read_text()) if file.exists() else {}
    rows = {name: [json.dumps(one, separators=SHORT) for one in cases] for name, cases in content.items()}
    rows[rules.name] = list(kept.values())
    file.write_text("{" + ",\n".join(f'"{key}": [\n' + ",\n".join(each) + "]" for key, each in rows.items()) + "}\n")


ORIGINALS = (
    Original(("replica-hovsg",), "application/eval/evaluate_sem_seg.py", hovsg, drawn_for_hovsg, ours, keep),
    Original(
        ("openlex3d-topn", "openlex3d-ranking"),
        LEX_SCRIPT,
        openlex3d,
        drawn_for_openlex3d,
        ours,
        keep,
    ),
    Original(("openlex3d-queries",), LEX_QUERIES, openlex3d_queries, drawn_with_queries, ours, keep),
)
