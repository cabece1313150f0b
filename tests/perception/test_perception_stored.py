"""Stored detections: read as they were written, or rejected in one line with the reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_fakes import CountingEncoder, still_life

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, PerceptionNeeds, SceneInfo
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception
from su3d_bench.perception.stored import StoredConfig, read_stored, stored_path

SCENE = SceneInfo("replica", "room0", n_frames=1, stride=1, image_domain="camera")


def detections(index: int = 40) -> Detections:
    frame = still_life(index)
    masks = np.stack([frame.depth_m == 2.0, frame.depth_m == 2.5])
    boxes = np.array([[20, 40, 60, 80], [90.5, 50, 120, 90]], np.float32)
    rows = CountingEncoder().encode_texts(["a", "b", "c", "d", "e"])
    return Detections(
        frame_index=index,
        masks=masks,
        boxes=boxes,
        scores=np.array([0.9, 0.25], np.float32),
        names=("chair", "indoor-plant"),
        captions=("a red chair", "an indoor-plant in a scene"),
        crop_ratios=(1.0, 1.5),
        crop_features=rows[:4].reshape(2, 2, 8),
        global_feature=rows[4],
    )


def written(folder: Path, with_features: bool) -> Path:
    found = detections()
    n, height, width = found.masks.shape
    arrays: dict[str, Any] = {
        "image_size": np.array([height, width], np.int64),
        "masks": np.packbits(found.masks.reshape(n, height * width), axis=1),
        "boxes": found.boxes,
        "scores": found.scores,
        "names": np.array(found.names),
        "captions": np.array(found.captions),
    }
    if with_features:
        arrays |= {"crop_ratios": np.array(found.crop_ratios), "crop_features": found.crop_features}
        arrays |= {"global_feature": found.global_feature, "encoder": np.array(CountingEncoder().digest)}
    path = stored_path(folder, "replica", "room0", 40)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)
    return path


def perception(folder: Path, encoder: CountingEncoder, tmp_path: Path) -> Perception:
    config = PerceptionConfig(stored=StoredConfig(folder=folder))
    return build_perception("stored", config, scene=SCENE, cache_root=tmp_path, mesh=None, encoder=encoder)


def test_detections_round_trip(tmp_path: Path) -> None:
    written(tmp_path, with_features=True)
    encoder = CountingEncoder()
    needs = PerceptionNeeds(crop_ratios=(1.5, 1.0))
    found = perception(tmp_path, encoder, tmp_path).detect(still_life(40), needs, Timer())
    given = detections()
    assert found.names == given.names and found.captions == given.captions
    assert np.array_equal(found.masks, given.masks) and np.array_equal(found.boxes, given.boxes)
    assert np.array_equal(found.scores, given.scores)
    assert np.array_equal(found.crop_features, given.crop_features[:, ::-1])
    assert np.array_equal(found.global_feature, given.global_feature) and encoder.n_images == 0


def test_missing_features_and_ratios_are_computed(tmp_path: Path) -> None:
    written(tmp_path, with_features=False)
    encoder = CountingEncoder()
    perception(tmp_path, encoder, tmp_path).detect(still_life(40), PerceptionNeeds(crop_ratios=(0.8, 1.0)), Timer())
    assert encoder.n_images == 2 * 2 + 1
    written(tmp_path, with_features=True)
    encoder = CountingEncoder()
    perception(tmp_path, encoder, tmp_path / "new").detect(
        still_life(40), PerceptionNeeds(crop_ratios=(1.0, 3.0)), Timer()
    )
    assert encoder.n_images == 2


def test_captions_default_to_the_template_and_background_is_dropped(tmp_path: Path) -> None:
    path = written(tmp_path, with_features=False)
    arrays = dict(np.load(path))
    del arrays["captions"]
    np.savez(path, allow_pickle=False, **arrays)
    needs = PerceptionNeeds(background_names=("chair",))
    found = perception(tmp_path, CountingEncoder(), tmp_path).detect(still_life(40), needs, Timer())
    assert found.captions == ("an indoor-plant in a scene",)
    assert found.rows is not None and found.rows.tolist() == [1] and found.row_of(0) == 1


BAD: list[tuple[dict[str, Any], str]] = [
    ({"scores": None}, r"has image_size, masks, boxes, names, captions; expected image_size, masks"),
    ({"extra": np.zeros(1)}, r"captions, extra; expected image_size, masks"),
    ({"scores": np.array([0.9, 1.5])}, r"frame 40, region 1: score 1.5 is not in 0..1"),
    ({"scores": np.array([0.9])}, r"'masks' has shape \(2, 2400\); expected 2 axes and 1 rows"),
    ({"boxes": np.array([[0, 0, 9, 9], [100, 50, 321, 90]])}, r"region 1: box .* is not a box in the 160x120 image"),
    ({"image_size": np.array([680, 1200])}, r"image_size is \[680, 1200\], the frame has height 120 and width 160"),
    ({"masks": np.zeros((2, 2400), np.uint8)}, r"region 0: the mask is empty"),
    ({"names": np.array(["chair", " "])}, r"region 1: 'names' is an empty text"),
    ({"encoder": np.array("x")}, r"all or none of crop_ratios, crop_features, global_feature, encoder"),
]


@pytest.mark.parametrize(("change", "message"), BAD, ids=[message[:24] for _, message in BAD])
def test_file_errors_name_frame_and_region(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = written(tmp_path, with_features=False)
    arrays: dict[str, Any] = {**dict(np.load(path)), **change}
    np.savez(path, allow_pickle=False, **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(DataError, match=message) as caught:
        read_stored(path, still_life(40), CountingEncoder())
    assert "frame 40" in str(caught.value) and "\n" not in str(caught.value)


def test_features_of_another_encoder_or_length_are_rejected(tmp_path: Path) -> None:
    path = written(tmp_path, with_features=True)
    arrays = dict(np.load(path))
    np.savez(path, allow_pickle=False, **{**arrays, "encoder": np.array("other-2")})
    with pytest.raises(DataError, match="features were made by encoder other-2, the run uses counting counting-1"):
        read_stored(path, still_life(40), CountingEncoder())
    scaled = arrays["crop_features"].copy()
    scaled[1, 0] *= 2
    np.savez(path, allow_pickle=False, **{**arrays, "crop_features": scaled})
    with pytest.raises(DataError, match=r"crop_features or global_feature has a row of length 2, not 1"):
        read_stored(path, still_life(40), CountingEncoder())
    np.savez(path, allow_pickle=False, **{**arrays, "crop_features": scaled[..., :5]})
    with pytest.raises(DataError, match=r"crop_features \(2, 2, 5\) .* expected \(2, 2, 8\)"):
        read_stored(path, still_life(40), CountingEncoder())


def test_pickled_objects_are_rejected(tmp_path: Path) -> None:
    path = written(tmp_path, with_features=False)
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "names": np.array(["chair", None], object)})
    with pytest.raises(DataError, match="is not an npz file of plain arrays"):
        read_stored(path, still_life(40), CountingEncoder())
