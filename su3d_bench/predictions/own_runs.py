"""Predictions of our own runs: ``prediction.npz`` files, alone or in a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable, shown
from su3d_bench.core.files.atomic import write_npz
from su3d_bench.core.maps import DenseFeatures, Prediction
from su3d_bench.formats.arrays import kind_of
from su3d_bench.formats.numpy_files import map_npy, npz_names, read_npz
from su3d_bench.predictions.base import Content, Numbering, Reader, ScenePrediction, VertexLabels, VertexMasks
from su3d_bench.store.predictions import (
    OVER_VERTICES,
    features_beside,
    prediction_from_arrays,
    read_prediction,
    value_fault,
    write_prediction,
)
from su3d_bench.store.run_folder import JOBS, scene_of_folder

FILE = "prediction.npz"
NUMBERINGS: dict[str, Numbering] = {name: name for name in get_args(Numbering)}


class OwnRuns(Reader):
    name = "su3d-bench"
    summary = "our own prediction.npz, or a run folder with those of one method"

    def recognise(self, path: Path) -> str | None:
        try:
            files = _files(path)
        except PredictionError:
            files = {"": path}  # a run folder of several methods: reading it says so
        if not files:
            return None
        is_ours = path.is_dir() or "kind" in npz_names(path)
        return f"it holds {FILE}" if is_ours else None

    def scenes(self, path: Path) -> Mapping[str, Path]:
        return _files(path)

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where, arrays = shown(place), read_npz(place)
        if str(arrays.get("kind")) in OVER_VERTICES:
            return ScenePrediction(scene, self.name, place, _over_vertices(arrays, where))
        if str(arrays.get("kind")) == DenseFeatures.__name__ and "features" not in arrays:
            arrays["features"] = _mapped_features(features_beside(place))
        try:
            content = prediction_from_arrays(arrays, where)
        except PredictionError as error:
            raise PredictionError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error
        _check_points(where, content)
        return ScenePrediction(scene, self.name, place, content)


def write_content(path: Path, content: Content) -> None:
    """Store what a reader gave at ``path``, so that ``OwnRuns`` reads the same."""
    if isinstance(content, VertexLabels):
        numbering = np.array(content.numbering) if content.numbering != "id" else None
        labels = {"kind": np.array("VertexLabels"), "class_ids": content.class_ids, "further": content.further}
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
    """What ``write_content`` stored at ``path``, or the map of a run."""
    if str(read_npz(path, ("kind",)).get("kind")) in OVER_VERTICES:
        return _over_vertices(read_npz(path), shown(path))
    return read_prediction(path)


# Dimensions and kind of numbers of each array of masks and labels over points without coordinates.
_VERTEX_ARRAYS = {
    "indptr": (1, "i"),
    "indices": (1, "i"),
    "n_points": (0, "i"),
    "scores": (1, "f"),
    "numbering": (0, "U"),
    "keys": (1, "U"),
    "class_numbers": (1, "i"),
    "features": (2, "f"),
    "class_ids": (1, "i"),
    "further": (2, "i"),
}
_OPTIONAL = ("class_numbers", "features", "further")


def _over_vertices(arrays: Mapping[str, NDArray[Any]], where: str) -> VertexMasks | VertexLabels:
    """The masks or labels in ``arrays``; a ``PredictionError`` where they are none."""
    are_labels = str(arrays["kind"]) == "VertexLabels"
    for name, (n_axes, kind) in _VERTEX_ARRAYS.items():
        array = arrays.get(name)
        is_asked = (name == "class_ids") == are_labels and name not in _OPTIONAL
        if array is None and is_asked:
            raise PredictionError(f"{where}: lacks '{name}'; evaluate again with --out")
        if array is not None and (array.ndim != n_axes or array.dtype.kind != kind):
            raise PredictionError(f"{where}: '{name}' is {kind_of(array)}; evaluate again with --out")
    numbering = NUMBERINGS.get(str(arrays.get("numbering", "id")))
    if are_labels:
        further = arrays.get("further")
        if numbering is None or (further is not None and len(further) != len(arrays["class_ids"])):
            raise PredictionError(f"{where}: holds no labels; evaluate again with --out")
        return VertexLabels(arrays["class_ids"], further, numbering)
    n_points = int(arrays["n_points"])
    if numbering is None or not len(arrays["indptr"]):
        raise PredictionError(f"{where}: holds no masks; evaluate again with --out")
    try:
        return VertexMasks(
            arrays["indptr"],
            arrays["indices"],
            n_points=None if n_points < 0 else n_points,
            scores=arrays["scores"],
            class_numbers=arrays.get("class_numbers"),
            numbering=numbering,
            features=arrays.get("features"),
            keys=tuple(str(key) for key in arrays["keys"]),
        )
    except PredictionError as error:
        raise PredictionError(f"{where}: {error}") from error


def _mapped_features(file: Path) -> NDArray[Any]:
    """The features that lie beside a dense prediction, without reading them."""
    table = map_npy(file)
    if table.ndim != 2 or table.dtype.kind != "f" or not table.flags.c_contiguous:
        raise PredictionError(f"{shown(file)}: no .npy table of features; copy it beside the prediction again")
    return table


def _check_points(where: str, content: Prediction) -> None:
    """Refuses what is no point, and a partition or features that do not go with their points."""
    if fault := value_fault(content):
        raise PredictionError(f"{where}: {fault}; run the scene again")


def _files(path: Path) -> dict[str, Path]:
    """The predictions below a run folder, its ``scenes`` or a scene's folder, by address; or the one file.

    Raises ``PredictionError`` where a scene has those of several methods.
    """
    if path.is_file():
        return {_scene_of(path): path} if path.suffix == ".npz" else {}
    above, files = next(
        ((above, files) for above in ("scenes/*/", "*/", "") if (files := sorted(path.glob(f"{above}*/{FILE}")))),
        ("", sorted(path.glob(FILE))),
    )
    methods = sorted({file.parent.name for file in files})
    if len(methods) > 1:
        raise PredictionError(
            f"{shown(path)}: holds predictions of {len(methods)} methods ({printable(', '.join(methods), 120)}); "
            f"give the folders of one: {shown(path)}/{above}{printable(methods[0], 60)}"
        )
    return {_scene_of(file): file for file in files}


def _scene_of(file: Path) -> str:
    """``dataset/scene`` where the file lies in a run folder, else the name of the file."""
    folder = file.absolute().parent.parent
    if folder.parent.name == JOBS:
        return scene_of_folder(folder.name)
    return file.stem
