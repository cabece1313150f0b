"""Which profile a name stands for, what it says of itself, names and captions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from perception_fakes import CountingEncoder, still_life

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import ImageDomain, PerceptionNeeds, SceneInfo
from su3d_bench.perception.detections import regions_to_keep
from su3d_bench.perception.embedded.naming import (
    Namer,
    NamingConfig,
    colour_word,
    scene_caption,
    vocabulary,
)
from su3d_bench.perception.profiles import PerceptionConfig, build_perception, resolve_profile


def scene(domain: ImageDomain) -> SceneInfo:
    return SceneInfo("any", "scene0", n_frames=1, stride=1, image_domain=domain)


def test_auto_is_embedded_on_either_kind_of_image() -> None:
    assert resolve_profile("auto", "rendered-rooms") == resolve_profile("auto", "camera") == "embedded"
    assert resolve_profile("oracle", "camera") == "oracle"


def test_an_unknown_profile_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match=r"unknown profile 'orcale'; did you mean 'oracle'\?"):
        resolve_profile("orcale", "camera")
    with pytest.raises(ConfigError, match="known: auto, embedded, paper, oracle, stored"):
        resolve_profile("foundation", "camera")


def test_embedded_warns_on_camera_images_only_and_names_the_profile_to_use(tmp_path: Path) -> None:
    caveats = {}
    for domain in ("rendered-rooms", "camera"):
        built = build_perception(
            "auto", PerceptionConfig(), scene=scene(domain), cache_root=tmp_path, mesh=None, encoder=CountingEncoder()
        )
        assert built.profile == "embedded"
        caveats[domain] = built.caveat
    assert caveats["rendered-rooms"] is None
    assert (
        caveats["camera"] is not None and "mean little" in caveats["camera"] and "--profile stored" in caveats["camera"]
    )


def test_the_digest_moves_with_parameters_and_not_with_the_cache(tmp_path: Path) -> None:
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


def test_regions_of_background_names_and_of_too_large_boxes_are_left_out() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 100, 50], [0, 0, 100, 48]], np.float32)
    needs = PerceptionNeeds(background_names=("Wall",), max_box_fraction=0.96)
    assert regions_to_keep(["wall", "cup", "cup"], boxes, (50, 100), needs).tolist() == [2]
    assert regions_to_keep([], boxes[:0], (50, 100), needs).tolist() == []
    assert regions_to_keep(["brick wall", "cup", "cup"], boxes, (50, 100), needs).tolist() == [0, 2]
    by_head = replace(needs, background_by_head=True)
    assert regions_to_keep(["brick wall", "cup", "cup"], boxes, (50, 100), by_head).tolist() == [2]


def test_captions_name_the_colour_where_it_is_known() -> None:
    assert scene_caption("chair", "green") == "a green chair in a scene"
    assert scene_caption("chair", "orange") == "an orange chair in a scene"
    assert scene_caption("blinds", "white") == "white blinds in a scene"
    assert scene_caption("indoor-plant") == "an indoor-plant in a scene"
    assert scene_caption("") == "an object in a scene"


def test_colour_words_are_those_of_the_pixels_under_the_mask() -> None:
    frame = still_life()
    assert colour_word(frame.rgb, frame.depth_m == 2.0) == "red"
    assert colour_word(frame.rgb, frame.depth_m == 2.5) == "green"
    assert colour_word(frame.rgb, np.zeros(frame.depth_m.shape, bool)) is None


def test_a_feature_is_named_after_the_nearest_text_with_its_softmax_share() -> None:
    encoder = CountingEncoder()
    words = ("cup", "chair", "indoor-plant")
    namer = Namer(NamingConfig(temperature=0.1), encoder, words)
    texts = encoder.encode_texts(["a cup in a scene", "a chair in a scene", "an indoor-plant in a scene"])
    named = namer.name(texts[[2, 0]])
    assert named.names == ("indoor-plant", "cup")
    logits = texts.astype(np.float64) @ texts[2].astype(np.float64) / 0.1
    assert named.confidences[0] == pytest.approx(np.exp(logits[2]) / np.exp(logits).sum())
    assert namer.name(texts[:0]).names == ()
