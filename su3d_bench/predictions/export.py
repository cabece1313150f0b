"""Predictions in the formats of other evaluators: OpenLex3D's three files, the lists of masks of ScanNet and
ScanNet++, the ranked classes of ScanNet++, and the OpenSUN3D challenge's submissions, with the masks for the query
of each scene."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, StoreError, printable
from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.files.locks import publish, unfinished_folder
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition
from su3d_bench.core.types import Float32Array, Float64Array, GroundTruth, Int32Array, Int64Array
from su3d_bench.formats.pcd import write_pcd_points
from su3d_bench.metrics.instance.score import masks_and_scores, named_classes
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.labelling import cosines, device_of, encoder_warning, text_features
from su3d_bench.metrics.open_vocabulary.score import NEEDS_FEATURES
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic.top_k import ranked_at
from su3d_bench.predictions.base import Content, Numbering, VertexLabels, VertexMasks
from su3d_bench.predictions.dense import CLOUD, LEX_EMBEDDINGS, LEX_INDEX
from su3d_bench.predictions.scannet_text import MASK_OF_RUNS

MASKS_FOLDER = "pred_mask"
RUNS_FOLDER = "predicted_masks"  # its name in ScanNet++'s own writer and the OpenSUN3D challenge
ROWS_AT_ONCE = 1 << 14
# demo_eval.py of OpenSun3D/cvpr24-challenge at 59db30f reads a list with numpy.loadtxt and stops at one of fewer lines.
MIN_MASKS = 2
FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,150}")


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A folder to fill, which becomes ``out`` if the block succeeds and is removed otherwise.

    ``out`` must not exist yet, or must be an empty folder.
    """
    is_empty = not out.exists() or (out.is_dir() and not any(out.iterdir()))
    if not is_empty or out.is_symlink():
        raise StoreError(f"{out}: already exists; choose another folder with --out, or remove it")
    out = out.absolute()
    make_folder(out.parent)
    try:
        with unfinished_folder(out) as filled:
            yield filled
            publish(filled, out)
    except OSError as error:
        raise StoreError(f"cannot write {out}: {error.strerror or error}") from error


def file_name(scene: str) -> str:
    """``scene`` as a file name; ``PredictionError`` if it would be outside the folder."""
    if FILE_NAME.fullmatch(scene) is None:
        raise PredictionError(f"scene '{printable(scene, 80)}': is not a valid file name; rename its files")
    return scene


# ---- OpenLex3D


@dataclass(frozen=True)
class OpenLexParts:
    """Points (N, 3), the object (N,) of each, features (K, D) of the objects, and remarks on the rest."""

    points: Float32Array
    index: Int64Array
    features: NDArray[np.floating[Any]]
    remarks: tuple[str, ...]


def openlex_parts(content: Content) -> OpenLexParts:
    """A map in OpenLex3D's form: every point in one object, the first that contains it; other points are omitted."""
    if isinstance(content, VertexMasks | VertexLabels):
        raise PredictionError("is over the points of the ground truth and has no points, which OpenLex3D needs")
    features, remarks = content.features, []
    if features is None:
        raise PredictionError("has no features, and OpenLex3D needs one for each object")
    if isinstance(content, DenseFeatures):
        return _dense_parts(content)
    if isinstance(content, Instances):
        owner = transfer.first_owner(content, len(content.points))
        n_shared = int((np.bincount(content.indices, minlength=1) > 1).sum())
        if n_shared:
            remarks.append(f"{n_shared} points are in several objects and were assigned to the first")
    else:
        _check_partition(content)
        owner = content.instance.astype(np.int64)
    kept = owner >= 0
    if n_without := int((~kept).sum()):
        remarks.append(f"{n_without} of {len(kept)} points are in no object and were omitted")
    n_empty = len(features) - len(np.unique(owner[kept]))
    if n_empty:
        remarks.append(f"{n_empty} of {len(features)} objects have no points")
    return OpenLexParts(_finite(content.points[kept]), owner[kept], features, tuple(remarks))


def _check_partition(content: Partition) -> None:
    n = len(content.features)
    if content.instance.shape != (len(content.points),) or content.instance.max(initial=-1) >= n:
        raise PredictionError(f"needs one of its {n} rows of features per point, -1 for none; create the map again")


def _dense_parts(content: DenseFeatures) -> OpenLexParts:
    """Each point as its own object; points without a feature are omitted."""
    has_feature = np.zeros(len(content.points), np.bool_)
    for start in range(0, len(has_feature), ROWS_AT_ONCE):
        has_feature[start : start + ROWS_AT_ONCE] = content.features[start : start + ROWS_AT_ONCE].any(axis=1)
    remarks = ["each point is its own object"]
    if n_without := int((~has_feature).sum()):
        remarks.append(f"{n_without} of {len(has_feature)} points have no feature and were omitted")
    rows = np.cumsum(has_feature)[has_feature] - 1
    features: Any = content.features if has_feature.all() else content.features[has_feature]
    return OpenLexParts(_finite(content.points[has_feature]), rows.astype(np.int64), features, tuple(remarks))


def _finite(points: Float32Array) -> Float32Array:
    if not len(points):
        raise PredictionError("has no points in any object; there is nothing to export")
    if not np.isfinite(points).all():
        raise PredictionError("has points that are NaN or infinite; create the map again")
    return points


def write_openlex(content: Content, folder: Path) -> tuple[str, ...]:
    """``point_cloud.pcd``, ``index.npy`` and ``embeddings.npy`` of one scene; returns remarks on what did not fit."""
    parts = openlex_parts(content)
    make_folder(folder)
    write_pcd_points(folder / CLOUD, parts.points)
    np.save(folder / LEX_INDEX, parts.index)
    with (folder / LEX_EMBEDDINGS).open("wb") as stream:
        header = {"descr": "<f4", "fortran_order": False, "shape": parts.features.shape}
        np.lib.format.write_array_header_1_0(stream, header)
        for start in range(0, len(parts.features), ROWS_AT_ONCE):  # the table may be larger than memory
            stream.write(np.ascontiguousarray(parts.features[start : start + ROWS_AT_ONCE], "<f4").tobytes())
    return parts.remarks


# ---- ScanNet


@dataclass(frozen=True)
class LabelledMasks:
    """K masks over ``n_points`` ground-truth points, with a class id (K,), 0 for none, and a score (K,) each."""

    masks: Masks
    n_points: int
    class_ids: Int64Array
    scores: Float64Array
    remarks: tuple[str, ...] = ()


def needs_truth(content: Content, numbering: Numbering = "id") -> bool:
    """Whether the file lacks masks and classes of this ``numbering``: other points or numbers, or none."""
    return not isinstance(content, VertexMasks) or content.class_numbers is None or content.numbering != numbering


def masks_as_they_are(content: VertexMasks) -> LabelledMasks:
    """Masks over the ground-truth points with their own class ids; for indices into a list, the ids are one more."""
    assert content.class_numbers is not None and content.numbering != "index"
    ids = content.class_numbers.astype(np.int64) + (content.numbering == "line")
    return LabelledMasks(content, content.n_points or 0, ids, content.scores)


def masks_on_truth(
    content: Content, rules: ProtocolRules, truth: GroundTruth, encoder: Encoder | None
) -> LabelledMasks:
    """The masks transferred to the ground-truth points by ``rules``, with class ids of its label set.

    Classes are those of the prediction, otherwise ``encoder`` classifies its features among the classes of ``rules``.
    """
    named, remarks = _as_map(content, truth.points, rules), list[str]()
    if isinstance(named, Partition):
        _check_partition(named)
        remarks.append("a partition has no scores: 1 for every mask")
    masks, scores = masks_and_scores(named)
    moved = _moved(named, masks, scores, truth.points, rules)
    if isinstance(content, VertexMasks) and content.class_numbers is not None:
        class_ids = content.class_ids(rules)
    else:
        class_ids = named_classes(rules, truth.semantic, named, encoder)
        remarks += [warning] if (warning := encoder_warning(rules, named, encoder)) is not None else []
    return LabelledMasks(moved, len(truth.points), class_ids, scores, tuple(remarks))


def _as_map(content: Content, vertices: Float32Array, rules: ProtocolRules) -> Instances | Partition:
    """The map of masks, those of the ``vertices`` with these as their points."""
    if isinstance(content, VertexLabels | DenseFeatures):
        raise PredictionError("has no masks, which a list of masks needs")
    if not isinstance(content, VertexMasks):
        return content
    if content.n_points not in {None, len(vertices)}:
        raise PredictionError(f"is of {content.n_points} points, the scene of {len(vertices)}; both need one mesh")
    return content.on(vertices, rules)


def _moved(
    named: Instances | Partition, masks: Masks, scores: Float64Array, vertices: Float32Array, rules: ProtocolRules
) -> Masks:
    """The ``masks`` of a map on ``vertices`` (V, 3) m."""
    if not np.isfinite(named.points).all() or not np.isfinite(scores).all():
        raise PredictionError("has points, features or scores that are NaN or infinite; create it again")
    return transfer.transfer_masks(
        named.points, masks, vertices, rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    )


def write_scannet(labelled: LabelledMasks, scene: str, folder: Path) -> tuple[str, ...]:
    """``<scene>.txt`` and one file of digits per mask; masks without points or class are omitted, with a remark.

    Confidences are written with all digits: with ``%f`` those that differ in the seventh would become equal.
    """
    form = MASKS_FOLDER, ".txt", lambda k: digits_of(labelled, k)
    return write_list(labelled, labelled.class_ids - 1, scene, folder, 1, form)


def digits_of(labelled: LabelledMasks, k: int) -> bytes:
    """Mask k in the format of ScanNet's benchmark: one line per point, 1 if it is in the mask."""
    digits = np.full((labelled.n_points, 2), (ord("0"), ord("\n")), np.uint8)
    digits[labelled.masks.mask(k), 0] = ord("1")
    return digits.tobytes()


def write_scannetpp(labelled: LabelledMasks, rules: ProtocolRules | None, scene: str, folder: Path) -> tuple[str, ...]:
    """``<scene>.txt`` and one file of run lengths per mask; unsupported masks are omitted, with a remark.

    Classes are indices into the list of all classes of ``rules``; without it, mask ids are such indices + 1. The
    official script accepts confidences from 0 to 1 only; others become ranks, because AP depends only on the order.
    """
    places = labelled.class_ids - 1
    if rules is not None:
        place_of = {entry.id: place for place, entry in enumerate(rules.classes)}
        places = np.array([place_of.get(class_id, -1) for class_id in labelled.class_ids.tolist()], np.int64)
    scores = labelled.scores
    if len(scores) and (scores.min() < 0 or scores.max() > 1):
        distinct, rank = np.unique(scores, return_inverse=True)
        remark = "confidences outside 0 to 1, which the benchmark rejects, are written as ranks divided by their number"
        labelled = replace(labelled, scores=(rank + 1) / len(distinct), remarks=(*labelled.remarks, remark))
    form = RUNS_FOLDER, MASK_OF_RUNS, lambda k: _runs_json(labelled.masks.mask(k), labelled.n_points)
    return write_list(labelled, places, scene, folder, 0, form)


def _runs_json(members: Int32Array, n_points: int) -> bytes:
    """A mask in ScanNet++'s format: its length, and start and length of each run, counting points from 1."""
    starts = np.flatnonzero(np.diff(members, prepend=-2) > 1)
    sizes = np.diff(np.append(starts, len(members)))
    runs = np.column_stack([members[starts] + 1, sizes]).ravel()
    return json.dumps({"length": n_points, "counts": " ".join(map(str, runs.tolist()))}, indent=4).encode()


def write_list(
    labelled: LabelledMasks,
    places: Int64Array,
    scene: str,
    folder: Path,
    first: int | None,
    form: tuple[str, str, Callable[[int], bytes]],
) -> tuple[str, ...]:
    """``<scene>.txt`` and one file per mask with points and a class index (K,), which is written from ``first`` on;
    if that is None, lines have no class, and files are numbered without gaps.

    ``form``: folder and suffix of the mask files, and the content of that of mask k.
    """
    scene, (below, suffix, content_of) = file_name(scene), form
    make_folder(folder / below)
    sizes = labelled.masks.sizes
    lines, n_empty, n_unnamed = list[str](), 0, 0
    for k, (place, score) in enumerate(zip(places.tolist(), labelled.scores.tolist(), strict=True)):
        if not sizes[k]:
            n_empty += 1
        elif place < 0:
            n_unnamed += 1
        else:
            number = k if first is not None else len(lines)
            name = f"{below}/{scene}_{number:03d}{suffix}"
            (folder / name).write_bytes(content_of(k))
            lines.append(f"{name} {score!r}\n" if first is None else f"{name} {place + first} {score!r}\n")
    write_text(folder / f"{scene}.txt", "".join(lines))
    left_out = {"no point of the ground truth": n_empty, "none of the classes": n_unnamed}
    remarks = [f"{n} of {len(sizes)} masks have {what} and were omitted" for what, n in left_out.items() if n]
    return (*labelled.remarks, *remarks)


def write_scannetpp_labels(
    content: Content, rules: ProtocolRules, truth: GroundTruth, encoder: Encoder | None, scene: str, folder: Path
) -> tuple[str, ...]:
    """``<scene>.txt`` with the classes of every vertex: as many as ``rules`` score, or one if the prediction has one.

    Every vertex has the classes of the nearest object. ``PredictionError`` if there is none.
    """
    prediction = content.on(truth.points, rules) if isinstance(content, VertexMasks | VertexLabels) else content
    found = ranked_at(rules, truth, prediction, encoder, np.ones(len(truth.points), np.bool_))
    ranked = found.classes
    is_open = ranked[:, 0] < 0
    if is_open.any():
        raise PredictionError(
            f"{int(is_open.sum())} of {len(ranked)} vertices have none of the {len(rules.classes)} classes, and "
            "ScanNet++'s file needs one for every vertex"
        )
    if (ranked[:, 1:] < 0).all():
        ranked = ranked[:, :1]
    # a repeated class does not change the score
    ranked = np.where(ranked < 0, ranked[:, :1], ranked)
    make_folder(folder)
    lines = [",".join(map(str, row)) for row in ranked.tolist()]
    write_text(folder / f"{file_name(scene)}.txt", "\n".join(lines) + "\n")
    return found.warnings


# ---- OpenSUN3D


def is_answer(content: Content) -> bool:
    """Whether a prediction is masks on the vertices with confidences, without features to compare with a text."""
    return isinstance(content, VertexMasks) and content.features is None


def masks_as_predicted(content: VertexMasks) -> LabelledMasks:
    """Masks on the vertices with their own confidences; their classes, if any, do not matter here."""
    return LabelledMasks(content, content.n_points or 0, np.zeros(len(content), np.int64), content.scores)


def answer_to(
    text: str, content: Content, rules: ProtocolRules, vertices: Float32Array, encoder: Encoder | None
) -> LabelledMasks:
    """Every mask of a map on the ``vertices`` (V, 3) m, its cosine with ``text`` as its confidence.

    ``rules``, of kind ``queries``, define the transfer of masks to the vertices. ``PredictionError`` if the map has no
    masks or no features.
    """
    named = _as_map(content, vertices, rules)
    masks = transfer.masks_of(named)
    scores = np.zeros(0)
    if len(masks):
        if named.features is None or encoder is None:
            raise PredictionError(NEEDS_FEATURES)
        encoded = text_features(rules, [text], named.features, encoder)
        scores = cosines(named.features, encoded, device_of(encoder))[:, 0]
    moved = _moved(named, masks, scores, vertices, rules)
    return LabelledMasks(moved, len(vertices), np.zeros(len(masks), np.int64), scores)


def write_opensun3d(answer: LabelledMasks, scene: str, folder: Path) -> tuple[str, ...]:
    """``<scene>.txt`` and one file of digits per mask; masks without points are omitted, with a remark."""
    form = RUNS_FOLDER, ".txt", lambda k: digits_of(answer, k)
    remarks = write_list(answer, np.zeros(len(answer.class_ids), np.int64), scene, folder, None, form)
    n_written = int((answer.masks.sizes > 0).sum())
    if n_written < MIN_MASKS:
        count = f"has {n_written or 'no'} mask{'s' * (n_written != 1)}"
        remarks = (*remarks, f"{count}: the challenge's own script fails on a list of fewer than {MIN_MASKS}")
    return tuple(remarks)
