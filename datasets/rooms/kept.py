"""What is costly to make of a room, kept in the data root: its mesh with the baked light, its walk and its scan."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import filling, read_arrays
from su3d_bench.core.files.unpacking import DAMAGE
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.rooms.rendering.mesh import RoomMesh
from su3d_bench.datasets.rooms.scan import RoomScan

Arrays = dict[str, Any]
# Of every array of a mesh: its type, and its shape by what it counts; a number stands for itself.
MESH_ARRAYS: dict[str, tuple[Any, tuple[str | int, ...]]] = {
    "vertices": (np.float32, ("vertices", 3)),
    "normals": (np.float32, ("vertices", 3)),
    "texture": (np.float32, ("vertices", 3)),
    "light": (np.float32, ("vertices", 3)),
    "triangles": (np.int32, ("triangles", 3)),
    "instance_of_triangle": (np.int32, ("triangles",)),
    "material_of_triangle": (np.int32, ("triangles",)),
    "materials": (np.float32, ("materials", 16)),
    "lights": (np.float32, ("lights", 4)),
}


def kept_mesh(path: Path | None, make: Callable[[], RoomMesh]) -> RoomMesh:
    """The mesh in ``path``, byte for byte what ``make`` made; made where it is not there, and then kept there."""
    return RoomMesh(**_kept(path, lambda: _arrays_of(make()), _is_mesh))


def kept_scan(path: Path, make: Callable[[], RoomScan]) -> RoomScan:
    """The scan in ``path``; made where it is not there, and then kept there, which must be possible."""
    names = {field.name for field in fields(RoomScan)}
    try:
        return RoomScan(**_kept(path, lambda: _arrays_of(make()), lambda arrays: set(arrays) == names, forgiven=()))
    except OSError as error:
        raise DataError(
            f"rooms: cannot write the scan to {path} ({error.strerror}); set SU3D_DATA to a folder that can be written"
        ) from error


def _arrays_of(kept: RoomMesh | RoomScan) -> Arrays:
    return {field.name: getattr(kept, field.name) for field in fields(kept)}


def kept_walk(path: Path | None, n_frames: int, make: Callable[[], Float64Array]) -> Float64Array:
    """The poses (n_frames, 4, 4) in ``path``; made where they are not there, and then kept there."""

    def is_walk(arrays: Arrays) -> bool:
        poses = arrays["poses"]
        return bool(poses.shape == (n_frames, 4, 4) and poses.dtype == np.float64)

    poses: Float64Array = _kept(path, lambda: {"poses": make()}, is_walk)["poses"]
    return poses


def _kept(
    path: Path | None,
    make: Callable[[], Arrays],
    fits: Callable[[Arrays], bool],
    forgiven: tuple[type[OSError], ...] = (OSError,),
) -> Arrays:
    """A folder that takes no file only means that the next process makes the arrays again, where that is forgiven."""
    if path is None:
        return make()
    with suppress(*DAMAGE):
        kept = read_arrays(path)
        if fits(kept):
            return kept
    made = make()
    with suppress(*forgiven), filling(path) as stream:
        np.savez(stream, **made)
    return made


def _is_mesh(arrays: Arrays) -> bool:
    """Whether native code may be handed the arrays: all are there and no index points beyond what it points into."""
    sizes: dict[str | int, int] = {3: 3, 4: 4, 16: 16}
    if set(arrays) != set(MESH_ARRAYS):
        return False
    for name, (dtype, shape) in MESH_ARRAYS.items():
        array = arrays[name]
        if array.dtype != dtype or array.ndim != len(shape):
            return False
        if any(sizes.setdefault(word, size) != size for word, size in zip(shape, array.shape, strict=True)):
            return False
    return all(
        len(arrays[name]) and arrays[name].min() >= 0 and arrays[name].max() < limit
        for name, limit in (
            ("triangles", sizes["vertices"]),
            ("instance_of_triangle", np.inf),
            ("material_of_triangle", sizes["materials"]),
        )
    )
