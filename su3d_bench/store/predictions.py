"""The prediction of one scene as a file: the fields of its type as arrays, per-point features in a second file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.arguments import typed
from su3d_bench.core.errors import PredictionError, StoreError
from su3d_bench.core.files.atomic import DAMAGE, read_npz, remove_file, replacing, row_blocks, write_npz
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.system.files import regular

Place = str | Path
MAX_TEXTS = 1 << 20  # per field; each becomes a Python object
ROWS_AT_ONCE = 8192  # 16 MB of half precision at 1024 dimensions
# The dtype kind and shape of each field of a stored prediction, None for any length, in the order of the file.
FIELDS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "points": ("f", (None, 3)),
    "indptr": ("i", (None,)),
    "indices": ("i", (None,)),
    "scores": ("f", (None,)),
    "instance": ("i", (None,)),
    "features": ("f", (None, None)),
    "labels": ("U", (None,)),
    "names": ("U", (None,)),
    "captions": ("U", (None,)),
    "boxes": ("f", (None, 2, 3)),
    "centroids": ("f", (None, 3)),
    "view_indptr": ("i", (None,)),
    "views": ("i", (None, 2)),
    "ids": ("i", (None,)),
    "view_names": ("U", (None,)),
    "view_scores": ("f", (None,)),
    "further_labels": ("U", (None, None)),
    "edges": ("i", (None, 2)),
    "edge_scores": ("f", (None, None)),
    "predicates": ("U", (None,)),
}
# Kinds of stored predictions over points of files without coordinates; ``predictions.own_runs`` reads them.
OVER_VERTICES = ("VertexMasks", "VertexLabels")


def _fields_of(kind: type[Prediction]) -> list[str]:
    return [name for name in FIELDS if name in kind.__dataclass_fields__]


def prediction_arrays(prediction: Prediction) -> dict[str, NDArray[Any]]:
    """A prediction as named arrays, including ``kind``; absent fields are omitted."""
    arrays = {"kind": np.array(type(prediction).__name__)}
    for name in _fields_of(type(prediction)):
        value = getattr(prediction, name)
        if value is not None:
            arrays[name] = np.array(value, dtype=np.str_) if isinstance(value, tuple) else value
    return arrays


def prediction_from_arrays(arrays: Mapping[str, NDArray[Any]], where: str) -> Prediction:
    """The reverse of ``prediction_arrays``; ``where`` begins the message if the arrays are not a prediction."""
    kinds = {kind.__name__: kind for kind in (Instances, Partition, DenseFeatures)}
    kind = kinds.get(str(arrays.get("kind")))
    if str(arrays.get("kind")) in OVER_VERTICES:
        raise PredictionError(
            f"{where}: uses the points of ground-truth files, which have no coordinates, so there is no map; "
            "evaluate with the dataset itself (--dataset)"
        )
    if kind is None:
        raise PredictionError(f"{where}: has no 'kind' of {', '.join(kinds)}; it is not a prediction")
    if fault := array_fault(arrays):
        raise PredictionError(f"{where}: {fault}; run the scene again")
    for name in (name for name in FIELDS if name in arrays):
        if arrays[name].dtype.kind == "U" and arrays[name].size > MAX_TEXTS:
            raise PredictionError(f"{where}: '{name}' has {arrays[name].size} texts; is it damaged?")
    values: dict[str, Any] = {}
    for name in _fields_of(kind):
        value = arrays.get(name)
        values[name] = _texts(value) if value is not None and value.dtype.kind == "U" else value
    types = {name: str(field.type) for name, field in kind.__dataclass_fields__.items()}
    missing = [name for name, value in values.items() if value is None and "None" not in types[name]]
    if missing:
        raise PredictionError(f"{where}: '{missing[0]}' is missing; write it again with su3d-bench run")
    prediction: Prediction = kind(**values)
    return prediction


def _texts(values: NDArray[Any]) -> tuple[Any, ...]:
    return tuple(_texts(item) if isinstance(item, np.ndarray) else str(item) for item in values)


def array_fault(arrays: Mapping[str, NDArray[Any]]) -> str | None:
    """A message on the first array of a prediction with a wrong shape or dtype, with the expected one; or None."""
    kinds = {"f": "floats", "i": "integers", "U": "texts"}
    for name in (name for name in FIELDS if name in arrays):
        array, (kind, shape) = np.asarray(arrays[name]), FIELDS[name]
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind != kind or (name == "indptr" and not array.size):
            wanted = f"{kinds[kind]} ({', '.join('N' if n is None else str(n) for n in shape)})"
            return f"'{name}' is an array of shape {array.shape} {array.dtype.name}; expected {wanted}"
    return None


def value_fault(prediction: Prediction) -> str | None:
    """A message on the first invalid values of a prediction, or on sizes that do not match its points; or None."""
    n = len(prediction.points)
    scores = prediction.scores if isinstance(prediction, Instances) else np.zeros(0)
    for name, values in (("points", prediction.points), ("scores", scores)):
        if not np.isfinite(values).all():
            return f"'{name}' has values that are NaN or infinite"
    if isinstance(prediction, DenseFeatures) and len(prediction.features) != n:
        return f"{n} points and {len(prediction.features)} features"
    if isinstance(prediction, Partition):
        rows, n_rows = prediction.instance, len(prediction.features)
        if len(rows) != n or (len(rows) and not -1 <= int(rows.min()) <= int(rows.max()) < n_rows):
            return f"{n} points, {len(rows)} instance numbers to {int(rows.max(initial=-1))} and {n_rows} features"
    return None


def features_beside(path: Path) -> Path:
    """The path of the features of a dense prediction at ``path``: a separate file that is memory-mapped."""
    return path.with_name(f"{path.name.removesuffix('.npz')}.features.npy")


def write_prediction(path: Path, prediction: Prediction) -> None:
    """Store ``prediction`` at ``path``, and the features of a dense one in a second file."""
    arrays, features_path = prediction_arrays(prediction), features_beside(path)
    if isinstance(prediction, DenseFeatures):
        write_rows(features_path, arrays.pop("features"))
    else:
        remove_file(features_path)
    write_npz(path, arrays)


def write_rows(path: Path, table: NDArray[Any]) -> None:
    """Write ``table`` to ``path`` as a .npy file, one block at a time."""
    descr = np.lib.format.dtype_to_descr(table.dtype)
    with replacing(path) as stream:
        header = {"descr": descr, "fortran_order": False, "shape": table.shape}
        np.lib.format.write_array_header_1_0(stream, header)
        for _, block in row_blocks(table, ROWS_AT_ONCE):
            stream.write(np.ascontiguousarray(block).data)


@typed
def read_prediction(path: Place) -> Prediction:
    """The prediction that a run stored at ``path``; features of a dense one are memory-mapped.

    Points are metres, (M, 3) float32. Raises ``StoreError`` or ``PredictionError`` for a damaged or missing file.

    >>> import su3d_bench as su3d
    >>> prediction = su3d.read_prediction("runs/demo/scenes/rooms.bathroom7/oracle/prediction.npz")
    >>> type(prediction).__name__, prediction.points.shape[1]
    ('Instances', 3)
    """
    path = Path(path)
    arrays = read_npz(path)
    if str(arrays.get("kind")) == DenseFeatures.__name__ and "features" not in arrays:
        arrays["features"] = _mapped_rows(features_beside(path))
        if "points" not in arrays or arrays["features"].shape[:1] != arrays["points"].shape[:1]:
            raise StoreError(f"{features_beside(path)}: its rows do not match {path.name}; delete both and run again")
    return prediction_from_arrays(arrays, str(path))


def _mapped_rows(path: Path) -> NDArray[Any]:
    try:
        table: NDArray[Any] = np.lib.format.open_memmap(regular(path), mode="r")
    except DAMAGE as error:
        raise StoreError(f"{path}: not a readable .npy file ({error}); delete it and run again") from error
    if table.ndim != 2 or table.dtype.kind != "f":
        raise StoreError(f"{path}: has {table.dtype} {table.shape}; expected rows of features; delete it and run again")
    return table
