"""The fusion equations, worked by hand, and the four schemes."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.opensu3d.config import Fusion, OpenSU3DConfig, Scheme
from su3d_bench.opensu3d.tracking import fuse_scales, fuse_views

CROPS = np.array([[[0.6, 0.8], [1.0, 0.0], [0.0, 1.0]]])  # one region, crops at ratios 0.8, 1.0, 1.2


def test_weighted_multi_scale_fusion_weighs_by_the_cosine_with_the_crop_at_ratio_one() -> None:
    # cosines with (1, 0): 0.6, 1, 0
    expected = [[(0.6 * 0.6 + 1.0) / 3, 0.6 * 0.8 / 3]]
    np.testing.assert_allclose(fuse_scales(CROPS, (0.8, 1.0, 1.2), "weighted"), expected)
    np.testing.assert_allclose(fuse_scales(CROPS[:, [1, 0, 2]], (1.0, 0.8, 1.2), "weighted"), expected)


def test_global_multi_view_fusion_adds_the_weighted_global_feature_inside_the_mean() -> None:
    views, images = np.array([[1.0, 0.0], [0.0, 2.0]]), np.array([[0.6, 0.8], [0.0, 1.0]])
    # cosines 0.6 and 1: ((1, 0) + 0.6 (0.6, 0.8) + (0, 2) + (0, 1)) / 2
    np.testing.assert_allclose(fuse_views(views, images, "global"), [1.36 / 2, 3.48 / 2])


@pytest.mark.parametrize(
    ("scheme", "expected"),
    [
        ("scheme1", Fusion("direct", "direct", (0.8, 1.0, 1.2))),
        ("scheme2", Fusion("direct", "global", (0.8, 1.0, 1.2))),
        ("scheme3", Fusion("weighted", "direct", (1.0, 2.0, 4.0))),
        ("scheme4", Fusion("weighted", "global", (1.0, 2.0, 4.0))),
        ("scheme4-narrow", Fusion("weighted", "global", (0.8, 1.0, 1.2))),
    ],
)
def test_the_schemes_are_the_papers(scheme: Scheme, expected: Fusion) -> None:
    config = OpenSU3DConfig(scheme=scheme)
    assert config.fusion == expected
    assert config.needs.crop_ratios == expected.crop_ratios
