"""Synthetic problems of evaluators that read Replica's meshes and maps from files: HOV-SG's and OpenLex3D's.

A problem is a list of scenes. A scene has ``vertices`` and ``faces`` with their ``owner``, the class ``listed`` for
some of the objects, and a map: for HOV-SG ``clouds`` and the class ``called`` for each; for OpenLex3D ``cloud``, the
``index`` of the object of each point and ``features``, with ``objects``, their four tiers of labels, ``visible``
points, and the objects of ``queries``. Positions are integers, ``per_m`` of them in a metre.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from prediction_files import write_hovsg, write_openlex

from su3d_bench.core.types import Float32Array, Float64Array, UInt8Array
from su3d_bench.datasets.openlex3d.release import truth_below
from su3d_bench.datasets.replica.folders import original_name, replica_label_set
from su3d_bench.datasets.replica.truth import corner_truth, read_annotated_mesh
from su3d_bench.formats.pcd import write_pcd_points
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions.dense import openlex3d
from su3d_bench.predictions.hovsg import hovsg

Scene = dict[str, Any]
Problem = list[Scene]
PROMPTS = (
    "chair", "arm chair", "table", "tv stand", "lamp", "book", "pot", "cat", "flower", "bin", "sofa", "ledge", "floor",
    "window ledge",
)  # fmt: skip
DIMENSIONS = 6
HOVSG_VALUES = ("mIoU", "F-mIoU", "mAcc", "pAcc")
RELEASE, ORIGINAL = "gt_openlex3d", "replica_v1"


@dataclass
class PromptEncoder:
    """Each prompt has its own random direction."""

    name: str = "prompts"
    digest: str = "prompts"
    dim: int = DIMENSIONS

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring looks at no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        table: Float32Array = np.random.default_rng(7).normal(size=(len(PROMPTS), DIMENSIONS)).astype(np.float32)
        table /= np.linalg.norm(table, axis=1, keepdims=True)
        return table[[PROMPTS.index(text) for text in texts]]


def metres(scene: Scene, places: Sequence[Sequence[int]]) -> Float32Array:
    in_metres: Float32Array = (np.array(places, np.float64).reshape(-1, 3) / scene["per_m"]).astype(np.float32)
    return in_metres


def written(root: Path, problem: Problem) -> list[str]:
    """The names of the scenes, with the files of their meshes, labels and maps below ``root``."""
    names = [f"room{s}" for s in range(len(problem))]
    for name, scene in zip(names, problem, strict=True):
        _write_mesh(root / ORIGINAL / original_name(name) / "habitat", scene)
        if "clouds" in scene:
            labels = replica_label_set()
            features = np.zeros((len(scene["called"]), 1 + len(labels.ids)), np.float32)
            features[np.arange(len(features)), scene["called"]] = 1
            clouds = {k: metres(scene, cloud) for k, cloud in enumerate(scene["clouds"])}
            write_hovsg(root / "maps" / name, clouds, features)
            continue
        write_openlex(root / "maps" / name, metres(scene, scene["cloud"]), np.array(scene["index"]), _features(scene))
        folder = root / RELEASE / "replica" / name
        folder.mkdir(parents=True)
        (folder.parent / "prompt_list.txt").write_text("\n".join(PROMPTS) + "\n")
        tiers = ("synonyms", "depictions", "vis_sim", "clutter")
        samples = [
            {"object_id": int(one), "labels": {"image_attributes": dict(zip(tiers, labels, strict=True))}}
            for one, labels in scene["objects"].items()
        ]
        (folder / "gt_categories.json").write_text(json.dumps({"dataset": {"samples": samples}}))
        queries = json.dumps({"level0": scene.get("queries", {})})
        (folder / "gt_categories_query_to_object_mapping_l0.json").write_text(queries)
        write_pcd_points(folder / "gt_visible_cloud.pcd", metres(scene, scene["visible"]))
    return names


def _features(scene: Scene) -> Float32Array:
    return np.array(scene["features"], np.float32).reshape(-1, DIMENSIONS)


def _write_mesh(folder: Path, scene: Scene) -> None:
    vertices, faces = metres(scene, scene["vertices"]), scene["faces"]
    columns = {axis: vertices[:, k] for k, axis in enumerate("xyz")}
    colours = {name: np.zeros(len(vertices), np.uint8) for name in ("red", "green", "blue")}
    corners = ListColumn(np.cumsum([0, *map(len, faces)]), np.concatenate(faces).astype(np.int32))
    owners = np.array(scene["owner"], np.int32)
    folder.mkdir(parents=True)
    elements = [
        PlyElement("vertex", len(vertices), {**columns, **colours}),
        PlyElement("face", len(faces), {"vertex_indices": corners, "object_id": owners}),
    ]
    write_ply(folder / "mesh_semantic.ply", elements)
    labels = replica_label_set()
    classes = [{"id": one, "name": name} for one, name in zip(labels.ids, labels.names, strict=True)]
    objects = [{"id": int(one), "class_id": kind} for one, kind in scene["listed"].items()]
    (folder / "info_semantic.json").write_text(json.dumps({"classes": classes, "objects": objects}))


def values_of(rules: ProtocolRules, problem: Problem, root: Path) -> Float64Array:
    """The values of each scene, of queries those of all scenes, from files below ``root``, which are written first."""
    scores, labels = {}, replica_label_set()
    for name, scene in zip(written(root, problem), problem, strict=True):
        if "clouds" in scene:
            mesh = read_annotated_mesh(root / ORIGINAL / original_name(name), name)
            called = tuple(labels.name_of(one) if one else "background" for one in scene["called"])
            found: Any = hovsg(root / "maps" / name, name)[0]
            scores[name] = score_scene(rules, corner_truth(mesh), replace(found, labels=called), None)
        else:
            truth = truth_below(root, "replica", name, rules.ground_truth)
            found = openlex3d(root / "maps" / name, name)[0]
            scores[name] = score_scene(rules, truth, found, PromptEncoder())
    found = combine(rules, scores, with_intervals=False)
    names = {"hovsg": HOVSG_VALUES, "query-ap": rules.headline}.get(rules.metric) or rules.value_names
    rows = [found.metrics] if rules.metric == "query-ap" else [found.per_scene[name] for name in scores]
    return np.array([[row[name] for name in names] for row in rows], float)
