"""Corruptions of colour by light, motion and transmission: too little light, too much, a moving camera, compression.

The first three compute with linear light, as the sensor does, with the functions of ``sensors.colour``.
"""

from __future__ import annotations

from dataclasses import replace

from numpy.random import Generator

from su3d_bench.core.types import Frame
from su3d_bench.corruptions.model import Corruption, Recording
from su3d_bench.corruptions.sensors import colour
from su3d_bench.corruptions.sensors.poses import shutter

SHOT, READ = 1e-4, 6.3e-9  # variances at base gain: lowest of Brooks et al. 2019, ln(read) = 2.18 ln(shot) + 1.2
MAX_GAIN_STOPS = 6.0  # ISO 100 to 6400, a common limit of cameras for video; then images get darker
FRAMES_PER_SECOND = 30.0
N_SAMPLES = 32  # along the motion; fewer where it is shorter
N_CODED = 12  # frames of a video, so that the last is coded from others


def low_light(frame: Frame, stops: float, rng: Generator, recording: Recording) -> Frame:
    """The same scene with 2^``stops`` times less light: the camera raises its gain, and with it the noise."""
    gain = 2.0 ** min(stops, MAX_GAIN_STOPS)
    light = colour.expose(colour.to_linear(frame.rgb), gain / 2.0**stops)
    return replace(frame, rgb=colour.to_srgb(colour.photon_noise(light, SHOT, READ, rng, gain)))


def exposure(frame: Frame, stops: float, rng: Generator, recording: Recording) -> Frame:
    """Colour with 2^``stops`` times more light than the sensor holds in its scale."""
    return replace(frame, rgb=colour.to_srgb(colour.expose(colour.to_linear(frame.rgb), 2.0**stops)))


def motion_blur(frame: Frame, exposure_ms: float, rng: Generator, recording: Recording) -> Frame:
    """Colour blurred by the camera's motion between frames 1/30 s apart, each pixel by its own depth."""
    at_open, at_close = shutter(recording.poses, recording.index, exposure_ms / 1000, FRAMES_PER_SECOND)
    pose, light = recording.poses[recording.index], colour.to_linear(frame.rgb)
    blurred = colour.motion_blur(light, frame.depth_m, frame.intrinsics, pose, at_open, at_close, N_SAMPLES)
    return replace(frame, rgb=colour.to_srgb(blurred))


def compressed_video(frame: Frame, crf: float, rng: Generator, recording: Recording) -> Frame:
    """Colour as the last frame of H.264 video that starts ``N_CODED`` - 1 frames earlier, or with the recording."""
    before = range(max(recording.index - N_CODED + 1, 0), recording.index)
    images = [*(recording.frames[k].rgb for k in before), frame.rgb]
    return replace(frame, rgb=colour.last_of_video(images, crf))


ROWS: tuple[Corruption, ...] = (
    Corruption(
        "light", "low-light", "frame", low_light, "stops of light lost", (2, 4, 6, 7, 8),
        "ours: through the range of noise in Brooks et al. 2019 (Unprocessing images for learned raw denoising, CVPR), "
        "then two stops darker",
    ),
    Corruption(
        "light", "exposure", "frame", exposure, "stops over-exposed", (0.5, 1, 1.5, 2, 3),
        "ours: up to a window in the image metered for the room's corner, three stops",
    ),
    Corruption(
        "light", "motion-blur", "frame", motion_blur, "ms of exposure at 30 Hz", (5, 10, 15, 22, 33),
        "ours: up to the whole interval between two frames, the longest exposure at that rate", uses_poses=True,
    ),
    Corruption(
        "light", "compressed-video", "frame", compressed_video, "CRF of H.264", (23, 29, 35, 41, 47),
        "x264's default, then half the bit rate each (FFmpeg's wiki: 6 more halve it)",
    ),
)  # fmt: skip
