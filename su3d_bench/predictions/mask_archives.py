"""Masks over the scene's points in one archive a scene: MaskClustering, Mask3D, Open3DIS, Open-YOLO 3D, OpenIns3D.

Sources: PKU-EPIC/MaskClustering at commit eb2d41c, utils/post_process.py and semantics/open-voc_query.py;
VinAIResearch/Open3DIS at 4b05043, generate_3d_inst.py and maskwise_vocab.py of tools; aminebdj/OpenYOLO3D at 24f344d,
``predict`` of utils/__init__.py and the files of ``--path_to_3d_masks``.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.types import Int32Array
from su3d_bench.formats.arrays import (
    check_members,
    check_sizes,
    classes_of,
    column_members,
    kind_of,
    matrix_of,
    run_members,
    scores_of,
)
from su3d_bench.formats.numpy_files import npz_names, read_npz
from su3d_bench.formats.torch_zip import Kind, SparseTensor, read_torch, torch_kind
from su3d_bench.predictions.base import NO_SCORES, SceneFiles, ScenePrediction, VertexMasks, vertex_masks
from su3d_bench.predictions.online.onlineanyseg import MASKS as ONLINE_MASKS

ALL_ONES = "Open-YOLO 3D's own evaluator puts 1 for every score"


class TorchFiles(SceneFiles):
    """A format of one file of ``torch.save`` a scene, known by what the first of them holds."""

    kinds: tuple[Kind, ...]
    content: str  # what messages call that

    def recognise(self, path: Path) -> str | None:
        first = self.first(path, suffix := self.suffixes[-1])
        holds_kind = first is not None and torch_kind(first) in self.kinds
        return f"its {suffix} files hold {self.content}" if holds_kind else None


class MaskClustering(SceneFiles):
    name = "maskclustering"
    summary = "MaskClustering's <scene>.npz with pred_masks (points, masks), pred_score and pred_classes (Mask3D's too)"
    suffixes = (".npz",)

    def recognise(self, path: Path) -> str | None:
        first = self.first(path, ".npz")
        if first is None or first.name == ONLINE_MASKS:  # over points of its own
            return None
        return "its .npz files hold 'pred_masks'" if "pred_masks" in npz_names(first) else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place)
        arrays = read_npz(place, ("pred_masks", "pred_score", "pred_scores", "pred_classes"))
        if "pred_masks" not in arrays:
            raise PredictionError(f"{where}: has no 'pred_masks'; expected an archive of MaskClustering or Mask3D")
        matrix = matrix_of(arrays["pred_masks"], where)
        n_points, n_masks = matrix.shape
        remarks = []
        scores = arrays.get("pred_score", arrays.get("pred_scores"))
        if scores is None:
            remarks.append(NO_SCORES)
        classes = arrays.get("pred_classes")
        if classes is not None and n_masks and not classes.any():
            remarks.append("every mask has class 0, as MaskClustering writes class-agnostic masks")
        masks = vertex_masks(
            where,
            column_members(matrix, where),
            n_points,
            scores=None if scores is None else scores_of(scores, n_masks, where),
            class_numbers=None if classes is None else classes_of(classes, n_masks, where),
        )
        return ScenePrediction(scene, self.name, place, masks, tuple(remarks))


class Open3dis(TorchFiles):
    name = "open3dis"
    summary = "Open3DIS's <scene>.pth: a dict of ins (run-length masks or a tensor), conf and final_class"
    suffixes = (".pth",)
    kinds = ("dict",)
    content = "a dict"

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where, value = shown(place), read_torch(place)
        if not isinstance(value, dict) or "ins" not in value:
            raise PredictionError(f"{where}: holds {kind_of(value)} without 'ins'; expected a dict of Open3DIS")
        scores, classes = _scores_of_classes(value.get("conf"), value.get("final_class")), value.get("final_class")
        n_known = next(
            (len(column) for column in (classes, scores) if isinstance(column, np.ndarray) and column.ndim == 1), None
        )
        members, n_points = _instances(value["ins"], n_known, where)
        remarks = [NO_SCORES if scores is None else "Open3DIS's own evaluator puts 1 for every confidence"]
        if classes is None:
            remarks.append("the file has no classes: the masks are class-agnostic")
        masks = vertex_masks(
            where,
            members,
            n_points,
            scores=None if scores is None else scores_of(scores, len(members), where),
            class_numbers=None if classes is None else classes_of(classes, len(members), where),
            numbering="index",
        )
        return ScenePrediction(scene, self.name, place, masks, tuple(remarks))


def _scores_of_classes(scores: object, classes: object) -> object:
    """The score of the class of each mask, where maskwise_vocab.py has those of all classes, mask after mask."""
    are_lists = all(isinstance(column, np.ndarray) and column.ndim == 1 for column in (scores, classes))
    if not are_lists or not isinstance(scores, np.ndarray) or not isinstance(classes, np.ndarray) or not len(classes):
        return scores
    n_classes, rest = divmod(len(scores), len(classes))
    is_place = classes.dtype.kind in "iu" and 0 <= int(classes.min()) <= int(classes.max()) < n_classes
    return (
        scores.reshape(-1, n_classes)[np.arange(len(classes)), classes]
        if not rest and n_classes > 1 and is_place
        else scores
    )


def _instances(value: object, n_known: int | None, where: str) -> tuple[list[Int32Array], int | None]:
    """Members of each mask and the number of points, from run lengths or a matrix; ``n_known`` masks, if known."""
    if isinstance(value, np.ndarray):
        matrix = _masks_in_columns(matrix_of(value, where), n_known, where)
        return column_members(matrix, where), len(matrix)
    if not isinstance(value, list):
        raise PredictionError(f"{where}: 'ins' is {kind_of(value)}; expected a list of run lengths or a tensor")
    members: list[Int32Array] = []
    length, n = None, 0
    for k, mask in enumerate(value):
        if not isinstance(mask, dict) or "length" not in mask or "counts" not in mask:
            raise PredictionError(f"{where}: mask {k} is {kind_of(mask)}; expected a dict of length and counts")
        members.append(run_members(mask["length"], mask["counts"], f"{where}: mask {k}"))
        check_members(n := n + len(members[-1]) + len(mask["counts"]), where)  # empty runs take time, too
        if length not in {None, int(mask["length"])}:
            raise PredictionError(f"{where}: mask {k} is of {mask['length']} points, mask 0 of {length}")
        length = int(mask["length"])
    return members, length


def _masks_in_columns(matrix: NDArray[Any], n_known: int | None, where: str) -> NDArray[Any]:
    """(points, masks): Open3DIS has masks in rows; the number of scores or classes tells, or else the longer side."""
    n_rows, n_columns = matrix.shape
    if n_known is not None and n_known not in {n_rows, n_columns}:
        raise PredictionError(f"{where}: the masks are {kind_of(matrix)}, but there are {n_known} scores or classes")
    are_rows = n_rows == n_known if n_known is not None else n_rows <= n_columns
    return matrix.T if are_rows else matrix


class OpenYolo3d(TorchFiles):
    name = "openyolo3d"
    summary = "Open-YOLO 3D's <scene>.pt: proposals, masks (points, masks) and scores, or masks, classes and scores"
    suffixes = (".pt",)
    kinds = ("tuple",)
    content = "a tuple"

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where, value = shown(place), read_torch(place)
        if not isinstance(value, tuple | list) or len(value) not in (2, 3):
            raise PredictionError(
                f"{where}: holds {kind_of(value)}; expected masks and scores, or masks, classes and scores"
            )
        matrix = matrix_of(value[0], where)
        scores = scores_of(value[-1], matrix.shape[1], where)
        classes = classes_of(value[1], matrix.shape[1], where) if len(value) == 3 else None
        members = column_members(matrix, where)
        masks = vertex_masks(where, members, len(matrix), scores=scores, class_numbers=classes, numbering="index")
        remarks = () if classes is not None else ("proposals without classes",)
        return ScenePrediction(scene, self.name, place, masks, (*remarks, ALL_ONES))


class OpenIns3d(TorchFiles):
    name = "openins3d"
    summary = "OpenIns3D's masks <scene>.pt: a sparse tensor (points, masks), without scores and classes"
    suffixes = (".pt",)
    kinds = ("sparse",)
    content = "a sparse tensor"

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where, value = shown(place), read_torch(place)
        if not isinstance(value, SparseTensor) or len(value.shape) != 2:
            raise PredictionError(
                f"{where}: holds {kind_of(value)}; expected a sparse tensor (points, masks), as OpenIns3D saves it"
            )
        remarks = (
            NO_SCORES,
            "masks without classes; OpenIns3D evaluates with classes and scores that it does not save",
        )
        return ScenePrediction(scene, self.name, place, _sparse_masks(value, where), remarks)


def _sparse_masks(sparse: SparseTensor, where: str) -> VertexMasks:
    values = matrix_of(sparse.values[np.newaxis], where)[0].astype(np.float64)
    n_points, n_masks = sparse.shape
    check_sizes(n_points, n_masks, where)
    order = np.lexsort((sparse.indices[0], sparse.indices[1]))
    rows, columns = sparse.indices[0][order], sparse.indices[1][order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = (np.diff(rows) != 0) | (np.diff(columns) != 0)
    sums = np.add.reduceat(values[order], np.flatnonzero(is_first)) if len(order) else values
    rows, columns = rows[is_first][sums != 0], columns[is_first][sums != 0]
    bounds = np.searchsorted(columns, np.arange(n_masks + 1))
    members = [rows[start:end].astype(np.int32) for start, end in pairwise(bounds)]
    return vertex_masks(where, members, n_points)
