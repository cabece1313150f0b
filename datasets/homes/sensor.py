"""The sensor track of homes: what a hand-held RGB-D camera of the Kinect's kind records of a noise-free frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Float32Array as Image
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.corruptions.sensors import colour, depth, poses
from su3d_bench.datasets.procedural.rendering.render import RenderedFrame


@dataclass(frozen=True)
class SensorSettings:
    """Parameters of the camera; variances are for a full scale of 1."""

    depth_strength: float = 1.0  # times the noise of Nguyen et al. 2012
    grain_px: int = depth.WINDOW_PX
    step_px: float = depth.STEP_PX
    baseline_m: float = depth.BASELINE_M
    camera_offset_m: float = (
        0.025  # infrared camera left of the colour camera (ROS page of ``corruptions/sensors/depth.py``)
    )
    near_m: float = 0.5  # Khoshelham and Elberink 2012 (Sensors 12) measure errors from here to 5 m
    far_m: float = 5.0
    # The Kinect is specified to 4 m (Microsoft, DepthRange.Default); there a grey card (0.18) still faces it seen.
    min_signal: float = 0.18 / 4.0**2
    signal_spread: float = 0.3  # a guess at the contrast of the speckle pattern between windows: 0.4 stops
    min_gloss: float = 0.5  # above it the renderer's highlight is narrower than 10 degrees
    lobe_deg: float = 4.0  # half of that highlight's half width: projector and camera are both near the normal
    edge_width_px: int = 2  # less than half of a 9-pixel window, which then contains more of the other surface
    edge_share: float = 0.5  # a window centred on an edge contains as much of either surface
    flying_share: float = 0.1  # a Kinect rejects most mixed windows (Mallick et al. 2014); those left are mixtures
    exposure_s: float = 1 / 60  # half of a frame at 30 per second: the longest at which indoor cameras keep the rate
    blur_samples: int = 8
    target_luminance: float = 0.16  # libcamera, imx219.json: y_target
    metering_speed: float = 0.2  # libcamera, agc_channel.cpp: the share of the way per frame
    metering_stride: int = 3  # measure every third frame ...
    metering_frames: int = 5  # ... 15 in all: 0.8^15 = 4 % of an older exposure remains
    min_ev: float = -2.0  # below a quarter, too many of an eight-bit image's saturated pixels would show as grey
    max_ev: float = 3.0  # gain 8; imx219.json goes to 8 or 10
    # In the range of Brooks et al. 2019, 1e-4 .. 1.2e-2, where middle grey is as noisy as in TUM's fr1/desk (about one
    # level of 255 in the mean of the channels); ``read`` follows by their log read = 2.18 log shot + 1.20.
    shot: float = 4e-4
    read: float = 1.3e-7
    jpeg_quality: int | None = 95  # OpenCV's default, used by recorders that store colour as JPEG
    # RMS trajectory errors on TUM's fr1/desk, fr2/xyz, fr3/office and fr3/nst: BundleFusion 1.6, 1.1, 2.2, 1.2 cm;
    # ElasticFusion 2.0, 1.1, 1.7, 1.6 cm; ORB-SLAM2 1.6, 0.4, 1.0, 1.9 cm. Their mean is 1.5 cm.
    drift_m: float = 0.015
    drift_deg: float = 0.4  # moves a point at 2 m as far as the shift does
    drift_smooth_frames: float = 30.0  # a second, the span of a local bundle adjustment


@dataclass(frozen=True)
class Materials:
    """Images (H, W) of the visible surface: albedo 0..1, gloss 0..1, shares of light passed and mirrored 0..1.

    ``beyond_m`` is the depth of what is seen through glass or in a mirror, 0 where nothing is.
    """

    albedo: Image
    gloss: Image
    clear: Image
    mirror: Image
    beyond_m: Image | None = None


@dataclass(frozen=True)
class CameraContext:
    """Intrinsics (3, 3), camera-to-world poses (4, 4) of the image and at both ends of the exposure.

    ``luminances``, at least one: mean luminances of the frames that ``metered`` lists, noise-free, at any image size.
    """

    intrinsics: Float64Array
    camera_to_world: Float64Array
    at_open: Float64Array
    at_close: Float64Array
    luminances: tuple[float, ...]
    materials: Materials | None = None


def metered(index: int, settings: SensorSettings) -> list[int]:
    """Frames whose luminance determines the exposure of frame ``index``, in order; the last is the frame itself."""
    return [max(index - settings.metering_stride * k, 0) for k in range(settings.metering_frames, -1, -1)]


def record(
    clean: RenderedFrame, context: CameraContext, settings: SensorSettings, rng: Generator
) -> tuple[UInt8Array, Image]:
    """Colour (H, W, 3) and depth (H, W) m as the camera records them; a function of the arguments alone."""
    for_colour, for_depth = rng.spawn(2)
    rgb = record_colour(clean, context, settings, for_colour)
    return rgb, record_depth(clean.depth_m, context, settings, for_depth)


def record_colour(clean: RenderedFrame, context: CameraContext, camera: SensorSettings, rng: Generator) -> UInt8Array:
    light = colour.motion_blur(colour.to_linear(clean.rgb), clean.depth_m, context.intrinsics, context.camera_to_world,
                               context.at_open, context.at_close, camera.blur_samples)  # fmt: skip
    speed, luminances = 1 - (1 - camera.metering_speed) ** camera.metering_stride, context.luminances
    gain = colour.exposure_gain(luminances, camera.target_luminance, speed, camera.min_ev, camera.max_ev)
    light = colour.photon_noise(colour.expose(light, gain), camera.shot, camera.read, rng, max(gain, 1.0))
    return colour.jpeg(colour.to_srgb(light), camera.jpeg_quality)


def record_depth(depth_m: Image, context: CameraContext, camera: SensorSettings, rng: Generator) -> Image:
    """Depth with errors in the order in which they arise: light, geometry, matching, disparity, output."""
    glass, light, outline, mixture, side, front = rng.spawn(6)
    focal_px, materials = float(context.intrinsics[0, 0]), context.materials
    angle, at_edge = depth.incidence(depth_m, context.intrinsics), depth.edges(depth_m)
    albedo = 0.5 if materials is None else materials.albedo  # that of a painted wall
    seen = depth.lose_weak(depth_m, angle, albedo, camera.min_signal, light, camera.signal_spread)
    if materials is not None:
        seen = depth.lose_glare(seen, angle, materials.gloss, camera.min_gloss, np.deg2rad(camera.lobe_deg))
        share = np.maximum(materials.clear, materials.mirror)
        seen = depth.see_through(seen, share, glass, materials.beyond_m)
    if camera.baseline_m:  # depth is in the colour image: infrared camera and projector are on either side of it
        for side_m in (camera.baseline_m - camera.camera_offset_m, -camera.camera_offset_m):
            seen = np.where(depth.cast_shadow(depth_m, focal_px, side_m) > 0, seen, np.float32(0))
    seen = depth.lose_edges(seen, at_edge, camera.edge_width_px, camera.edge_share, outline)
    seen = depth.add_flying_pixels(seen, at_edge, camera.flying_share, mixture)
    seen = depth.lateral_noise(seen, angle, side, camera.depth_strength, camera.grain_px, focal_px)
    seen = depth.axial_noise(seen, angle, front, camera.depth_strength, camera.grain_px, camera.step_px)
    return depth.limit_range(depth.quantise(seen, camera.step_px), camera.near_m, camera.far_m)


def drifted(camera_to_world: Float64Array, settings: SensorSettings, rng: Generator) -> Float64Array:
    """The trajectory (N, 4, 4) as a SLAM system estimates it."""
    return poses.drift(camera_to_world, settings.drift_m, settings.drift_deg, rng, settings.drift_smooth_frames)
