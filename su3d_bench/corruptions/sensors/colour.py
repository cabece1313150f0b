"""Errors of a colour camera, each a pure function of images: motion blur, exposure, noise, compression.

Colour images are (H, W, 3): ``rgb`` sRGB bytes, ``linear`` float32 light in 0..1. A parameter of 0 returns the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import cache, reduce

import numpy as np
from numpy.random import Generator

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.types import Float32Array as Light
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.corruptions.sensors.depth import inverse_depth, normal_noise

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # ITU-R BT.709


@cache
def _tables() -> tuple[Light, UInt8Array]:
    """Light of each byte, and byte of light in 1/65535: the transfer function of IEC 61966-2-1."""
    code, light = np.arange(256) / 255, np.arange(65536) / 65535
    to_light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    to_code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return to_light.astype(np.float32), np.rint(255 * to_code).astype(np.uint8)


def to_linear(rgb: UInt8Array) -> Light:
    return _tables()[0][rgb]


def to_srgb(linear: Light) -> UInt8Array:
    """Bytes of light, clipped to 0..1; exactly the bytes that ``to_linear`` came from."""
    return _tables()[1][(np.clip(linear, 0, 1) * np.float32(65535) + np.float32(0.5)).astype(np.uint16)]


def mean_luminance(rgb: UInt8Array) -> float:
    """Mean light of an image, 0..1; any size will do for metering."""
    return float((to_linear(rgb).reshape(-1, 3).mean(axis=0, dtype=np.float64) * LUMINANCE).sum())


def motion_blur(
    linear: Light, depth_m: Light, intrinsics: Float64Array, camera_to_world: Float64Array,
    at_open: Float64Array, at_close: Float64Array, n_samples: int = 8,
) -> Light:  # fmt: skip
    """The mean of the image over an exposure, sampled along each pixel's projected motion.

    Poses (4, 4) are camera-to-world, of the image and at both ends of the exposure. Each pixel moves by its own depth;
    one without depth is taken as infinitely far. At most ``n_samples``, fewer if nothing moves by as many pixels.
    """
    import cv2

    if n_samples < 2 or np.array_equal(at_open, at_close):
        return linear
    u, v = np.meshgrid(np.arange(depth_m.shape[1], dtype=np.float32), np.arange(depth_m.shape[0], dtype=np.float32))
    inverse = inverse_depth(depth_m)

    def seen_from(pose: Float64Array) -> tuple[Light, Light]:
        """Where another camera sees the point of each pixel: K (R K^-1 (u, v, 1) + t / depth)."""
        motion = np.linalg.inv(pose) @ camera_to_world
        turn = (intrinsics @ motion[:3, :3] @ np.linalg.inv(intrinsics)).astype(np.float32)
        shift = (intrinsics @ motion[:3, 3]).astype(np.float32)
        x, y, z = (turn[k, 0] * u + turn[k, 1] * v + turn[k, 2] + shift[k] * inverse for k in range(3))
        z = np.maximum(z, np.float32(1e-3))
        return x / z, y / z

    flow_u, flow_v = (end - start for start, end in zip(seen_from(at_open), seen_from(at_close), strict=True))
    n = min(n_samples, max(1, int(np.ceil(max(np.abs(flow_u).max(), np.abs(flow_v).max())))))
    total, shifted = np.zeros_like(linear), np.empty_like(linear)
    for share in ((np.arange(n) + 0.5) / n - 0.5).astype(np.float32):
        to_u, to_v = u - share * flow_u, v - share * flow_v
        total += cv2.remap(linear, to_u, to_v, cv2.INTER_LINEAR, dst=shifted, borderMode=cv2.BORDER_REPLICATE)
    return total * np.float32(1 / n)


def exposure_gain(luminances: Sequence[float], target: float, speed: float, min_ev: float, max_ev: float) -> float:
    """Gain of the last frame of ``luminances`` (of the unchanged images, in order): a first-order lag in stops.

    The first frame is settled; each later one goes a part ``speed`` (0..1) of the way to ``target``.

    >>> exposure_gain([0.1, 0.4], target=0.2, speed=0.5, min_ev=-2, max_ev=2)
    1.0
    """
    wanted = np.clip(np.log2(target / np.maximum(luminances, 1e-6)), min_ev, max_ev)
    return float(2.0 ** reduce(lambda ev, next_ev: ev + speed * (next_ev - ev), wanted))


def expose(linear: Light, gain: float) -> Light:
    """Light times ``gain``; where the image is saturated it stays so, as the light there is at least 1."""
    brighter = linear * np.float32(gain)
    if gain < 1:
        brighter += np.float32(1 - gain) * np.square(np.square(np.square(linear)))  # 0.004 at half of the scale
    return np.asarray(np.minimum(brighter, 1, out=brighter))


def photon_noise(linear: Light, shot: float, read: float, rng: Generator, gain: float = 1.0) -> Light:
    """Light with variance shot * gain * light + read * gain^2 (photon transfer: Janesick 2007; Brooks et al. 2019,
    equation 1). ``shot`` and ``read`` are variances at gain 1 for a full scale of 1."""
    noise = np.float32(shot * gain) * linear
    noise += np.float32(read * gain**2)
    np.sqrt(noise, out=noise)
    noise *= normal_noise(linear.shape, rng)
    noise += linear
    return noise


def jpeg(rgb: UInt8Array, quality: int | None) -> UInt8Array:
    """The image after JPEG compression at ``quality`` 1..100; None does not compress."""
    if quality is None:
        return rgb
    import cv2

    data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)


def last_of_video(images: Sequence[UInt8Array], crf: float) -> UInt8Array:
    """The last of ``images``, all (H, W, 3), as a receiver of H.264 video of them sees it; ``crf``: 0 best to 51 worst.

    As streamed by a camera, without delay: the first is coded on its own, the others as changes from earlier ones.
    Raises ``ConfigError`` if PyAV has no encoder of H.264.
    """
    import av

    if "libx264" not in av.codecs_available:
        raise ConfigError("compressed video: PyAV was built without libx264; install its wheel: pip install av")
    height, width = images[0].shape[:2]
    rim = ((0, height % 2), (0, width % 2), (0, 0))  # colour has half the resolution, so sides must be even
    encoder, decoder = av.VideoCodecContext.create("libx264", "w"), av.VideoCodecContext.create("h264", "r")
    encoder.thread_count = decoder.thread_count = 1  # the same bytes on any number of cores
    encoder.width, encoder.height = width + width % 2, height + height % 2
    encoder.pix_fmt, encoder.framerate = "yuv420p", Fraction(30)
    encoder.options = {"crf": f"{crf:g}", "tune": "zerolatency"}
    packets = []
    for image in images:
        frame = av.VideoFrame.from_ndarray(np.pad(image, rim, "edge"), "rgb24")
        packets += encoder.encode(frame.reformat(format="yuv420p"))
    packets += encoder.encode(None)
    received = [frame for packet in (*packets, None) for frame in decoder.decode(packet)]
    return np.asarray(received[-1].to_ndarray(format="rgb24")[:height, :width], np.uint8)
