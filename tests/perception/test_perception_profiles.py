"""Profile selection, names and captions, background names, and crops around detections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from perception_fakes import CountingEncoder, still_life

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import ImageDomain, PerceptionNeeds, SceneInfo
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.perception.cache import crop_images, crop_window
from su3d_bench.perception.detections import is_background, regions_to_keep
from su3d_bench.perception.embedded.lexicon import Namer, NamingConfig, colour_word, vocabulary
from su3d_bench.perception.profiles import PerceptionConfig, build_perception, resolve_profile


def scene(domain: ImageDomain) -> SceneInfo:
    return SceneInfo("any", "scene0", n_frames=1, stride=1, image_domain=domain)


def test_unknown_profile_error_suggests_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match=r"unknown profile 'orcale'; did you mean 'oracle'\?"):
        resolve_profile("orcale", "camera")
    with pytest.raises(ConfigError, match="known: auto, embedded, paper, oracle, stored"):
        resolve_profile("foundation", "camera")


def test_digest_depends_on_parameters_but_not_on_the_cache(tmp_path: Path) -> None:
    def digest(**values: object) -> str:
        config = PerceptionConfig.model_validate(values)
        return build_perception(
            "embedded", config, scene=scene("camera"), cache_root=tmp_path, mesh=None, encoder=CountingEncoder()
        ).digest

    assert digest() == digest(cache=False)
    assert len({digest(), digest(segmenter={"min_region_px": 90}), digest(naming={"temperature": 0.5})}) == 3
    assert digest() == digest(oracle={"noise": {"erode_px": 3}})


def test_embedded_detections_are_named_captioned_and_scored(tmp_path: Path) -> None:
    built = build_perception(
        "embedded",
        PerceptionConfig(),
        scene=scene("rendered-rooms"),
        cache_root=tmp_path,
        mesh=None,
        encoder=CountingEncoder(),
    )
    found = built.detect(still_life(7), PerceptionNeeds(crop_ratios=(0.8, 1.0)), Timer())
    assert found.frame_index == 7 and len(found) >= 3
    assert set(found.names) <= set(vocabulary())
    assert all(
        caption.endswith(f"{name} in a scene") for name, caption in zip(found.names, found.captions, strict=True)
    )
    assert ((found.scores > 0) & (found.scores <= 1)).all()
    assert np.allclose(np.linalg.norm(found.crop_features, axis=2), 1, atol=1e-5)


def test_background_regions_and_too_large_boxes_are_dropped() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 100, 50], [0, 0, 100, 48]], np.float32)
    needs = PerceptionNeeds(background_names=("Wall",), max_box_fraction=0.96)
    assert regions_to_keep(["wall", "cup", "cup"], boxes, (50, 100), needs).tolist() == [2]
    assert regions_to_keep([], boxes[:0], (50, 100), needs).tolist() == []
    assert regions_to_keep(["brick wall", "cup", "cup"], boxes, (50, 100), needs).tolist() == [0, 2]
    by_head = replace(needs, background_by_head=True)
    assert regions_to_keep(["brick wall", "cup", "cup"], boxes, (50, 100), by_head).tolist() == [2]


def test_colour_words_match_the_pixels_under_the_mask() -> None:
    frame = still_life()
    assert colour_word(frame.rgb, frame.depth_m == 2.0) == "red"
    assert colour_word(frame.rgb, frame.depth_m == 2.5) == "green"
    assert colour_word(frame.rgb, np.zeros(frame.depth_m.shape, bool)) is None


def test_feature_gets_the_nearest_name_and_its_softmax_confidence() -> None:
    encoder = CountingEncoder()
    words = ("cup", "chair", "indoor-plant")
    namer = Namer(NamingConfig(temperature=0.1), encoder, words)
    texts = encoder.encode_texts(["a cup in a scene", "a chair in a scene", "an indoor-plant in a scene"])
    named = namer.name(texts[[2, 0]])
    assert named.names == ("indoor-plant", "cup")
    logits = texts.astype(np.float64) @ texts[2].astype(np.float64) / 0.1
    assert named.confidences[0] == pytest.approx(np.exp(logits[2]) / np.exp(logits).sum())
    assert namer.name(texts[:0]).names == ()


NAMES = OpenSU3DConfig().background_names


@pytest.mark.parametrize(
    "name",
    [
        "wall", "glass wall", "hardwood floor", "tile flooring", "ceiling", "roof", "training ground",  # RAM's tags
        "walls", "White Wall", "a wall", "roofing", "wall of bricks", "part of a wall", "Floor surface",
        "wall and floor", "floor, wall", "wall (white)", "wall 2", "floor near the door",
    ],
)  # fmt: skip
def test_walls_floors_and_ceilings_are_background(name: str) -> None:
    assert is_background(name, NAMES)


@pytest.mark.parametrize(
    "name",
    [
        "wall clock", "wallpaper", "floor mat", "ceiling fan", "roof garden", "ground squirrel",  # RAM's tags
        "seawall", "floor lamp", "wall-cabinet", "picture on wall", "rug on the floor", "floor to ceiling window",
        "wall-to-wall carpet", "floor and rug", "coffee grounds", "video wall", "wall hanging", "",
    ],
)  # fmt: skip
def test_objects_on_walls_and_floors_are_not_background(name: str) -> None:
    assert not is_background(name, NAMES)


def test_multi_word_names_are_matched_as_a_whole() -> None:
    assert is_background("white base cabinets", ("base-cabinet",))
    assert not is_background("cabinet", ("base-cabinet",))
    assert not is_background("wall", ("",))


@pytest.mark.parametrize(
    ("box", "ratio", "expected"),
    [
        ((10, 20, 30, 40), 1.0, (10, 20, 30, 40)),
        ((10, 20, 30, 40), 0.8, (12, 22, 28, 38)),
        ((10, 20, 30, 40), 1.2, (8, 18, 32, 42)),
        ((10, 20, 31, 41), 2.0, (0, 10, 42, 50)),  # -0.5 clips, 41.5 rounds up, 51.5 clips
        ((10, 20, 13, 24), 0.5, (11, 21, 12, 23)),  # 10.75..12.25 rounds to 11..12
        ((10, 20, 11, 21), 0.1, (10, 20, 11, 21)),  # 10.45..10.55 rounds to 10..11
        ((10, 20, 12, 22), 0.1, (11, 21, 12, 22)),  # 10.9..11.1 would be empty: one pixel
        ((98, 48, 100, 50), 0.1, (99, 49, 100, 50)),  # an empty window at the far border stays inside
        ((0, 0, 100, 50), 4.0, (0, 0, 100, 50)),
    ],
)
def test_crop_is_the_scaled_clipped_and_rounded_box(
    box: tuple[float, ...], ratio: float, expected: tuple[int, ...]
) -> None:
    assert tuple(crop_window(box, ratio, width=100, height=50)) == expected


def test_crop_contains_the_pixels_of_its_window() -> None:
    rgb = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    (crop,) = crop_images(rgb, np.array([[2, 1, 6, 5]], np.float32), 0.5)
    assert np.array_equal(crop, rgb[2:4, 3:5])
