"""The paper's four equations that fuse CLIP features over crops and over views; all sums in float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import Float32Array, Float64Array
from su3d_bench.opensu3d.config import BEST_FIT_RATIO, MultiScale, MultiView

EPSILON = 1e-8  # the paper's: keeps the cosine of a zero vector at 0


def cosine(a: Float64Array, b: Float64Array) -> NDArray[np.float64]:
    """a . b / max(|a| |b|, 1e-8) along the last axis."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray((a * b).sum(axis=-1) / np.maximum(norms, EPSILON), np.float64)


def fuse_scales(
    crops: Float32Array | Float64Array, crop_ratios: tuple[float, ...], equation: MultiScale
) -> Float64Array:
    """f_MS (K, D) of the features (K, R, D) of R crops.

    ``direct`` is (1/k) sum_i f_i; ``weighted`` is (1/k) sum_i cos(f_1, f_i) f_i, where f_1 is the best-fit crop: the
    one at ratio 1.0, wherever it stands in ``crop_ratios``.
    """
    features = np.asarray(crops, np.float64)
    if equation == "direct":
        return np.asarray(features.mean(axis=1), np.float64)
    best_fit = features[:, [crop_ratios.index(BEST_FIT_RATIO)]]
    return np.asarray((cosine(best_fit, features)[..., None] * features).mean(axis=1), np.float64)


def fuse_views(multi_scale: Float64Array, global_features: Float64Array, equation: MultiView) -> Float64Array:
    """f_MV (D,) of m views, from their f_MS (m, D) and the f_G (m, D) of their images.

    ``direct`` is (1/m) sum_i f_MS_i; ``global`` is (1/m) sum_i (f_MS_i + cos(f_MS_i, f_G_i) f_G_i).
    """
    if equation == "direct":
        return np.asarray(multi_scale.mean(axis=0), np.float64)
    similarity = cosine(multi_scale, global_features)[:, None]
    return np.asarray((multi_scale + similarity * global_features).mean(axis=0), np.float64)
