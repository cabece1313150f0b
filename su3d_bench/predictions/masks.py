"""Masks over the points of the scene, or over their own points, in one archive or folder per scene.

Sources: PKU-EPIC/MaskClustering at commit eb2d41c, utils/post_process.py and semantics/open-voc_query.py;
VinAIResearch/Open3DIS at 4b05043, generate_3d_inst.py and maskwise_vocab.py of tools; aminebdj/OpenYOLO3D at 24f344d,
``predict`` of utils/__init__.py and the files of ``--path_to_3d_masks``; Pointcept/SegmentAnything3D at 2aaa8c9,
util.py, whose ``visualize_partition`` draws a random colour per group, black for none, and writes the cloud with
Open3D in the order of the scene's points; xuxw98/ESAM at 188fc6d, ``run`` and ``mask_to_color`` of
vis_demo/stream_demo.py, its only program that writes masks: one of 256 random colours per mask, grey for none;
yjtang249/OnlineAnySeg at 152466e, ``export_instance_mask`` of tool/post_process.py and ``save_pc`` of Scene_rep.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, converted, shown
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, Int32Array, Int64Array
from su3d_bench.formats import arrays
from su3d_bench.formats.numpy_files import map_npy, npz_names, read_npy, read_npz
from su3d_bench.formats.ply import first_rows, read_ply
from su3d_bench.formats.torch_files import SparseTensor, read_torch
from su3d_bench.predictions.base import NO_SCORES, Parsed, VertexMasks, vertex_masks
from su3d_bench.predictions.hovsg import read_points

ALL_ONES = "Open-YOLO 3D's own evaluator uses 1 for every score"
WITHOUT_CLASSES = "groups without classes"
FEATURES_SUFFIXES = ("_openmask3d_features.npy", "_features.npy", ".npy")
ONLINE_MASKS, ONLINE_CLOUD = "ckpt_final.npz", "final.ply"  # OnlineAnySeg's
POINTS, COLOURS = "points.npy", "points_color.npy"  # ESAM's
GREY = 200  # of every channel: a point in no mask of ESAM's
MAX_COLOURS = 256  # in its palette
CHANNELS = ("red", "green", "blue")
MIN_POINTS_PER_COLOUR = 20  # at least, on average over the first points, if colours are groups; photographs have 1 or 2


# ---- which format a file is of


def holds(kind: type | tuple[type, ...], content: str) -> Callable[[Path], str | None]:
    """A check whether the value in a ``torch.save`` file is of ``kind``, named ``content`` in messages."""

    def looks(first: Path) -> str | None:
        is_kind = isinstance(read_torch(first, is_outline=True), kind)
        return f"its {first.suffix} files contain {content}" if is_kind else None

    return looks


def looks_like_matrix(first: Path) -> str | None:
    is_hovsg = (first.parent / "mask_feats.pt").is_file()  # also a matrix, but of features
    return None if is_hovsg else holds(np.ndarray, "one matrix")(first)


def looks_like_masks(first: Path) -> str | None:
    is_online = first.name == ONLINE_MASKS  # over its own points
    return "its .npz files contain 'pred_masks'" if not is_online and "pred_masks" in npz_names(first) else None


def looks_like_groups(first: Path) -> str | None:
    if first.suffix != ".npy":
        return holds(np.ndarray, "one array")(first)
    array = map_npy(first)
    return "its .npy files contain a list of integers" if array.ndim == 1 and array.dtype.kind in "iu" else None


def looks_like_colours(first: Path) -> str | None:
    if (first.parent / ONLINE_MASKS).is_file():  # the cloud of those masks
        return None
    colours = _colours(first_rows(first, "vertex"))
    is_group = colours is not None and len(np.unique(colours)) * MIN_POINTS_PER_COLOUR <= len(colours) > 0
    return "its .ply files contain clouds in which many points share a colour" if is_group else None


# ---- matrices, run lengths and sparse tensors


def matrix_masks(where: str, value: object, scores: object = None, classes: object = None, **more: Any) -> VertexMasks:
    """The masks in the columns of a matrix (points, masks), with scores and classes unless None."""
    matrix = arrays.matrix_of(value, where)
    return _scored(where, arrays.column_members(matrix, where), len(matrix), scores, classes, **more)


def _scored(
    where: str, members: list[Int32Array], n_points: int | None, scores: object, classes: object, **more: Any
) -> VertexMasks:
    n = len(members)
    more["scores"] = None if scores is None else arrays.scores_of(scores, n, where)
    more["class_numbers"] = None if classes is None else arrays.classes_of(classes, n, where)
    return vertex_masks(where, members, n_points, **more)


def maskclustering(place: Path, scene: str) -> Parsed:
    where = shown(place)
    archive = read_npz(place, ("pred_masks", "pred_score", "pred_scores", "pred_classes"))
    if "pred_masks" not in archive:
        raise PredictionError(f"{where}: has no 'pred_masks'; expected an archive of MaskClustering or Mask3D")
    scores, classes = archive.get("pred_score", archive.get("pred_scores")), archive.get("pred_classes")
    masks = matrix_masks(where, archive["pred_masks"], scores, classes)
    remarks = [] if scores is not None else [NO_SCORES]
    if classes is not None and len(masks) and not classes.any():
        remarks.append("every mask has class 0, as MaskClustering writes class-agnostic masks")
    return masks, remarks


def openyolo3d(place: Path, scene: str) -> Parsed:
    where, value = shown(place), read_torch(place)
    if not isinstance(value, tuple | list) or len(value) not in (2, 3):
        raise PredictionError(
            f"{where}: holds {arrays.kind_of(value)}; expected masks and scores, or masks, classes and scores"
        )
    masks = matrix_masks(where, value[0], value[-1], value[1] if len(value) == 3 else None, numbering="index")
    return masks, (ALL_ONES,) if len(value) == 3 else ("proposals without classes", ALL_ONES)


def openmask3d(place: Path, scene: str) -> Parsed:
    """The masks with the unchanged features (masks, D) of the file next to them; a row with NaN counts as none."""
    where = shown(place)
    matrix = arrays.matrix_of(read_torch(place), where)
    n_masks = matrix.shape[1]
    names = [f"{scene}{end}" for end in FEATURES_SUFFIXES]
    file = next((candidate for name in names if (candidate := place.parent / name).is_file()), None)
    if file is None:
        remark = f"no '{names[0]}' next to the masks: they have no features"
        return matrix_masks(where, matrix), (NO_SCORES, remark)
    found = f"{shown(file)}: {n_masks} masks, but the features are"
    values = arrays.array_of(read_npy(file), found, "one row per mask", "fiu", n_masks, None)
    # OpenMask3D normalises and then replaces NaN with 0, so a row with NaN or infinity becomes zeros.
    features, remarks = arrays.without_nonfinite(arrays.as_float32(values), "masks")
    return matrix_masks(where, matrix, features=features), (NO_SCORES, *remarks)


def open3dis(place: Path, scene: str) -> Parsed:
    where, value = shown(place), read_torch(place)
    if not isinstance(value, dict) or "ins" not in value:
        raise PredictionError(f"{where}: holds {arrays.kind_of(value)} without 'ins'; expected a dict of Open3DIS")
    scores, classes = _scores_of_classes(value.get("conf"), value.get("final_class")), value.get("final_class")
    n_known = next(
        (len(column) for column in (classes, scores) if isinstance(column, np.ndarray) and column.ndim == 1), None
    )
    members, n_points = _instances(value["ins"], n_known, where)
    remarks = [NO_SCORES if scores is None else "Open3DIS's own evaluator uses 1 for every confidence"]
    if classes is None:
        remarks.append("the file has no classes: the masks are class-agnostic")
    return _scored(where, members, n_points, scores, classes, numbering="index"), remarks


def _scores_of_classes(scores: object, classes: object) -> object:
    """The score of the class of each mask, from maskwise_vocab.py's scores of all classes per mask."""
    if not all(isinstance(column, np.ndarray) and column.ndim == 1 and column.size for column in (scores, classes)):
        return scores
    table: Any = scores
    places: Any = classes
    n_classes, rest = divmod(len(table), len(places))
    is_place = places.dtype.kind in "iu" and 0 <= int(places.min()) <= int(places.max()) < n_classes
    if rest or n_classes == 1 or not is_place:
        return scores
    return table.reshape(-1, n_classes)[np.arange(len(places)), places]


def _instances(value: object, n_known: int | None, where: str) -> tuple[list[Int32Array], int | None]:
    """Members of each mask and the number of points, from run lengths or a matrix; ``n_known`` masks, if known."""
    if isinstance(value, np.ndarray):
        matrix = _masks_in_columns(arrays.matrix_of(value, where), n_known, where)
        return arrays.column_members(matrix, where), len(matrix)
    if not isinstance(value, list):
        raise PredictionError(f"{where}: 'ins' is {arrays.kind_of(value)}; expected a list of run lengths or a tensor")
    members: list[Int32Array] = []
    length, n = None, 0
    for k, mask in enumerate(value):
        if not isinstance(mask, dict) or "length" not in mask or "counts" not in mask:
            raise PredictionError(f"{where}: mask {k} is {arrays.kind_of(mask)}; expected a dict of length and counts")
        members.append(arrays.run_members(mask["length"], mask["counts"], f"{where}: mask {k}"))
        arrays.check_members(n := n + len(members[-1]) + len(mask["counts"]), where)  # empty runs take time too
        if length not in {None, int(mask["length"])}:
            raise PredictionError(f"{where}: mask {k} is of {mask['length']} points, mask 0 of {length}")
        length = int(mask["length"])
    return members, length


def _masks_in_columns(matrix: NDArray[Any], n_known: int | None, where: str) -> NDArray[Any]:
    """(points, masks): Open3DIS has masks in rows; decided by the number of scores or classes, or the longer side."""
    n_rows, n_columns = matrix.shape
    if n_known is not None and n_known not in {n_rows, n_columns}:
        raise PredictionError(f"{where}: the masks are {arrays.kind_of(matrix)}, with {n_known} scores or classes")
    are_rows = n_rows == n_known if n_known is not None else n_rows <= n_columns
    return matrix.T if are_rows else matrix


def openins3d(place: Path, scene: str) -> Parsed:
    where, value = shown(place), read_torch(place)
    if not isinstance(value, SparseTensor) or len(value.shape) != 2:
        raise PredictionError(
            f"{where}: holds {arrays.kind_of(value)}; expected a sparse tensor (points, masks) of OpenIns3D"
        )
    remark = "masks without classes; OpenIns3D's own evaluation uses classes and scores that it does not save"
    return _sparse_masks(value, where), (NO_SCORES, remark)


def _sparse_masks(sparse: SparseTensor, where: str) -> VertexMasks:
    values = arrays.matrix_of(sparse.values[np.newaxis], where)[0].astype(np.float64)
    n_points, n_masks = sparse.shape
    arrays.check_sizes(n_points, n_masks, where)
    limits = np.array(sparse.shape, np.int64)[:, np.newaxis]
    if ((sparse.indices < 0) | (sparse.indices >= limits)).any():
        raise PredictionError(f"{where}: a sparse tensor of shape {sparse.shape} has an index outside of it")
    order = np.lexsort((sparse.indices[0], sparse.indices[1]))
    rows, columns = sparse.indices[0][order], sparse.indices[1][order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = (np.diff(rows) != 0) | (np.diff(columns) != 0)
    sums = np.add.reduceat(values[order], np.flatnonzero(is_first)) if len(order) else values
    rows, columns = rows[is_first][sums != 0], columns[is_first][sums != 0]
    bounds = np.searchsorted(columns, np.arange(n_masks + 1))
    members = [rows[start:end].astype(np.int32) for start, end in pairwise(bounds)]
    return vertex_masks(where, members, n_points)


# ---- groups and colours


def sam3d(place: Path, scene: str) -> Parsed:
    """One integer per point of the scene, -1 if it is in no group."""
    where = shown(place)
    value = read_npy(place) if place.suffix == ".npy" else read_torch(place)
    groups = arrays.array_of(value, f"{where}: holds", "one group number per point", "iu", None)
    arrays.check_sizes(len(groups), 0, where)
    return masks_of_groups(groups, "group", where), (NO_SCORES, WITHOUT_CLASSES)


def sam3d_colours(place: Path, scene: str) -> Parsed:
    where = shown(place)
    with converted(DataError, PredictionError):
        vertices = read_ply(place, where).element("vertex")
    colours = None if vertices is None else _colours(vertices.columns)
    if colours is None:
        raise PredictionError(f"{where}: its points have no colours red, green, blue of one byte each")
    groups = np.where(colours == 0, -1, colours)
    if len(np.unique(groups)) > arrays.MAX_MASKS:
        raise PredictionError(
            f"{where}: {len(np.unique(groups))} colours; expected one per group: is it a cloud with image colours?"
        )
    remark = "one colour is one group: groups of the same colour are merged"
    return masks_of_groups(groups, "colour", where), (NO_SCORES, WITHOUT_CLASSES, remark)


def esam(place: Path, scene: str) -> Parsed:
    """The points of all frames, and the mask colour of each."""
    points, colours, where = read_npy(place / POINTS), read_npy(place / COLOURS), shown(place / COLOURS)
    cloud = points.reshape(-1, points.shape[-1]) if points.ndim == 3 else points
    places = arrays.checked_points(cloud, shown(place / POINTS))
    arrays.array_of(colours, f"{where}: holds", f"a colour for each of {POINTS}, {points.shape}", "iu", *points.shape)
    if colours.size and not 0 <= int(colours.min()) <= int(colours.max()) <= 255:
        raise PredictionError(f"{where}: a channel is {int(colours.min())} or {int(colours.max())}; expected 0 to 255")
    groups = _of_channels(*colours.reshape(-1, 3).T)
    masks = masks_of_groups(np.where(groups == _of_channels(GREY, GREY, GREY), -1, groups), "colour", where)
    if len(masks) > MAX_COLOURS:
        raise PredictionError(
            f"{where}: has {len(masks)} colours, ESAM's palette {MAX_COLOURS}; are they image colours?"
        )
    remark = "one colour is one mask: points shared by masks belong to one of them"
    return Instances.of(places, masks, names=masks.keys), (NO_SCORES, WITHOUT_CLASSES, remark)


def masks_of_groups(groups: NDArray[np.integer[Any]], noun: str, where: str) -> VertexMasks:
    """One mask per value from 0 up, in ascending order."""
    order = np.argsort(groups, kind="stable").astype(np.int32)
    order = order[np.count_nonzero(groups < 0) :]
    sorted_groups = groups[order]
    starts = np.flatnonzero(np.concatenate([[True], sorted_groups[1:] != sorted_groups[:-1]])[: len(order)])
    members = np.split(order, starts[1:])[: len(starts)]
    values = sorted_groups[starts].tolist()
    keys = [f"#{value:06x}" if noun == "colour" else f"{noun} {value}" for value in values]
    return vertex_masks(where, members, len(groups), keys=keys)


def _colours(columns: Mapping[str, object]) -> Int64Array | None:
    """The colour of each point as one number; None if the file has no colour bytes."""
    channels = [columns.get(name) for name in CHANNELS]
    if not all(isinstance(channel, np.ndarray) and channel.dtype == np.uint8 for channel in channels):
        return None
    return _of_channels(*channels)


def _of_channels(red: Any, green: Any, blue: Any) -> Int64Array:
    """Red * 65536 + green * 256 + blue."""
    return (np.asarray(red, np.int64) << 16) | (np.asarray(green, np.int64) << 8) | np.asarray(blue, np.int64)


def onlineanyseg(place: Path, scene: str) -> Parsed:
    """Masks over the reconstructed points, with one feature each (from the file's (D, masks))."""
    where = shown(place / ONLINE_MASKS)
    points = read_points(place / ONLINE_CLOUD)
    archive = read_npz(place / ONLINE_MASKS, ("pred_masks", "pred_score", "pred_sem_features"))
    masks = matrix_masks(where, archive.get("pred_masks"), archive.get("pred_score"))
    if masks.n_points != len(points):
        raise PredictionError(
            f"{where}: the masks are of {masks.n_points} points, {ONLINE_CLOUD} has {len(points)}; both must be of one "
            "run"
        )
    features: Float32Array | None = None
    remarks: tuple[str, ...] = ("the file has no features: the masks are class-agnostic",)
    if "pred_sem_features" in archive:
        found = f"{where}: {len(masks)} masks, but the features are"
        table = arrays.array_of(archive["pred_sem_features"], found, "one column per mask", "f", None, len(masks))
        features, remarks = arrays.without_nonfinite(arrays.as_float32(np.ascontiguousarray(table.T)), "masks")
    instances = Instances.of(points, masks, masks.scores, features, names=masks.keys)
    return instances, (*remarks, *(() if "pred_score" in archive else (NO_SCORES,)))
