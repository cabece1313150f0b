"""ConceptGraphs' detections as perception: files as written by its script, and damaged files."""

from __future__ import annotations

import gzip
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_fakes import CountingEncoder, still_life
from PIL import Image

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Float32Array, PerceptionNeeds, SceneInfo
from su3d_bench.perception.cache import crop_window
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception
from su3d_bench.perception.stored_masks import GsaFiles

SCENE = SceneInfo("replica", "room0", n_frames=1, stride=1, image_domain="camera")
PATTERN = "{scene}/gsa_detections_none/frame{index}.pkl.gz"
FRAME = still_life(40)


def masks() -> np.ndarray:
    found = np.zeros((3, *FRAME.depth_m.shape), bool)
    found[0, 40:80, 20:60] = found[1, 50:90, 90:120] = True  # the third is empty
    return found


def detections(**changes: Any) -> dict[str, Any]:
    """The output of the script for three regions."""
    features = np.zeros((3, 8), np.float32)
    features[[0, 1, 2], [1, 3, 5]] = 1
    return {
        "xyxy": np.array([[20.5, 40, 60, 80], [90, 50, 200, 90], [1, 1, 5, 5]]),
        "confidence": np.array([0.97, 1.01, 0.9]),
        "class_id": np.array([0, 1, 0]),
        "mask": masks(),
        "classes": ["item", " coffee table "],
        "image_crops": [Image.new("RGB", (9, 7), (1, 2, 3)) for _ in range(3)],
        "image_feats": features,
        "text_feats": features,
        **changes,
    }


def write(folder: Path, content: Any) -> Path:
    path = folder / "room0" / "gsa_detections_none" / "frame000040.pkl.gz"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(pickle.dumps(content, 4)))
    return path


def test_regions_match_file_and_image_crops_are_ignored(tmp_path: Path) -> None:
    write(tmp_path, detections())
    found = GsaFiles(tmp_path, PATTERN, SCENE).frame(FRAME)
    assert found.regions.names == ("item", "coffee table")
    np.testing.assert_array_equal(found.regions.masks, masks()[:2])
    np.testing.assert_array_equal(found.regions.boxes, np.array([[20.5, 40, 60, 80], [90, 50, 200, 90]], np.float32))
    np.testing.assert_array_equal(found.regions.scores, np.array([0.97, 1], np.float32))
    assert found.features[1.0].argmax(axis=1).tolist() == [1, 3]
    assert found.regions.rows is not None and found.regions.rows.tolist() == [0, 1]


def test_one_pixel_wide_mask_is_valid_and_inverted_box_is_dropped(tmp_path: Path) -> None:
    # SAM's box of a column of pixels, first to last, has no width; the original's filter_gobs uses the mask's area.
    thin = np.zeros((2, *FRAME.depth_m.shape), bool)
    thin[0, 10:70, 33] = thin[1, 5:9, 5:9] = True
    features = np.eye(8, dtype=np.float32)[:2]
    rows = {"confidence": np.array([0.9, 0.9]), "class_id": np.array([0, 0]), "image_feats": features}
    write(tmp_path, detections(mask=thin, xyxy=np.array([[33, 10, 33, 69], [9, 5, 5, 8]]), **rows))
    found = GsaFiles(tmp_path, PATTERN, SCENE).frame(FRAME)
    np.testing.assert_array_equal(found.regions.boxes, [[33, 10, 33, 69]])
    np.testing.assert_array_equal(found.regions.masks, thin[:1])
    assert (crop_window(found.regions.boxes[0], 1.0, 160, 120) == [33, 10, 34, 69]).all(), "and can be cut out"


def test_frame_without_detections_has_no_regions(tmp_path: Path) -> None:
    empty = {key: np.zeros(0) for key in ("xyxy", "confidence", "class_id", "mask")}
    write(tmp_path, detections(**empty, image_crops=[], image_feats=[], text_feats=[]))
    found = GsaFiles(tmp_path, PATTERN, SCENE).frame(FRAME)
    assert found.regions.masks.shape == (0, *FRAME.depth_m.shape) and found.regions.names == ()


def perception(folder: Path, encoder: CountingEncoder) -> Perception:
    config = PerceptionConfig.model_validate({"stored": {"folder": folder, "detections": PATTERN}})
    return build_perception("stored", config, scene=SCENE, cache_root=folder / "c", mesh=None, encoder=encoder)


def test_stored_features_are_used_only_for_same_encoder_and_crops(tmp_path: Path) -> None:
    write(tmp_path, detections())
    needs = PerceptionNeeds(crop_ratios=(1.0,), crop_padding_px=20)

    class Same(CountingEncoder):
        name = "clip-vit-h-14"
        dim = 8

        def encode_images(self, images: Any) -> Float32Array:
            return np.tile(np.eye(8, dtype=np.float32)[7], (len(images), 1))

    same = perception(tmp_path, Same()).detect(FRAME, needs, Timer())
    assert same.crop_features[:, 0].argmax(axis=1).tolist() == [1, 3]
    unpadded = perception(tmp_path, Same()).detect(FRAME, PerceptionNeeds(), Timer())
    assert unpadded.crop_features[:, 0].argmax(axis=1).tolist() == [7, 7]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mask": masks()[:, :-1]}, r"masks are \(3, 119, 160\), the frame has height 120 and width 160"),
        ({"class_id": np.array([0, 2, 0])}, "class number 2; 'classes' has 2 names"),
        ({"classes": "item"}, "'classes' is not a list of names"),
        ({"xyxy": np.zeros((2, 4))}, r"xyxy is \(2, 4\)"),
        ({"confidence": np.array([np.nan, 1, 1])}, "a confidence is not finite"),
        ({"confidence": np.ones(2001)}, "has 2001 regions"),
        ({"image_feats": np.ones((3, 8))}, r"image_feats are \(3, 8\); expected 3 rows of length 1"),
    ],
)
def test_mismatched_detections_give_one_line_error(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    write(tmp_path, detections(**changes))
    with pytest.raises(DataError, match=message) as caught:
        GsaFiles(tmp_path, PATTERN, SCENE).frame(FRAME)
    assert str(caught.value).isprintable() and "frame000040.pkl.gz" in str(caught.value)


class Calling:
    def __reduce__(self) -> Any:
        return (exec, ("raise AssertionError('code of a file was run')",))


def test_pickle_that_executes_code_fails(tmp_path: Path) -> None:
    write(tmp_path, detections(image_crops=[Calling()]))
    with pytest.raises(PredictionError, match="exec"):
        GsaFiles(tmp_path, PATTERN, SCENE).frame(FRAME)
    write(tmp_path, [1, 2])
    with pytest.raises(DataError, match="contains a list"):
        GsaFiles(tmp_path, PATTERN, SCENE).frame(FRAME)
