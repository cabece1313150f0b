"""Regions from label images: one region per value, names from a table or the encoder, errors with file and value."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from perception_fakes import CountingEncoder, still_life

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import PerceptionNeeds, SceneInfo
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception
from su3d_bench.perception.stored import StoredConfig
from su3d_bench.perception.stored_masks import LabelImages, read_names

SCENE = SceneInfo("rgbd", "desk", n_frames=1, stride=1, image_domain="camera")
PATTERN = "frame-{index}.segm.png"
Change = Callable[[Path], object]


def labels(dtype: Any = np.uint8) -> np.ndarray:
    image = np.zeros((120, 160), dtype)
    image[40:80, 20:60] = 132
    image[50:90, 90:120] = 48
    return image


def write_image(folder: Path, image: np.ndarray | None = None, name: str = "frame-0040.segm.png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name), labels() if image is None else image)
    return folder / name


def images(folder: Path, pattern: str = PATTERN, names: str | None = None) -> LabelImages:
    return LabelImages(folder, pattern, None if names is None else folder / names, SCENE)


def perception(folder: Path, cache: Path, names: str | None = None) -> Perception:
    config = PerceptionConfig(
        stored=StoredConfig(folder=folder, images=PATTERN, names=None if names is None else folder / names)
    )
    return build_perception("stored", config, scene=SCENE, cache_root=cache, mesh=None, encoder=CountingEncoder())


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_each_value_above_zero_is_one_region_in_ascending_order(tmp_path: Path, dtype: Any) -> None:
    write_image(tmp_path, labels(dtype))
    found = images(tmp_path).frame(still_life(40)).regions
    assert found.names == ("", "")
    np.testing.assert_array_equal(found.masks, [labels() == 48, labels() == 132])
    np.testing.assert_array_equal(found.boxes, [[90, 50, 120, 90], [20, 40, 60, 80]])


@pytest.mark.parametrize(("file", "text"), [("names.toml", '132 = "box"\n'), ("names.json", '{"132": "box"}')])
def test_named_values_keep_name_and_score_and_the_encoder_names_the_rest(tmp_path: Path, file: str, text: str) -> None:
    write_image(tmp_path)
    (tmp_path / file).write_text(text)
    needs = PerceptionNeeds(crop_ratios=(1.0, 1.5))
    found = perception(tmp_path, tmp_path / "cache", file).detect(still_life(40), needs, Timer())
    guessed = perception(tmp_path, tmp_path / "cache").detect(still_life(40), needs, Timer())
    assert found.names == (guessed.names[0], "box") and found.captions[1] == "a red box in a scene"
    assert found.scores[0] == guessed.scores[0] < 1.0 == found.scores[1]
    assert found.crop_features.shape == (2, 2, 8)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((60, 80), np.uint8), "frame-0040.segm.png is 80x60, the frame has width 160 and height 120"),
        (np.zeros((120, 160, 3), np.uint8), "not a label image: 8 bits, PNG colour type 2; expected one grey channel"),
        (
            np.arange(120 * 160, dtype=np.uint16).reshape(120, 160),
            "has 19199 regions of 160x120 pixels; expected one region per object",
        ),
    ],
)
def test_invalid_label_image_fails(tmp_path: Path, image: np.ndarray, message: str) -> None:
    write_image(tmp_path, image)
    with pytest.raises(DataError) as caught:
        images(tmp_path).frame(still_life(40))
    assert str(caught.value).startswith("rgbd/desk: frame-0040.segm.png") and message in str(caught.value)


def test_image_link_outside_the_folder_fails(tmp_path: Path) -> None:
    outside = write_image(tmp_path / "outside")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels/frame-0040.segm.png").symlink_to(outside)
    with pytest.raises(ConfigError, match="is outside"):
        images(tmp_path / "labels")


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("names.toml", "48", "not a TOML or JSON table of names by value"),
        ("names.toml", 'book = "48"', "'book' is not a label value; expected 1 to 65535"),
        ("names.toml", '70000 = "book"', "'70000' is not a label value"),
        ("names.json", '{"48": "a\\nb"}', "the name of 48 is"),
    ],
)
def test_invalid_names_file_fails(tmp_path: Path, file: str, text: str, message: str) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(DataError) as caught:
        read_names(tmp_path / file, "rgbd/desk")
    assert str(caught.value).startswith(f"rgbd/desk: {file}") and message in str(caught.value)
    assert "\n" not in str(caught.value)
