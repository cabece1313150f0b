"""Predictions written as the programs themselves write them, for tests of readers."""

from __future__ import annotations

import json
import pickle
import struct
import zipfile
from collections.abc import Callable, Sequence
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


def torch_text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def torch_numbers(values: Sequence[int]) -> bytes:
    return b"(" + b"".join(b"\x8a\x08" + struct.pack("<q", value) for value in values) + b"t"


STORAGES = {"bool": "Bool", "float16": "Half", "float32": "Float", "float64": "Double", "int32": "Int", "int64": "Long"}


class TorchFile:
    """What torch.save writes, without torch: tensors become storages beside a pickle in torch's words.

    ``is_stream``: in the form before 1.6, which ``_use_new_zipfile_serialization=False`` still asks for.
    """

    def __init__(self, *, is_stream: bool = False) -> None:
        self._is_stream = is_stream
        self._storages: list[bytes] = []
        self._sizes: list[int] = []

    def tensor(self, array: Any) -> bytes:
        """The pickle of a contiguous tensor, whose values go into a storage."""
        array = np.ascontiguousarray(array) if array.ndim else array
        key = str(len(self._storages))
        self._storages.append(array.tobytes())
        self._sizes.append(array.size)
        kind = STORAGES[array.dtype.name].encode()
        reference = torch_text("storage") + b"ctorch\n" + kind + b"Storage\n" + torch_text(key) + torch_text("cpu")
        size = b"\x8a\x08" + struct.pack("<q", array.size) + b"N" * self._is_stream
        strides = [stride // array.itemsize for stride in array.strides]
        return (
            b"ctorch._utils\n_rebuild_tensor_v2\n((" + reference + size + b"tQK\x00" + torch_numbers(array.shape)
            + torch_numbers(strides) + b"\x89ccollections\nOrderedDict\n)RtR"
        )  # fmt: skip

    def array(self, array: Any) -> bytes:
        """The pickle of a NumPy array, its bytes as latin1 text."""
        kind: bytes = torch_text(array.dtype.str[1:]) + b"\x89\x88\x87R"
        state = b"(K\x03" + torch_text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        values: bytes = array.tobytes().decode("latin1").encode()
        return (
            b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85c_codecs\nencode\n" + torch_text("b")
            + torch_text("latin1") + b"\x86R\x87R(K\x01" + torch_numbers(array.shape) + b"cnumpy\ndtype\n" + kind
            + state + b"\x89c_codecs\nencode\nX" + struct.pack("<I", len(values)) + values + torch_text("latin1")
            + b"\x86Rtb"
        )  # fmt: skip

    def value(self, value: Any) -> bytes:
        """The pickle of dicts, lists, texts, integers, None and tensors."""
        if isinstance(value, dict):
            return b"}(" + b"".join(torch_text(key) + self.value(one) for key, one in value.items()) + b"u"
        if isinstance(value, list):
            return b"](" + b"".join(map(self.value, value)) + b"e"
        if isinstance(value, np.ndarray):
            return self.tensor(value)
        if isinstance(value, int):
            return b"\x8a\x08" + struct.pack("<q", value)
        return b"N" if value is None else torch_text(value)

    def write(self, path: Path, pickled: bytes) -> None:
        if self._is_stream:
            path.write_bytes(self._stream(pickled))
            return
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(f"{path.stem}/data.pkl", b"\x80\x02" + pickled + b".")
            archive.writestr(f"{path.stem}/byteorder", b"little")
            for key, content in enumerate(self._storages):
                archive.writestr(f"{path.stem}/data/{key}", content)
            archive.writestr(f"{path.stem}/version", b"3\n")

    def _stream(self, pickled: bytes) -> bytes:
        """A magic number, a version, facts of the machine, the value, the names of the storages, and these."""
        facts = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
        names = [str(key) for key in range(len(self._storages))]
        first = b"".join(pickle.dumps(value, 2) for value in (0x1950A86A20F9469CFC6C, 1001, facts))
        storages = [struct.pack("<q", n) + content for n, content in zip(self._sizes, self._storages, strict=True)]
        return first + b"\x80\x02" + pickled + b"." + pickle.dumps(names, 2) + b"".join(storages)


def write_openmask3d(folder: Path, scene: dict[str, Any], features: Any) -> None:
    """A NumPy float16 array through torch.save, and a float64 file of features."""
    folder.mkdir(parents=True, exist_ok=True)
    file = TorchFile()
    file.write(folder / f"{scene['name']}_masks.pt", file.array(scene["masks"].T.astype(np.float16)))
    np.save(folder / f"{scene['name']}_openmask3d_features.npy", features)


def write_openyolo3d(folder: Path, scene: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    file = TorchFile()
    pickled = file.tensor(scene["masks"].T) + file.tensor(scene["scores"].astype(np.float32)) + b"\x86"
    file.write(folder / f"{scene['name']}.pt", pickled)


def write_openyolo3d_labelled(folder: Path, scene: dict[str, Any]) -> None:
    """What predict of Open-YOLO 3D gives of a scene: masks, positions of their classes and scores."""
    folder.mkdir(parents=True, exist_ok=True)
    file = TorchFile()
    columns = (scene["masks"].T, scene["labels"].astype(np.int64), scene["scores"].astype(np.float32))
    file.write(folder / f"{scene['name']}.pt", b"".join(map(file.tensor, columns)) + b"\x87")


def write_openins3d(folder: Path, scene: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    file = TorchFile()
    places = np.stack(np.nonzero(scene["masks"].T))
    layout = b"ctorch.serialization\n_get_layout\n" + torch_text("torch.sparse_coo") + b"\x85R"
    parts = file.tensor(places) + file.tensor(np.ones(places.shape[1], np.float32))
    shape = torch_numbers(scene["masks"].T.shape)
    pickled = b"ctorch._utils\n_rebuild_sparse_tensor\n" + layout + b"(" + parts + shape + b"\x88t\x86R"
    file.write(folder / f"{scene['name']}.pt", pickled)


def write_open3dis(folder: Path, scene: dict[str, Any], *, as_tensor: bool = False) -> None:
    """A dict of run lengths (or a tensor of masks), confidences and class indices."""
    folder.mkdir(parents=True, exist_ok=True)
    file = TorchFile()
    masks = b"](" + b"".join(
        b"}(" + torch_text("length") + b"\x8a\x08" + struct.pack("<q", len(mask)) + torch_text("counts")
        + file.array(runs(mask)) + b"u" for mask in scene["masks"]
    ) + b"e"  # fmt: skip
    if as_tensor:
        masks = file.tensor(scene["masks"])
    confidences = torch_text("conf") + file.tensor(scene["scores"])
    classes = torch_text("final_class") + file.tensor(scene["labels"].astype(np.int64))
    pickled = b"}(" + torch_text("ins") + masks + confidences + classes + b"u"
    file.write(folder / f"{scene['name']}.pth", pickled)


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
    folder.mkdir(parents=True, exist_ok=True)
    file = TorchFile()
    file.write(folder / f"{name}.pth", file.array(groups))


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
