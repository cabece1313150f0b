"""The fusion equations, worked by hand, and the four schemes."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from su3d_bench.opensu3d.config import Fusion, OpenSU3DConfig, Scheme
from su3d_bench.opensu3d.postprocess import caption_of
from su3d_bench.opensu3d.tracking import fuse_scales, fuse_views

CROPS = np.array([[[0.6, 0.8], [1.0, 0.0], [0.0, 1.0]]])  # one region, crops at ratios 0.8, 1.0, 1.2


def test_direct_multi_scale_fusion_is_the_mean() -> None:
    np.testing.assert_allclose(fuse_scales(CROPS, (0.8, 1.0, 1.2), "direct"), [[1.6 / 3, 1.8 / 3]])


def test_weighted_multi_scale_fusion_weighs_by_the_cosine_with_the_crop_at_ratio_one() -> None:
    # cosines with (1, 0): 0.6, 1, 0
    expected = [[(0.6 * 0.6 + 1.0) / 3, 0.6 * 0.8 / 3]]
    np.testing.assert_allclose(fuse_scales(CROPS, (0.8, 1.0, 1.2), "weighted"), expected)
    np.testing.assert_allclose(fuse_scales(CROPS[:, [1, 0, 2]], (1.0, 0.8, 1.2), "weighted"), expected)


def test_the_cosine_of_a_zero_feature_is_zero() -> None:
    crops = np.array([[[0.0, 0.0], [1.0, 0.0]]])
    np.testing.assert_array_equal(fuse_scales(crops, (1.0, 2.0), "weighted"), [[0.0, 0.0]])
    assert np.isfinite(fuse_views(np.zeros((1, 2)), np.zeros((1, 2)), "global")).all()


def test_direct_multi_view_fusion_is_the_mean() -> None:
    views = np.array([[1.0, 0.0], [0.0, 2.0]])
    np.testing.assert_allclose(fuse_views(views, np.ones((2, 2)), "direct"), [0.5, 1.0])


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


def test_explicit_choices_override_the_scheme() -> None:
    config = OpenSU3DConfig(scheme="scheme4", crop_ratios=(0.5, 1.0), multi_view="direct")
    assert config.fusion == Fusion("weighted", "direct", (0.5, 1.0))
    assert OpenSU3DConfig.model_validate({"crop_ratios": [0.1, 1, 1.1]}).fusion.crop_ratios == (0.1, 1.0, 1.1)


def test_defaults_are_the_papers() -> None:
    config = OpenSU3DConfig()
    assert (config.stride, config.border_px, config.top_m, config.eps, config.overlap_threshold) == (
        40,
        20,
        5,
        0.02,
        0.3,
    )
    assert (config.dbscan_eps, config.dbscan_min_points, config.split_fraction) == (0.1, 20, 0.8)
    assert set(config.needs.background_names) >= {"wall", "ground", "roof", "ceiling"}
    assert config.needs.background_by_head
    assert config.needs.max_box_fraction == 0.95


@pytest.mark.parametrize(
    "wrong",
    [
        {"scheme": "scheme3", "crop_ratios": (0.8, 1.2)},
        {"scheme": "scheme5"},
        {"strid": 10},
        {"stride": 0},
        {"stride": "40"},
        {"crop_ratios": ()},
        {"crop_ratios": (0.0, 1.0)},
        {"overlap_rule": "largest"},
        {"depth_min": 3.0, "depth_max": 2.0},
        {"eps": float("inf")},
    ],
)
def test_a_config_that_cannot_be_used_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        OpenSU3DConfig.model_validate(wrong)


def test_an_object_without_a_name_has_a_caption() -> None:
    assert caption_of("") == "an object in a scene"
    assert caption_of("LCD screen") == "an LCD screen in a scene"
    assert caption_of("blinds") == "blinds in a scene"
