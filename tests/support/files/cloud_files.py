"""Predictions with their own points, written as the programs themselves write them, for tests of readers."""

from __future__ import annotations

import gzip
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest
from hm3dsem_walk import write_graph
from prediction_files import Tensor, tensors, write_torch

from su3d_bench.formats.pcd import write_pcd_points
from su3d_bench.formats.ply import PlyElement, write_ply

RNG = np.random.default_rng(0)
NAMES = ["couch", "lamp", "wall"]


def an_object(n_points: int, class_ids: list[int], **more: Any) -> dict[str, Any]:
    """An object of ConceptGraphs with keys of every kind that its map has."""
    n = len(class_ids)
    feature = RNG.normal(size=16)
    return {
        "image_idx": list(range(n)),
        "color_path": [f"/home/author/Replica/room0/results/frame{k:06d}.jpg" for k in range(n)],
        "class_name": [NAMES[one % 3] for one in class_ids],
        "class_id": list(class_ids),
        "mask": [RNG.random((60, 80)) < 0.5 for _ in range(n)],
        "xyxy": [RNG.random(4) for _ in range(n)],
        "conf": [np.float32(0.5)] * n,
        "pixel_area": [np.int64(7)] * n,
        "contain_number": [None] * n,
        "is_background": False,
        "clip_ft": (feature / np.linalg.norm(feature)).astype(np.float32),
        "text_ft": np.ones(16, np.float32),
        "pcd_np": RNG.normal(size=(n_points, 3)),
        "pcd_color_np": RNG.random((n_points, 3)),
        **more,
    }


def settings(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Settings as ConceptGraphs stores them: an object of omegaconf's class, with a path in it."""
    module = ModuleType("omegaconf.dictconfig")

    class DictConfig:
        pass

    DictConfig.__module__, DictConfig.__qualname__ = module.__name__, "DictConfig"
    module.DictConfig = DictConfig  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "omegaconf", ModuleType("omegaconf"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    made = DictConfig()
    vars(made).update(_content={"dataset_root": Path("/data/Replica"), "stride": 5}, _parent=None, ref_type=dict)
    return made


def a_map(**more: Any) -> dict[str, Any]:
    objects = [an_object(5, [0, 1, 0]), an_object(0, [1]), an_object(3, [1, 0])]
    background = [an_object(4, [2], is_background=True)]
    colours = {str(k): [0.1, 0.2, 0.3] for k in range(3)}
    return {"objects": objects, "bg_objects": background, "class_names": NAMES, "class_colors": colours, **more}


def write_map(path: Path, value: object, protocol: int = 4) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wb", compresslevel=1) as stream:
        pickle.dump(value, stream, protocol)
    return path


def write_h5(path: Path, values: Any, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset(path.stem, data=values, **options)


def write_gradslam(folder: Path, points: Any, embeddings: Any, **options: Any) -> None:
    for name, values in {"points": points, "embeddings": embeddings, "colors": points, "confidences": points}.items():
        write_h5(folder / f"pc_{name}.h5", values, **options)


def write_tensor(path: Path, values: Any) -> None:
    write_torch(path, Tensor(values))


def write_object(path: Path, points: Any) -> None:
    """A cloud as Open3D writes it: doubles, and colours behind them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {axis: np.asarray(points)[:, k].astype(np.float64) for k, axis in enumerate("xyz")}
    colours = {name: np.full(len(points), 7, np.uint8) for name in ("red", "green", "blue")}
    write_ply(path, [PlyElement("vertex", len(points), {**columns, **colours})])


def write_hovsg(folder: Path, clouds: dict[int, Any], features: Any) -> None:
    for number, cloud in clouds.items():
        write_object(folder / f"objects/pcd_{number}.ply", cloud)
    (folder / "objects").mkdir(parents=True, exist_ok=True)
    write_tensor(folder / "mask_feats.pt", features)


def write_openlex(folder: Path, points: Any, index: Any, features: Any, cloud: str = "point_cloud.pcd") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if cloud.endswith(".pcd"):
        write_pcd_points(folder / cloud, np.asarray(points, np.float32))
    else:
        write_object(folder / cloud, points)
    np.save(folder / "index.npy", index)
    np.save(folder / "embeddings.npy", features)


def write_ovo(folder: Path, points: Any, ids: Any, features: dict[int, Any], *, is_stream: bool = True) -> None:
    """A checkpoint of OVO: the points of its SLAM with the object of each in a column, a feature an object."""
    cloud = {
        "xyz": np.asarray(points, np.float32),
        "obj_ids": np.asarray(ids, np.int32)[:, np.newaxis],
        "ids": np.arange(len(points), dtype=np.int32)[:, np.newaxis],
        "max_id": len(points),
    }
    objects = {f"ins3d_{number}_clip_feature": feature for number, feature in features.items()}
    numbers = {"ins_3d_ids": np.array(list(features), np.int64), "ins3d_0_clip_feature_kf": None}
    value = {"map_params": tensors(cloud), "ovo_map_params": numbers | tensors(objects)}
    write_torch(folder / "ovo_map.ckpt", value, is_stream=is_stream)


def write_rayfronts(path: Path, value: dict[str, Any]) -> None:
    write_torch(path, tensors(value))


def write_esam(folder: Path, points: Any, groups: Any) -> None:
    """What ESAM's stream demo leaves: the points (frames, points, 3) and one of its 256 colours each, 200 for none."""
    folder.mkdir(parents=True, exist_ok=True)
    palette = (np.random.default_rng(0).random((256, 3)) * 255).astype(int)
    palette[-1] = 200
    np.save(folder / "points.npy", np.asarray(points, np.float32))
    np.save(folder / "points_color.npy", palette[np.asarray(groups)].reshape(np.shape(points)))


def write_onlineanyseg(folder: Path, points: Any, masks: Any, features: Any = None) -> None:
    """Masks over the rebuilt points, class 0 and score 1 for each, its features in columns; and these points."""
    write_object(folder / "final.ply", points)
    arrays: dict[str, Any] = {"pred_masks": np.stack(masks, 1), "pred_score": np.ones(len(masks))}
    arrays |= {"pred_classes": np.zeros(len(masks), np.int32)}
    arrays |= {} if features is None else {"pred_sem_features": np.stack(features, 1)}
    np.savez(folder / "ckpt_final.npz", **arrays)


def write_small(folder: Path, format: str) -> Path:
    """The scene room0 in ``format``, small; the folder that holds the scene's folder."""
    scene = folder / "room0"
    points, rows = RNG.normal(size=(6, 3)).astype(np.float32), np.ones((6, 8), np.float32)
    ovo = {5: rows[0], 0: rows[:1]}
    writers: dict[str, Callable[[], object]] = {
        "conceptgraphs": lambda: write_map(scene / "pcd_saves/full_pcd_none_x.pkl.gz", a_map()),
        "gradslam": lambda: write_gradslam(scene / "saved-map/pointclouds", points, rows.astype(np.float16)),
        "hovsg": lambda: write_hovsg(scene, {0: points[:4], 1: points[4:]}, rows[:2]),
        "hovsg-graph": lambda: write_graph(scene / "graph"),
        "openlex3d": lambda: write_openlex(scene, points, np.array([0, 0, 1, 1, 0, 1]), rows[:2]),
        "ovo": lambda: write_ovo(scene, points, [5, -1, 5, 0, 0, 5], ovo),
        "rayfronts": lambda: write_rayfronts(scene / "map.pt", {"feats_xyz": points, "feats_feats": rows}),
        "esam": lambda: write_esam(scene, points.reshape(3, 2, 3), [0, 0, 1, -1, 1, 0]),
        "onlineanyseg": lambda: write_onlineanyseg(scene, points, [np.arange(6) < 3, np.arange(6) > 2], list(rows[:2])),
        "fross": lambda: write_fross(scene / "predictions_gaussian_test.pkl", [points[:4], points[4:]]),
    }
    writers[format]()
    return folder


def write_fross(path: Path, clouds: list[Any]) -> None:
    """A scene graph of the scene room0, a chain of edges through its objects."""
    k = len(clouds)
    graph = {
        "pcd": [np.asarray(cloud, np.float64) for cloud in clouds],
        "cls": np.eye(150, dtype=np.int64)[np.arange(k) + 27],
        "edge_index": np.array([np.arange(k - 1), np.arange(1, k)]),
        "edge_cls": np.eye(50)[np.full(k - 1, 28)],
        "mean": np.zeros((k, 3)),
        "cov": np.zeros((k, 3, 3)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps({"room0": graph}))


FORMATS = ("conceptgraphs", "gradslam", "hovsg", "openlex3d", "ovo", "rayfronts", "esam", "onlineanyseg", "fross")
