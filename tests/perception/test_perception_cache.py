"""The per-frame cache: what is stored, what is recomputed, and that it never changes a result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from perception_fakes import CountingEncoder, still_life

from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, PerceptionNeeds, SceneInfo
from su3d_bench.perception.cache import FrameCache, content_key, pack_masks, unpack_masks
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception

SCENE = SceneInfo("rooms", "living0", n_frames=1, stride=1, image_domain="rendered-rooms")


def perception(root: Path, encoder: CountingEncoder, cache: bool = True) -> Perception:
    config = PerceptionConfig(cache=cache)
    return build_perception("embedded", config, scene=SCENE, cache_root=root, mesh=None, encoder=encoder)


def assert_equal_to_the_bit(a: Detections, b: Detections) -> None:
    assert a.names == b.names and a.captions == b.captions and a.crop_ratios == b.crop_ratios
    for name in ("masks", "boxes", "scores", "crop_features", "global_feature"):
        first, second = getattr(a, name), getattr(b, name)
        assert first.dtype == second.dtype and first.tobytes() == second.tobytes(), name


def test_masks_round_trip_through_packing() -> None:
    generator = np.random.default_rng(1)
    masks = generator.random((7, 33, 41)) < 0.2
    masks[3] = False
    assert np.array_equal(unpack_masks(pack_masks(masks)), masks)
    assert unpack_masks(pack_masks(masks[:0])).shape == (0, 33, 41)


def test_damaged_cache_entries_are_treated_as_missing(tmp_path: Path) -> None:
    cache = FrameCache(tmp_path)
    key = content_key("a")
    path = cache.path(key)
    assert path is not None and cache.load(key) is None
    cache.save(key, {"x": np.arange(300)})
    entry = cache.load(key)
    assert entry is not None and np.array_equal(entry["x"], np.arange(300))
    whole = path.read_bytes()
    path.write_bytes(bytes([*whole[:-200], whole[-200] ^ 0x10, *whole[-199:]]))
    entry = cache.load(key)
    assert entry is None or np.array_equal(entry["x"], np.arange(300))
    for content in (whole[: len(whole) // 2], b"", b"no archive"):
        path.write_bytes(content)
        assert cache.load(key) is None
    np.savez(path, x=np.arange(300))
    assert cache.load(key) is None


def test_frame_digest_depends_on_pixels_and_optionally_on_pose() -> None:
    cache = FrameCache(None)
    frame, other, painted = still_life(), still_life(), still_life()
    other.camera_to_world[0, 3] = 1
    painted.rgb[0, 0] += 1
    assert cache.frame_digest(frame, False) == cache.frame_digest(other, False)
    assert cache.frame_digest(frame, True) != cache.frame_digest(other, True)
    other.depth_m[0, 0] += 1
    assert cache.frame_digest(frame, False) != cache.frame_digest(other, False)
    assert cache.frame_digest(frame, False) != cache.frame_digest(painted, False)
    assert cache.frame_digest(frame, False) == FrameCache(None).frame_digest(frame, False)


def test_results_are_bit_identical_with_and_without_cache(tmp_path: Path) -> None:
    needs = PerceptionNeeds(crop_ratios=(0.8, 1.0, 1.2))
    answers = [
        perception(tmp_path, CountingEncoder(), cache).detect(still_life(), needs, Timer())
        for cache in (False, True, True)
    ]
    assert len(answers[0]) > 0
    for answer in answers[1:]:
        assert_equal_to_the_bit(answers[0], answer)


def test_second_run_encodes_only_new_crop_ratios(tmp_path: Path) -> None:
    needs = PerceptionNeeds(crop_ratios=(0.8, 1.0, 1.2))
    first = CountingEncoder()
    n = len(perception(tmp_path, first).detect(still_life(), needs, Timer()))
    assert first.n_images == 3 * n + 1

    uncached = CountingEncoder()
    perception(tmp_path, uncached, cache=False).detect(still_life(), needs, Timer())
    assert uncached.n_images == 3 * n + 1

    second = CountingEncoder()
    perception(tmp_path, second).detect(still_life(), needs, Timer())
    assert second.n_images == 0

    third = CountingEncoder()
    perception(tmp_path, third).detect(still_life(), PerceptionNeeds(crop_ratios=(1.0, 2.0)), Timer())
    assert third.n_images == n


def test_excluded_regions_are_encoded_on_later_request(tmp_path: Path) -> None:
    everything = perception(tmp_path / "all", CountingEncoder()).detect(still_life(), PerceptionNeeds(), Timer())
    background = everything.names[0]
    n_kept = sum(name != background for name in everything.names)
    encoder = CountingEncoder()
    needs = PerceptionNeeds(crop_ratios=(1.0, 2.0), background_names=(background.upper(),))
    found = perception(tmp_path / "few", encoder).detect(still_life(), needs, Timer())
    assert len(found) == n_kept < len(everything)
    assert encoder.n_images == len(everything) + n_kept + 1

    later = CountingEncoder()
    unfiltered = PerceptionNeeds(crop_ratios=(1.0, 2.0))
    cached = perception(tmp_path / "few", later).detect(still_life(), unfiltered, Timer())
    assert later.n_images == len(everything) - n_kept
    fresh = perception(tmp_path / "none", CountingEncoder(), cache=False).detect(still_life(), unfiltered, Timer())
    assert_equal_to_the_bit(cached, fresh)


def test_cache_that_cannot_be_written_changes_nothing_and_is_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    without, with_cache = (
        perception(tmp_path / name, CountingEncoder()).detect(still_life(), PerceptionNeeds(), Timer())
        for name in ("file", "folder")
    )
    assert_equal_to_the_bit(without, with_cache)
    (record,) = caplog.records
    assert record.getMessage().startswith(f"{tmp_path}/file/perception: cannot be written (Not a directory)")
