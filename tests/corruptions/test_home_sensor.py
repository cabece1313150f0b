"""The sensor track of homes: the errors put together for one frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from su3d_bench.core.types import Float32Array
from su3d_bench.datasets.homes.sensor import CameraContext, Materials, SensorSettings, drifted, metered, record
from su3d_bench.datasets.procedural.rendering.render import RenderedFrame, camera_intrinsics

SHAPE = (240, 320)
PERFECT = SensorSettings(
    depth_strength=0, step_px=0, baseline_m=0, near_m=0, far_m=np.inf, min_signal=0, lobe_deg=0, edge_share=0,
    flying_share=0, blur_samples=0, min_ev=0, max_ev=0, shot=0, read=0, jpeg_quality=None, drift_m=0, drift_deg=0,
)  # fmt: skip


def clean_frame() -> RenderedFrame:
    depth_m = np.full(SHAPE, 2.5, np.float32)
    depth_m[60:180, 100:200] = 1.2
    rgb = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), np.uint8)
    return RenderedFrame(rgb, depth_m, np.ones(SHAPE, np.int32))


def context(materials: Materials | None = None) -> CameraContext:
    closed = np.eye(4)
    closed[0, 3] = 0.01
    return CameraContext(camera_intrinsics(320, 240), np.eye(4), np.eye(4), closed, (0.3, 0.2), materials)


def test_a_perfect_camera_records_the_frame_itself() -> None:
    clean = clean_frame()
    rgb, depth_m = record(clean, context(), PERFECT, np.random.default_rng(0))
    assert rgb.tobytes() == clean.rgb.tobytes() and depth_m.tobytes() == clean.depth_m.tobytes()
    poses = np.tile(np.eye(4), (9, 1, 1))
    assert drifted(poses, PERFECT, np.random.default_rng(0)).tobytes() == poses.tobytes()


def test_a_recording_depends_on_its_seed_only_and_depth_not_on_colour() -> None:
    first = record(clean_frame(), context(), SensorSettings(), np.random.default_rng(7))
    again = record(clean_frame(), context(), SensorSettings(), np.random.default_rng(7))
    other = record(clean_frame(), context(), SensorSettings(), np.random.default_rng(8))
    assert [part.tobytes() for part in first] == [part.tobytes() for part in again]
    assert first[0].tobytes() != other[0].tobytes() and first[1].tobytes() != other[1].tobytes()
    noisier = record(clean_frame(), context(), replace(SensorSettings(), shot=0.01), np.random.default_rng(7))
    assert noisier[1].tobytes() == first[1].tobytes()


def test_recorded_depth_has_shadows_on_both_sides_and_noise_of_the_sensor() -> None:
    clean = clean_frame()
    depth_m = record(clean, context(), SensorSettings(), np.random.default_rng(0))[1]
    row = depth_m[90:150] == 0
    step = 200 * (1 / 1.2 - 1 / 2.5)
    assert row[:, 80:101].sum(axis=1).mean() == pytest.approx(0.05 * step, abs=2.5)  # projector, and lost edge pixels
    assert row[:, 200:].sum(axis=1).mean() == pytest.approx(0.025 * step, abs=2.5)  # the infrared camera's own view
    error = (depth_m - clean.depth_m)[80:160, 120:180].astype(np.float64)
    assert np.sqrt((error**2).mean()) == pytest.approx(0.0012 + 0.0019 * 0.8**2, rel=0.15)


def test_materials_make_holes() -> None:
    def image(value: float) -> Float32Array:
        return np.full(SHAPE, value, np.float32)

    def missing(**parts: float) -> float:
        images = {
            name: image(value) for name, value in ({"albedo": 0.5, "gloss": 0, "clear": 0, "mirror": 0} | parts).items()
        }
        settings = replace(PERFECT, min_signal=SensorSettings().min_signal, lobe_deg=4.0)
        return float(
            (record(clean_frame(), context(Materials(**images)), settings, np.random.default_rng(0))[1] == 0).mean()
        )

    assert missing() == 0
    assert missing(albedo=0.03) > 0.7
    assert missing(clear=1) == missing(mirror=1) == 1
    assert 0 < missing(gloss=1) < 0.1


def test_the_exposure_of_a_frame_depends_on_frames_before_it_alone() -> None:
    assert metered(100, SensorSettings()) == [85, 88, 91, 94, 97, 100]
    assert metered(4, SensorSettings()) == [0, 0, 0, 0, 1, 4]
