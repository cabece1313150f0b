"""3D proposals out of the files of Mask3D, Segment3D and OpenMask3D, in any format of masks that `evaluate` reads."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.maps import Proposals
from su3d_bench.core.types import Surface
from su3d_bench.predictions.base import VertexMasks


def read_proposals(folder: Path, scene: str, surface: Surface) -> Proposals:
    """The masks of ``scene`` over the vertices of ``surface``, in the order of the file; classes are left aside.

    Raises ``PredictionError`` where the files hold no masks, cannot be used, or are of another mesh.
    """
    from su3d_bench.predictions.formats import recognise  # every format there is: not for a list of methods

    reader = recognise(folder)
    prediction = reader.read(folder, scene)
    masks, where = prediction.content, shown(prediction.path)
    if not isinstance(masks, VertexMasks):
        raise PredictionError(f"{where}: format '{reader.name}' holds no masks over the mesh; give proposals that do")
    n_vertices = len(surface.vertices)
    if masks.n_points not in (None, n_vertices):
        raise PredictionError(
            f"{where}: proposals of {masks.n_points} points, but the mesh of '{scene}' has {n_vertices} vertices; take "
            "proposals that were made on this mesh"
        )
    source = f"{reader.name} in {where}"
    return Proposals(masks.indptr, masks.indices, points=surface.vertices, scores=masks.scores, source=source)


def digest_of_folder(folder: Path) -> str:
    """A key of the names and content of all files below ``folder``; of a missing one, of nothing."""
    files: Mapping[str, Path] = {
        path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()
    }
    try:
        stats = {name: path.stat() for name, path in files.items()}
        return digest_json({name: _digest(files[name], stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()})
    except OSError as error:
        raise PredictionError(f"{shown(folder)}: {error.filename} cannot be read: {error.strerror}") from error


@cache
def _digest(path: Path, size: int, changed_ns: int) -> str:
    """Of the content; what size and time tell is that it need not be read again for the next scene."""
    return digest_file(path)
