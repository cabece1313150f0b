"""The output of prediction readers, whatever the format: masks, labels or a map of one scene, with remarks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError, printable, reading, shown
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition, starts_of
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Int64Array
from su3d_bench.formats.arrays import MAX_MASKS, MAX_POINTS, check_members
from su3d_bench.metrics.matching.transfer import masks_of_partition
from su3d_bench.metrics.protocols.model import ProtocolRules

NO_SCORES = "the file has no scores: 1 for every mask"
ONES = "the format has no scores: 1 for every object"
Numbering = Literal["id", "index", "line"]


@dataclass(frozen=True, kw_only=True)
class VertexMasks(Masks):
    """Masks over the points of the ground truth, in its order; the file has no coordinates.

    ``n_points`` is None if the file does not state it (a list without masks). ``scores`` (K,) are finite.
    ``class_numbers`` (K,) are those of the file, None if it has no classes: with ``numbering`` "id" class ids of the
    label space, with "index" indices of the classes that a protocol scores, with "line" indices of its whole list.
    ``features`` (K, D): all-zero rows mean none. ``keys`` name the masks in messages.
    """

    n_points: int | None
    scores: Float64Array
    class_numbers: Int32Array | None = None
    numbering: Numbering = "id"
    features: Float32Array | None = None
    keys: tuple[str, ...]

    def __post_init__(self) -> None:
        k = len(self.keys)
        shapes = [array.shape for array in (self.scores, self.class_numbers) if array is not None]
        if self.indptr.shape != (k + 1,) or not self.is_whole or (self.n_points is None and k):
            raise PredictionError(f"{k} masks: indptr of {self.indptr.shape} does not fit them")
        if shapes.count((k,)) < len(shapes) or (self.features is not None and self.features.shape[:1] != (k,)):
            raise PredictionError(f"{k} masks, but a different number of scores, classes or features")
        if not np.isfinite(self.scores).all():
            worst = int(np.flatnonzero(~np.isfinite(self.scores))[0])
            raise PredictionError(f"mask '{self.keys[worst]}': the score is {self.scores[worst]}; it must be finite")
        self._check_indices()

    def _check_indices(self) -> None:
        if not len(self.indices):
            return
        is_start = np.zeros(len(self.indices), np.bool_)
        is_start[self.indptr[:-1][self.sizes > 0]] = True
        is_wrong = (self.indices < 0) | (self.indices >= (self.n_points or 0))
        is_wrong[1:] |= (np.diff(self.indices) <= 0) & ~is_start[1:]
        if is_wrong.any():
            worst = int(np.argmax(is_wrong))
            raise PredictionError(
                f"mask '{self.keys[self.owner_at(worst)]}': point {int(self.indices[worst])} is out of range or out of "
                f"order, the scene has {self.n_points} points"
            )

    def class_ids(self, rules: ProtocolRules) -> Int64Array:
        """The class id (K,) of each mask, 0 for none."""
        if self.class_numbers is None:
            return np.zeros(len(self), np.int64)
        return ids_of(self.class_numbers, self.numbering, rules)

    def on(self, points: Float32Array, rules: ProtocolRules) -> Instances:
        """The map of the masks on the ground-truth ``points``, with the names of the protocol's classes as labels."""
        labels: tuple[str, ...] | None = None if len(self) else ()
        if self.class_numbers is not None:
            name_of = {entry.id: entry.name for entry in rules.classes}
            labels = tuple(name_of.get(class_id, f"class {class_id}") for class_id in self.class_ids(rules).tolist())
        return Instances.of(points, self, self.scores, self.features, labels=labels, names=self.keys)


def ids_of(numbers: Int32Array, numbering: Numbering, rules: ProtocolRules) -> Int64Array:
    """The class ids of ``numbers`` of any shape under a protocol, 0 for those of none of its classes."""
    wide = numbers.astype(np.int64)
    if numbering == "id":
        return wide
    ids = np.array([entry.id for entry in (rules.scored if numbering == "index" else rules.classes)], np.int64)
    is_known = (wide >= 0) & (wide < len(ids))
    return np.append(ids, 0)[np.where(is_known, wide, len(ids))]


@dataclass(frozen=True)
class VertexLabels:
    """One class number per ground-truth point, in its order, and ``further`` (N, k) ones, the most likely first."""

    class_ids: Int32Array
    further: Int32Array | None = None
    numbering: Numbering = "id"

    def masks(self) -> VertexMasks:
        """One mask per class, using the first class of each point."""
        return self._masks(self.class_ids[:, None])[0]

    def on(self, points: Float32Array, rules: ProtocolRules) -> Instances:
        """The map of one mask per class, or row of classes, on the ground-truth ``points``, named by ``rules``."""
        if self.further is None:
            return self.masks().on(points, rules)
        masks, numbers = self._masks(np.column_stack([self.class_ids, self.further]))
        named = masks.on(points, rules)
        name_of = {entry.id: entry.name for entry in rules.classes}
        ids = ids_of(numbers[:, 1:], self.numbering, rules)
        return replace(named, further_labels=tuple(tuple(name_of.get(one, "") for one in row) for row in ids.tolist()))

    def _masks(self, rows: Int32Array) -> tuple[VertexMasks, Int32Array]:
        """One mask per distinct row (R,) of ``rows`` (N, k), and these rows."""
        values, row = np.unique(rows if rows.shape[1] > 1 else rows[:, 0], axis=0, return_inverse=True)
        distinct = values.reshape(-1, rows.shape[1]).astype(np.int32)
        masks, first = masks_of_partition(row.ravel(), len(distinct)), distinct[:, 0]
        of_rows = VertexMasks(
            masks.indptr,
            masks.indices,
            n_points=len(rows),
            scores=np.ones(len(distinct)),
            class_numbers=first,
            numbering=self.numbering,
            keys=tuple(f"class {number}" for number in first),
        )
        return of_rows, distinct


Content = VertexMasks | VertexLabels | Instances | Partition | DenseFeatures  # the last three have their own points


def vertex_masks(
    where: str,
    members: Iterable[Int32Array],
    n_points: int | None,
    *,
    scores: Float64Array | None = None,
    keys: Sequence[str] | None = None,
    **more: Any,
) -> VertexMasks:
    """The masks whose point indices are ``members``; score 1 and keys ``mask 0``, ... by default."""
    parts: list[Int32Array] = []
    n = 0
    for part in members:
        check_members(n := n + len(part), where)
        parts.append(part)
    masks = Masks.of_sets(parts)
    names = tuple(keys if keys is not None else (f"mask {k}" for k in range(len(parts))))
    scores = np.ones(len(parts)) if scores is None else scores
    with named(where):
        return VertexMasks(masks.indptr, masks.indices, n_points=n_points, scores=scores, keys=names, **more)


@contextmanager
def named(where: str) -> Iterator[None]:
    """Prefix errors of the block with ``where``."""
    try:
        yield
    except PredictionError as error:
        raise PredictionError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error


def instances_of(clouds: Sequence[Float32Array], where: str, features: Float32Array | None, **texts: Any) -> Instances:
    """One instance per cloud, each with its own points, score 1 and no views; boxes of empty clouds are zeros."""
    sizes = np.array([len(cloud) for cloud in clouds], np.int64)
    n = int(sizes.sum())
    if n > MAX_POINTS or len(clouds) > MAX_MASKS:
        raise PredictionError(f"{where}: {len(clouds)} objects of {n} points; is it damaged?")
    points = np.concatenate([np.zeros((0, 3), np.float32), *clouds])
    masks = Masks(starts_of(sizes), np.arange(n, dtype=np.int32))
    return Instances.of(points, masks, None, features, **texts)


@dataclass(frozen=True)
class ScenePrediction:
    """The content of one scene's files; ``remarks`` are facts that affect the interpretation of the results."""

    scene: str
    format: str
    path: Path
    content: Content
    remarks: tuple[str, ...] = ()


Parsed = tuple[Content, Sequence[str]]  # content of one scene, with remarks
Parse = Callable[[Path, str], Parsed]  # from its file or folder, and its name


@dataclass(frozen=True)
class Reader:
    """One format of predictions.

    ``recognise`` returns why a path is of this format, from names and first bytes only, None if it is not; ``scenes``
    the file or folder of each scene by its name in the files; ``parse`` the content of one of these.
    """

    name: str
    recognise: Callable[[Path], str | None]
    scenes: Callable[[Path], Mapping[str, Path]]
    parse: Parse
    noun: str = "prediction"  # its name in messages

    def read(self, path: Path, scene: str) -> ScenePrediction:
        """The prediction of one of ``scenes(path)``; ``PredictionError`` if it cannot be used."""
        place = self.scenes(path).get(scene)
        if place is None:
            raise PredictionError(f"{shown(path)}: has no {self.noun} of scene '{printable(scene, 80)}'")
        content, remarks = self.parse(place, scene)
        return ScenePrediction(scene, self.name, place, content, tuple(remarks))


def file_format(name: str, suffixes: Sequence[str], looks: Callable[[Path], str | None], parse: Parse) -> Reader:
    """A format with one file per scene, named after it and ending in the first of ``suffixes`` that fits.

    ``looks`` returns, for the first file with the last suffix, then those with the others, why it is of this format.
    """

    def recognise(path: Path) -> str | None:
        for suffix in reversed(suffixes):
            first = next(iter(scene_files(path, (suffix,)).values()), None) if path.exists() else None
            with suppress(DataError, PredictionError):
                if first is not None and (reason := looks(first)) is not None:
                    return reason
        return None

    return Reader(name, recognise, lambda path: scene_files(path, suffixes), parse)


def scene_of_folder(folder: Path, path: Path) -> str:
    """The name of the scene whose ``folder`` was found in ``path``."""
    return folder.absolute().name


def folder_format(
    name: str,
    first: str,
    second: str,
    parse: Parse,
    noun: str = "map",
    scene_of: Callable[[Path, Path], str] = scene_of_folder,
    n_above: int = 2,
) -> Reader:
    """A format with one folder per scene, at most ``n_above`` folders below the path.

    ``first`` and ``second`` are in it; ``scene_of`` names the scene of a folder that was found in a path.
    """

    def folders(path: Path) -> list[Path]:
        files = first_found(path, ["*/" * n + first for n in range(n_above + 1)])
        return [file.parent for file in files if (file.parent / second).exists()]

    def recognise(path: Path) -> str | None:
        names = " and ".join(dict.fromkeys((first, second)))
        return f"it contains {names}" if path.is_dir() and folders(path) else None

    def scenes(path: Path) -> Mapping[str, Path]:
        return named_once([(scene_of(folder, path), folder) for folder in folders(path)], path)

    return Reader(name, recognise, scenes, parse, noun)


def scene_files(path: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files with one of ``suffixes`` in a folder, or one file, by their names without it, in alphabetical order.

    Hidden files, READMEs and licences are not scenes.
    """
    with reading(shown(path)):
        files = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())
    of_scene = {}
    for file in files:
        suffix = next((suffix for suffix in suffixes if file.name.endswith(suffix) and file.name != suffix), None)
        if suffix is not None and file.name.split(".")[0].lower() not in ("", "readme", "license", "licence"):
            of_scene[file.name.removesuffix(suffix)] = file
    return of_scene


def first_found(path: Path, patterns: Sequence[str]) -> list[Path]:
    """The matches of the first of ``patterns`` that matches anything in ``path``, in alphabetical order."""
    with reading(shown(path)):
        return next((matches for pattern in patterns if (matches := sorted(path.glob(pattern)))), [])


def named_once(pairs: Sequence[tuple[str, Path]], path: Path) -> Mapping[str, Path]:
    """``pairs`` as a table; ``PredictionError`` if two paths are of the same scene."""
    table: dict[str, Path] = {}
    for name, place in pairs:
        if table.setdefault(name, place) != place:
            raise PredictionError(
                f"{printable(str(path), 120)}: {printable(str(table[name]), 120)} and {printable(str(place), 120)} are "
                f"both of scene '{printable(name, 80)}'; give one of them"
            )
    return table
