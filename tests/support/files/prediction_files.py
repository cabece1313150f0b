"""Predictions written like by the original programs, over the vertices of a mesh or with their own points."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hm3dsem_walk import write_graph
from places import CASES
from recording_files import write_files

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.formats.pcd import write_pcd_points
from su3d_bench.formats.ply import PlyElement, write_ply
from su3d_bench.predictions.formats import READERS
from su3d_bench.store.predictions import write_prediction


def scenes_of(case: str) -> list[dict[str, Any]]:
    """Masks (K, N), labels and scores of each scene of a reference case, in prediction order."""
    with np.load(CASES / f"{case}.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    found = []
    for s, name in enumerate(map(str, arrays["scene_names"])):
        n_points = len(arrays[f"gt_{s}"])
        masks = np.unpackbits(arrays[f"masks_packed_{s}"], axis=1)[:, :n_points].astype(bool)
        files = [str(file) for file in arrays.get(f"mask_files_{s}", [])]
        files = files or [f"pred_mask/{name}_{k:03d}.txt" for k in range(len(masks))]
        scores = {"labels": arrays[f"labels_{s}"], "scores": arrays[f"scores_{s}"]}
        found.append({"name": name, "masks": masks, "files": files, **scores})
    return found


def write_list(folder: Path, scene: dict[str, Any], files: list[str], masks: list[str], labels: Any) -> None:
    """Mask files, and a list with the file name, class (a text) and confidence of each."""
    lines = []
    for file, content, label, score in zip(files, masks, labels, scene["scores"], strict=True):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(content)
        lines.append(f"{file} {label}{float(score)!r}\n")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{scene['name']}.txt").write_text("".join(lines))


def write_scannet_text(folder: Path, scene: dict[str, Any], *, file_end: str = "\n") -> None:
    """The submission format: a list of mask files, class and confidence, and one digit per line in each mask file."""
    masks = ["\n".join("1" if member else "0" for member in mask) + file_end for mask in scene["masks"]]
    write_list(folder, scene, scene["files"], masks, [f"{label} " for label in scene["labels"]])


def runs(mask: Any) -> Any:
    """Start (from 1) and length of each run of members, as encoded by Open3DIS and ScanNet++."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))) + 1
    edges[1::2] -= edges[::2]
    return edges


def write_scannetpp_json(folder: Path, scene: dict[str, Any]) -> None:
    """ScanNet++'s submission: the same list, and JSON run lengths."""
    lengths = [" ".join(map(str, runs(mask))) for mask in scene["masks"]]
    masks = [json.dumps({"length": scene["masks"].shape[1], "counts": counts}) for counts in lengths]
    files = [f"masks/{scene['name']}_{k}.json" for k in range(len(masks))]
    write_list(folder, scene, files, masks, [f"{label} " for label in scene["labels"]])


def write_maskclustering(folder: Path, scene: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    scores = {"pred_score": scene["scores"], "pred_classes": scene["labels"]}
    np.savez(folder / f"{scene['name']}.npz", pred_masks=scene["masks"].T, **scores)


class TorchName:
    """A name in torch, such as ``torch._utils _rebuild_tensor_v2``, that need not be importable."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __call__(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Tensor:
    """An array pickled like a torch tensor; if it occurs several times it is written once."""

    array: Any


@dataclass(frozen=True, eq=False)
class Sparse:
    """The ones at ``indices`` (2, n) of a matrix, pickled like a torch sparse tensor."""

    indices: Any
    shape: tuple[int, ...]


LAYOUT = TorchName("torch.sparse_coo")
STORAGES = {"bool": "Bool", "float16": "Half", "float32": "Float", "float64": "Double", "int32": "Int", "int64": "Long"}


class TorchPickler(pickle._Pickler):
    """Writes the format of torch.save without torch: tensor values go into ``storages``."""

    def __init__(self, stream: Any, *, is_stream: bool) -> None:
        super().__init__(stream, 2)
        self.storages: list[Any] = []
        self._is_stream = is_stream

    def persistent_id(self, value: Any) -> Any:
        if not isinstance(value, memoryview):
            return None
        self.storages.append(array := np.asarray(value))
        kind = TorchName(f"torch {STORAGES[array.dtype.name]}Storage")
        return "storage", kind, str(len(self.storages) - 1), "cpu", array.size, *[None] * self._is_stream

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            array = np.require(value.array, requirements="C")
            strides = tuple(stride // array.itemsize for stride in array.strides)
            parts: Any = memoryview(array.reshape(-1)), 0, array.shape, strides, False, OrderedDict()
            return TorchName("torch._utils _rebuild_tensor_v2"), parts
        if isinstance(value, Sparse):
            parts = Tensor(value.indices), Tensor(np.ones(value.indices.shape[1], np.float32)), value.shape, True
            return TorchName("torch._utils _rebuild_sparse_tensor"), (LAYOUT, parts)
        if value is LAYOUT:
            return TorchName("torch.serialization _get_layout"), ("torch.sparse_coo",)
        return value.text if isinstance(value, TorchName) else NotImplemented

    def save_global(self, value: Any, name: Any = None) -> None:
        if not isinstance(value, TorchName):
            super().save_global(value, name)  # type: ignore[misc]
            return
        self.write(pickle.GLOBAL + "\n".join([*value.text.split(), ""]).encode())  # type: ignore[attr-defined]
        self.memoize(value)  # type: ignore[attr-defined]


def tensors(value: Any) -> Any:
    """``value`` with its arrays replaced by tensors."""
    if isinstance(value, dict):
        return {key: tensors(one) for key, one in value.items()}
    if isinstance(value, list):
        return list(map(tensors, value))
    return Tensor(value) if isinstance(value, np.ndarray) else value


def write_torch(path: Path, value: Any, *, is_stream: bool = False) -> None:
    """The output of torch.save; ``is_stream``: before 1.6, or with ``_use_new_zipfile_serialization=False``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pickler = TorchPickler(stream := io.BytesIO(), is_stream=is_stream)
    pickler.dump(value)
    storages = {str(k): array for k, array in enumerate(pickler.storages)}
    if is_stream:  # a magic number, a version, machine info, the value, the storage names, and the storages
        facts = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
        first = b"".join(pickle.dumps(one, 2) for one in (0x1950A86A20F9469CFC6C, 1001, facts))
        contents = b"".join(struct.pack("<q", array.size) + array.tobytes() for array in storages.values())
        path.write_bytes(first + stream.getvalue() + pickle.dumps(list(storages), 2) + contents)
        return
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{path.stem}/data.pkl", stream.getvalue())
        archive.writestr(f"{path.stem}/byteorder", b"little")
        archive.writestr(f"{path.stem}/version", b"3\n")
        for key, array in storages.items():
            archive.writestr(f"{path.stem}/data/{key}", array.tobytes())


def write_openmask3d(folder: Path, scene: dict[str, Any], features: Any) -> None:
    """A NumPy float16 array through torch.save, and a float64 file of features."""
    write_torch(folder / f"{scene['name']}_masks.pt", scene["masks"].T.astype(np.float16))
    np.save(folder / f"{scene['name']}_openmask3d_features.npy", features)


def write_openyolo3d(folder: Path, scene: dict[str, Any], *, has_labels: bool = False) -> None:
    """Masks and scores; for Open-YOLO 3D's predict, with their class indices in between."""
    labels = [scene["labels"].astype(np.int64)] if has_labels else []
    columns = scene["masks"].T, *labels, scene["scores"].astype(np.float32)
    write_torch(folder / f"{scene['name']}.pt", tuple(map(Tensor, columns)))


def write_openins3d(folder: Path, scene: dict[str, Any]) -> None:
    masks = scene["masks"].T
    write_torch(folder / f"{scene['name']}.pt", Sparse(np.stack(np.nonzero(masks)), masks.shape))


def write_open3dis(folder: Path, scene: dict[str, Any], *, as_tensor: bool = False) -> None:
    """A dict of run lengths (or a tensor of masks), confidences and class indices."""
    masks: Any = [{"length": len(mask), "counts": runs(mask)} for mask in scene["masks"]]
    masks = Tensor(scene["masks"]) if as_tensor else masks
    value = {"ins": masks, "conf": Tensor(scene["scores"]), "final_class": Tensor(scene["labels"].astype(np.int64))}
    write_torch(folder / f"{scene['name']}.pth", value)


def write_opensun3d(folder: Path, scene: dict[str, Any]) -> None:
    """A submission to the OpenSUN3D challenge: mask file and confidence."""
    masks = ["".join(f"{int(member)}\n" for member in mask) for mask in scene["masks"]]
    files = [f"predicted_masks/{scene['name']}_{k}.txt" for k in range(len(masks))]
    write_list(folder, scene, files, masks, [""] * len(masks))


def write_sam3d_colours(file: Path, groups: Any) -> None:
    """The cloud drawn by SAM3D: doubles, a random colour per group, black for -1, as written by Open3D."""
    rng = np.random.default_rng(1)
    palette = np.vstack([rng.integers(1, 256, (int(np.max(groups)) + 1, 3)), np.zeros((1, 3), int)]).astype(np.uint8)
    colours, points = palette[groups], rng.random((len(groups), 3))
    columns = dict(zip("xyz", points.T, strict=True)) | dict(zip(("red", "green", "blue"), colours.T, strict=True))
    write_ply(file, [PlyElement("vertex", len(groups), columns)])


RNG = np.random.default_rng(0)
TOY: dict[str, Any] = {
    "name": "scene0011_00",
    "masks": RNG.random((3, 40)) < 0.4,
    "labels": np.array([5, 7, 39], np.int32),
    "scores": np.array([0.5, 0.25, 0.75]),
    "files": [f"pred_mask/scene0011_00_{k}.txt" for k in range(3)],
}
FEATURES = RNG.normal(size=(3, 768))
OURS = (
    "su3d-bench", "scannet-text", "scannet-semantic-text", "openmask3d", "maskclustering", "open3dis", "openyolo3d",
    "openins3d", "sam3d", "sam3d-colours", "opensun3d-challenge",
)  # fmt: skip


def own_instances() -> Instances:
    points = np.arange(18, dtype=np.float32).reshape(6, 3)
    masks = [np.array([0, 1]), np.array([2, 3, 5])]
    return Instances.of(points, masks, np.array([0.5, 1.0]), np.ones((2, 4), np.float32), names=("a", "b"))


def written_in(tmp_path: Path, format: str) -> Path:
    """A folder with one small scene in ``format``, named scene0011_00 (replica/scene0011_00 for our format)."""
    folder = tmp_path / format
    folder.mkdir()
    name = TOY["name"]
    writers: dict[str, Callable[[], object]] = {
        "scannet-text": lambda: write_scannet_text(folder, TOY),
        "scannet-semantic-text": lambda: (folder / f"{name}.txt").write_text("3\n-1\n39\n"),
        "scannetpp-semantic": lambda: (folder / f"{name}.txt").write_text("3,1,2\n0,99,5\n39,2,2\n"),
        "openmask3d": lambda: write_openmask3d(folder, TOY, FEATURES[:, :4]),
        "maskclustering": lambda: write_maskclustering(folder, TOY),
        "open3dis": lambda: write_open3dis(folder, TOY),
        "openyolo3d": lambda: write_openyolo3d(folder, TOY),
        "openins3d": lambda: write_openins3d(folder, TOY),
        "sam3d": lambda: write_torch(folder / f"{name}.pth", np.array([0, 0, -1, 1])),
        "sam3d-colours": lambda: write_sam3d_colours(folder / f"{name}.ply", np.repeat([0, -1, 1], [30, 40, 50])),
        "opensun3d-challenge": lambda: write_opensun3d(folder, TOY),
    }
    if format == "su3d-bench":
        (folder / f"scenes/replica.{name}/m").mkdir(parents=True)
        write_prediction(folder / f"scenes/replica.{name}/m/prediction.npz", own_instances())
    else:
        writers[format]()
    return folder


def refused(path: Path, scene: str, format: str) -> str:
    """The message with which a reader rejects a scene."""
    with pytest.raises(PredictionError) as caught:
        READERS[format].read(path, scene)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    return message


# ---- predictions with their own points

CLASSES = ["couch", "lamp", "wall"]


def an_object(n_points: int, class_ids: list[int], **more: Any) -> dict[str, Any]:
    """An object of ConceptGraphs with keys of every kind in its map."""
    n = len(class_ids)
    feature = RNG.normal(size=16)
    return {
        "image_idx": list(range(n)),
        "color_path": [f"/home/author/Replica/room0/results/frame{k:06d}.jpg" for k in range(n)],
        "class_name": [CLASSES[one % 3] for one in class_ids],
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


def a_map(**more: Any) -> dict[str, Any]:
    objects = [an_object(5, [0, 1, 0]), an_object(0, [1]), an_object(3, [1, 0])]
    background = [an_object(4, [2], is_background=True)]
    colours = {str(k): [0.1, 0.2, 0.3] for k in range(3)}
    return {"objects": objects, "bg_objects": background, "class_names": CLASSES, "class_colors": colours, **more}


def write_map(path: Path, value: object, protocol: int = 4) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wb", compresslevel=1) as stream:
        pickle.dump(value, stream, protocol)
    return path


def write_gradslam(folder: Path, points: Any, embeddings: Any) -> None:
    tables = {"points": points, "embeddings": embeddings, "colors": points, "confidences": points}
    write_files(folder, {f"pc_{name}.h5": values for name, values in tables.items()})


def write_object(path: Path, points: Any) -> None:
    """A cloud as written by Open3D: doubles, followed by colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {axis: np.asarray(points)[:, k].astype(np.float64) for k, axis in enumerate("xyz")}
    colours = {name: np.full(len(points), 7, np.uint8) for name in ("red", "green", "blue")}
    write_ply(path, [PlyElement("vertex", len(points), {**columns, **colours})])


def write_hovsg(folder: Path, clouds: dict[int, Any], features: Any) -> None:
    for number, cloud in clouds.items():
        write_object(folder / f"objects/pcd_{number}.ply", cloud)
    (folder / "objects").mkdir(parents=True, exist_ok=True)
    write_torch(folder / "mask_feats.pt", Tensor(features))


def write_openlex(folder: Path, points: Any, index: Any, features: Any, cloud: str = "point_cloud.pcd") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if cloud.endswith(".pcd"):
        write_pcd_points(folder / cloud, np.asarray(points, np.float32))
    else:
        write_object(folder / cloud, points)
    np.save(folder / "index.npy", index)
    np.save(folder / "embeddings.npy", features)


def write_ovo(folder: Path, points: Any, ids: Any, features: dict[int, Any], *, is_stream: bool = True) -> None:
    """A checkpoint of OVO: the points of its SLAM with their object in a column, one feature per object."""
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


def write_esam(folder: Path, points: Any, groups: Any) -> None:
    """Output of ESAM's stream demo: the points (frames, points, 3) with one of its 256 colours each, 200 for none."""
    folder.mkdir(parents=True, exist_ok=True)
    palette = (np.random.default_rng(0).random((256, 3)) * 255).astype(int)
    palette[-1] = 200
    np.save(folder / "points.npy", np.asarray(points, np.float32))
    np.save(folder / "points_color.npy", palette[np.asarray(groups)].reshape(np.shape(points)))


def write_onlineanyseg(folder: Path, points: Any, masks: Any, features: Any = None) -> None:
    """Masks over the reconstructed points, class 0 and score 1 for each, features in columns; and these points."""
    write_object(folder / "final.ply", points)
    arrays: dict[str, Any] = {"pred_masks": np.stack(masks, 1), "pred_score": np.ones(len(masks))}
    arrays |= {"pred_classes": np.zeros(len(masks), np.int32)}
    arrays |= {} if features is None else {"pred_sem_features": np.stack(features, 1)}
    np.savez(folder / "ckpt_final.npz", **arrays)


def write_small(folder: Path, format: str) -> Path:
    """The small scene room0 in ``format``; returns the parent of the scene's folder."""
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
        "rayfronts": lambda: write_torch(scene / "map.pt", tensors({"feats_xyz": points, "feats_feats": rows})),
        "esam": lambda: write_esam(scene, points.reshape(3, 2, 3), [0, 0, 1, -1, 1, 0]),
        "onlineanyseg": lambda: write_onlineanyseg(scene, points, [np.arange(6) < 3, np.arange(6) > 2], list(rows[:2])),
        "fross": lambda: write_fross(scene / "predictions_gaussian_test.pkl", [points[:4], points[4:]]),
    }
    writers[format]()
    return folder


def write_fross(path: Path, clouds: list[Any]) -> None:
    """A scene graph of the scene room0, with a chain of edges through its objects."""
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


WITH_POINTS = ("conceptgraphs", "gradslam", "hovsg", "openlex3d", "ovo", "rayfronts", "esam", "onlineanyseg", "fross")
