"""3D proposals of a few points, for the tests of what reads, makes and uses them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.maps import Proposals


def made_proposals(points: np.ndarray, *masks: Sequence[int], scores: Sequence[float] | None = None) -> Proposals:
    return Proposals(
        points=points.astype(np.float32),
        indptr=np.cumsum([0, *(len(mask) for mask in masks)]).astype(np.int64),
        indices=np.array([k for mask in masks for k in mask], np.int32),
        scores=np.ones(len(masks)) if scores is None else np.array(scores, np.float64),
        source="made",
    )
