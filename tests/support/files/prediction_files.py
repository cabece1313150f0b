"""Predictions written as the programs themselves write them, for tests of readers."""

from __future__ import annotations

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
from places import CASES

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.formats.ply import PlyElement, write_ply
from su3d_bench.predictions.formats import READERS
from su3d_bench.store.predictions import write_prediction


def scenes_of(case: str) -> list[dict[str, Any]]:
    """Masks (K, N), labels and scores of each scene of a reference case, in the order of its prediction lines."""
    with np.load(CASES / f"{case}.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    found = []
    for s, name in enumerate(arrays["scene_names"]):
        n_points = len(arrays[f"gt_{s}"])
        masks = np.unpackbits(arrays[f"masks_packed_{s}"], axis=1)[:, :n_points].astype(bool)
        files = [str(file) for file in arrays.get(f"mask_files_{s}", [])]
        found.append(
            {
                "name": str(name),
                "masks": masks,
                "labels": arrays[f"labels_{s}"],
                "scores": arrays[f"scores_{s}"],
                "files": files or [f"pred_mask/{name}_{k:03d}.txt" for k in range(len(masks))],
            }
        )
    return found


def write_scannet_text(folder: Path, scene: dict[str, Any], *, file_end: str = "\n") -> None:
    """The submission format: a list of mask files, class and confidence, and one digit a line in each mask file."""
    lines = []
    rows = zip(scene["files"], scene["masks"], scene["labels"], scene["scores"], strict=True)
    for file, mask, label, score in rows:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text("\n".join("1" if member else "0" for member in mask) + file_end)
        lines.append(f"{file} {label} {float(score)!r}\n")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{scene['name']}.txt").write_text("".join(lines))


def runs(mask: Any) -> Any:
    """Start (from 1) and length of each run of members, as Open3DIS and ScanNet++ encode masks."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))) + 1
    edges[1::2] -= edges[::2]
    return edges


def write_scannetpp_json(folder: Path, scene: dict[str, Any]) -> None:
    """ScanNet++'s submission: the same list, and JSON run lengths."""
    lines = []
    (folder / "masks").mkdir(parents=True, exist_ok=True)
    for k, (mask, label, score) in enumerate(zip(scene["masks"], scene["labels"], scene["scores"], strict=True)):
        content = {"length": len(mask), "counts": " ".join(str(run) for run in runs(mask))}
        (folder / f"masks/{scene['name']}_{k}.json").write_text(json.dumps(content))
        lines.append(f"masks/{scene['name']}_{k}.json {label} {float(score)!r}\n")
    (folder / f"{scene['name']}.txt").write_text("".join(lines))


def write_maskclustering(folder: Path, scene: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / f"{scene['name']}.npz",
        pred_masks=scene["masks"].T,
        pred_score=scene["scores"],
        pred_classes=scene["labels"],
    )


class TorchName:
    """A name of torch's, such as ``torch._utils _rebuild_tensor_v2``, which nobody needs to import."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __call__(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Tensor:
    """An array that is pickled as torch pickles a tensor; one that stands in several places is written once."""

    array: Any


@dataclass(frozen=True, eq=False)
class Sparse:
    """The ones at ``indices`` (2, n) of a matrix, as torch pickles a sparse tensor."""

    indices: Any
    shape: tuple[int, ...]


LAYOUT = TorchName("torch.sparse_coo")
STORAGES = {"bool": "Bool", "float16": "Half", "float32": "Float", "float64": "Double", "int32": "Int", "int64": "Long"}


class TorchPickler(pickle._Pickler):
    """Writes what torch.save writes, without torch: the values of tensors go into ``storages``."""

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
    """``value`` with tensors in place of its arrays."""
    if isinstance(value, dict):
        return {key: tensors(one) for key, one in value.items()}
    if isinstance(value, list):
        return list(map(tensors, value))
    return Tensor(value) if isinstance(value, np.ndarray) else value


def write_torch(path: Path, value: Any, *, is_stream: bool = False) -> None:
    """What torch.save writes; ``is_stream``: before 1.6, and still with ``_use_new_zipfile_serialization=False``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pickler = TorchPickler(stream := io.BytesIO(), is_stream=is_stream)
    pickler.dump(value)
    storages = {str(k): array for k, array in enumerate(pickler.storages)}
    if is_stream:  # a magic number, a version, facts of the machine, the value, the names of the storages, and these
        facts = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
        first = b"".join(pickle.dumps(one, 2) for one in (0x1950A86A20F9469CFC6C, 1001, facts))
        contents = b"".join(struct.pack("<q", array.size) + array.tobytes() for array in storages.values())
        path.write_bytes(first + stream.getvalue() + pickle.dumps(list(storages), 2) + contents)
        return
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{path.stem}/data.pkl", stream.getvalue())
        archive.writestr(f"{path.stem}/byteorder", b"little")
        for key, array in storages.items():
            archive.writestr(f"{path.stem}/data/{key}", array.tobytes())


def write_openmask3d(folder: Path, scene: dict[str, Any], features: Any) -> None:
    """A NumPy float16 array through torch.save, and a float64 file of features."""
    write_torch(folder / f"{scene['name']}_masks.pt", scene["masks"].T.astype(np.float16))
    np.save(folder / f"{scene['name']}_openmask3d_features.npy", features)


def write_openyolo3d(folder: Path, scene: dict[str, Any]) -> None:
    columns = Tensor(scene["masks"].T), Tensor(scene["scores"].astype(np.float32))
    write_torch(folder / f"{scene['name']}.pt", columns)


def write_openyolo3d_labelled(folder: Path, scene: dict[str, Any]) -> None:
    """What predict of Open-YOLO 3D gives of a scene: masks, positions of their classes and scores."""
    columns = scene["masks"].T, scene["labels"].astype(np.int64), scene["scores"].astype(np.float32)
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
    lines = []
    (folder / "predicted_masks").mkdir(parents=True, exist_ok=True)
    for k, (mask, score) in enumerate(zip(scene["masks"], scene["scores"], strict=True)):
        file = f"predicted_masks/{scene['name']}_{k}.txt"
        np.savetxt(folder / file, mask, fmt="%d")
        lines.append(f"{file} {float(score)!r}\n")
    (folder / f"{scene['name']}.txt").write_text("".join(lines))


def write_sam3d_colours(file: Path, groups: Any) -> None:
    """The cloud that SAM3D draws: doubles, a random colour a group, black for -1, as Open3D writes it."""
    rng = np.random.default_rng(1)
    palette = np.vstack([rng.integers(1, 256, (int(np.max(groups)) + 1, 3)), np.zeros((1, 3), int)]).astype(np.uint8)
    colours, points = palette[groups], rng.random((len(groups), 3))
    columns = dict(zip("xyz", points.T, strict=True)) | dict(zip(("red", "green", "blue"), colours.T, strict=True))
    write_ply(file, [PlyElement("vertex", len(groups), columns)])


def write_sam3d(folder: Path, name: str, groups: Any) -> None:
    write_torch(folder / f"{name}.pth", groups)


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
    """A folder with one small scene in ``format``, named scene0011_00 (or replica/scene0011_00 for our own)."""
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
        "sam3d": lambda: write_sam3d(folder, name, np.array([0, 0, -1, 1])),
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
    """The message with which a reader refuses a scene."""
    with pytest.raises(PredictionError) as caught:
        READERS[format].read(path, scene)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    return message


def scene_name(format: str) -> str:
    return "replica/scene0011_00" if format == "su3d-bench" else "scene0011_00"
