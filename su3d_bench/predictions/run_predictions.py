"""Predictions of this program's runs: ``prediction.npz`` files, single or in a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable, shown
from su3d_bench.core.files.atomic import write_npz
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.formats.arrays import array_of
from su3d_bench.formats.numpy_files import map_npy, npz_names, read_npz
from su3d_bench.predictions.base import Content, Numbering, Parsed, Reader, VertexLabels, VertexMasks, named
from su3d_bench.store.predictions import (
    OVER_VERTICES,
    array_fault,
    features_beside,
    prediction_from_arrays,
    read_prediction,
    value_fault,
    write_prediction,
)
from su3d_bench.store.run_folder import JOBS, scene_of_folder

FILE = "prediction.npz"
NUMBERINGS: dict[str, Numbering] = {name: name for name in get_args(Numbering)}


def looks_like_ours(path: Path) -> str | None:
    try:
        files = _files(path)
    except PredictionError:
        files = {"": path}  # a run folder of several methods: reading it raises an error
    if not files:
        return None
    return f"it contains {FILE}" if path.is_dir() or "kind" in npz_names(path) else None


def stored_prediction(place: Path, scene: str) -> Parsed:
    where, arrays = shown(place), read_npz(place)
    if str(arrays.get("kind")) in OVER_VERTICES:
        return _over_vertices(arrays, where), ()
    if str(arrays.get("kind")) == DenseFeatures.__name__ and "features" not in arrays:
        file = features_beside(place)
        table = array_of(map_npy(file), f"{shown(file)}: holds", "a table of features", "f", None, None)
        if not table.flags.c_contiguous:  # otherwise a row would be scattered over the file
            raise PredictionError(f"{shown(file)}: stores its table column by column; copy it again")
        arrays["features"] = table
    with named(where):
        is_short = str(arrays.get("kind")) == Instances.__name__ and "instance" in arrays
        content = _of_owners(arrays) if is_short else prediction_from_arrays(arrays, where)
        if fault := value_fault(content):
            raise PredictionError(f"{fault}; run the scene again")
    return content, ()


def _of_owners(arrays: Mapping[str, NDArray[Any]]) -> Instances:
    """The map of a file of other programs: for each point the number of its instance, from 0 and -1 for none."""
    if fault := array_fault(arrays):
        raise PredictionError(fault)
    points, labels = arrays.get("points", np.zeros((0, 3))).astype(np.float32), arrays.get("labels")
    names = None if labels is None else labels.tolist()
    return Instances.of(points, arrays["instance"], arrays.get("scores"), arrays.get("features"), labels=names)


def write_content(path: Path, content: Content) -> None:
    """Store the output of a reader at ``path``, so that ``OWN_RUNS`` reads the same."""
    if isinstance(content, VertexLabels):
        labels = {"kind": np.array("VertexLabels"), "class_ids": content.class_ids, "further": content.further}
        numbering = np.array(content.numbering) if content.numbering != "id" else None
        _write_present(path, {**labels, "numbering": numbering})
    elif isinstance(content, VertexMasks):
        arrays = {
            "kind": np.array("VertexMasks"),
            "indptr": content.indptr,
            "indices": content.indices,
            "n_points": np.array(-1 if content.n_points is None else content.n_points),
            "scores": content.scores,
            "class_numbers": content.class_numbers,
            "numbering": np.array(content.numbering),
            "features": content.features,
            "keys": np.array(content.keys, dtype=np.str_),
        }
        _write_present(path, arrays)
    else:
        write_prediction(path, content)


def _write_present(path: Path, arrays: Mapping[str, NDArray[Any] | None]) -> None:
    write_npz(path, {name: array for name, array in arrays.items() if array is not None})


def read_stored(path: Path) -> Content:
    """The content stored by ``write_content`` at ``path``, or the map of a run."""
    if str(read_npz(path, ("kind",)).get("kind")) in OVER_VERTICES:
        return _over_vertices(read_npz(path), shown(path))
    return read_prediction(path)


# Number of axes and dtype kind of each array of masks and labels over points without coordinates.
_MASK_ARRAYS = {
    "indptr": (1, "i"),
    "indices": (1, "i"),
    "n_points": (0, "i"),
    "scores": (1, "f"),
    "numbering": (0, "U"),
    "keys": (1, "U"),
    "class_numbers": (1, "i"),
    "features": (2, "f"),
}
_LABEL_ARRAYS = {"class_ids": (1, "i"), "further": (2, "i"), "numbering": (0, "U")}
_OPTIONAL = ("class_numbers", "features", "further", "numbering")


def _over_vertices(arrays: Mapping[str, NDArray[Any]], where: str) -> VertexMasks | VertexLabels:
    """The masks or labels in ``arrays``; ``PredictionError`` if there are none."""
    are_labels = str(arrays["kind"]) == "VertexLabels"
    values: dict[str, Any] = {}
    for name, (n_axes, kind) in (_LABEL_ARRAYS if are_labels else _MASK_ARRAYS).items():
        if name in arrays or name not in _OPTIONAL:
            expected = "its original form; evaluate again with --out"
            values[name] = array_of(arrays.get(name), f"{where}: '{name}' is", expected, kind, *[None] * n_axes)
    numbering = NUMBERINGS.get(str(values.pop("numbering", "id")))
    further = values.get("further")
    if numbering is None or (further is not None and len(further) != len(values["class_ids"])):
        raise PredictionError(f"{where}: contains no masks or labels; evaluate again with --out")
    if are_labels:
        return VertexLabels(**values, numbering=numbering)
    n_points, keys = int(values.pop("n_points")), tuple(map(str, values.pop("keys")))
    with named(where):
        return VertexMasks(**values, n_points=None if n_points < 0 else n_points, keys=keys, numbering=numbering)


def _files(path: Path, method: str | None = None) -> dict[str, Path]:
    """The predictions in a run folder, its ``scenes`` or a scene's folder, by address; or the one file.

    Raises ``PredictionError`` if there are several methods and ``method`` is none of them.
    """
    if path.is_file():
        return {_scene_of(path): path} if path.suffix == ".npz" else {}
    above, files = next(
        ((above, files) for above in ("scenes/*/", "*/", "") if (files := sorted(path.glob(f"{above}*/{FILE}")))),
        ("", sorted(path.glob(FILE))),
    )
    methods = sorted({file.parent.name for file in files})
    if len(methods) > 1 and method in methods:
        files = [file for file in files if file.parent.name == method]
    elif len(methods) > 1:
        raise PredictionError(
            f"{shown(path)}: contains predictions of {len(methods)} methods ({printable(', '.join(methods), 120)}); "
            f"give the folders of one: {shown(path)}/{above}{printable(methods[0], 60)}"
        )
    return {_scene_of(file): file for file in files}


def _scene_of(file: Path) -> str:
    """``dataset/scene`` if the file is in a run folder, otherwise the name of the file."""
    folder = file.absolute().parent.parent
    if folder.parent.name == JOBS:
        return scene_of_folder(folder.name)
    return file.stem


OWN_RUNS = Reader("su3d-bench", looks_like_ours, _files, stored_prediction)


def of_method(reader: Reader, method: str | None) -> Reader:
    """``reader``, which of a run folder with several methods reads that of ``method``."""
    return replace(reader, scenes=partial(_files, method=method)) if reader is OWN_RUNS else reader


def methods_of(path: Path) -> list[str]:
    """The methods of a run folder with the maps of several, without the ceiling."""
    methods = {file.parent.name for file in path.glob(f"{JOBS}/*/*/{FILE}")}
    return sorted(methods - {CEILING_METHOD}) if len(methods) > 1 else []
