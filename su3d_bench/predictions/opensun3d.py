"""The OpenSUN3D challenge's submissions written: for each scene the masks that answer its query, with confidences."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.types import Float32Array
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import cosines, device_of, text_features
from su3d_bench.metrics.open_vocabulary.score import NEEDS_FEATURES
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.predictions.base import Content, VertexLabels, VertexMasks
from su3d_bench.predictions.export import RUNS_FOLDER, LabelledMasks, digits_of, write_list

# demo_eval.py of OpenSun3D/cvpr24-challenge at 59db30f reads a list with numpy.loadtxt and stops at one of fewer lines.
LEAST_MASKS = 2


def is_answer(content: Content) -> bool:
    """Whether a prediction is masks on the vertices with confidences and nothing that a text could be compared with."""
    return isinstance(content, VertexMasks) and content.features is None


def answer_as_it_is(content: VertexMasks) -> LabelledMasks:
    """Masks on the vertices with their own confidences; their classes, if they have some, say nothing here."""
    return LabelledMasks(content, content.n_points or 0, np.zeros(len(content), np.int64), content.scores)


def answer_to(
    text: str, content: Content, rules: ProtocolRules, vertices: Float32Array, encoder: Encoder | None
) -> LabelledMasks:
    """Every mask of a map on the ``vertices`` (V, 3) m, its cosine with ``text`` as its confidence.

    ``rules``, of kind ``queries``, say how masks reach the vertices. ``PredictionError`` where the map has no masks or
    no features.
    """
    if isinstance(content, VertexLabels | DenseFeatures):
        raise PredictionError("has no masks, and the challenge's submission needs them")
    if isinstance(content, VertexMasks) and content.n_points not in {None, len(vertices)}:
        raise PredictionError(
            f"is of {content.n_points} points, the mesh has {len(vertices)} vertices; both must be of one mesh"
        )
    named = content.on(vertices, rules) if isinstance(content, VertexMasks) else content
    masks = transfer.masks_of(named)
    scores = np.zeros(0)
    if len(masks):
        if named.features is None or encoder is None:
            raise PredictionError(NEEDS_FEATURES)
        encoded = text_features(rules, [text], named.features, encoder)
        scores = cosines(named.features, encoded, device_of(encoder))[:, 0]
    if not np.isfinite(named.points).all() or not np.isfinite(scores).all():
        raise PredictionError("has points or features that are NaN or infinite; make it again")
    moved = transfer.transfer_masks(
        named.points, masks, vertices, rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    )
    return LabelledMasks(moved, len(vertices), np.zeros(len(masks), np.int64), scores)


def write_opensun3d(answer: LabelledMasks, scene: str, folder: Path) -> tuple[str, ...]:
    """``<scene>.txt`` and a file of digits for each mask; masks without points are left out and told."""
    form = RUNS_FOLDER, ".txt", lambda k: digits_of(answer, k)
    remarks = write_list(answer, np.zeros(len(answer.class_ids), np.int64), scene, folder, None, form)
    n_written = int((answer.masks.sizes > 0).sum())
    if n_written < LEAST_MASKS:
        said = f"has {n_written or 'no'} mask{'s' * (n_written != 1)}"
        remarks = (*remarks, f"{said}: the challenge's own script stops at a list of fewer than {LEAST_MASKS}")
    return tuple(remarks)
