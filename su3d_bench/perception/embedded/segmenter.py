"""A segmenter without weights: superpixels of colour, depth and normals; surfaces; objects by convexity."""

from __future__ import annotations

from typing import Literal

import numpy as np

from su3d_bench.core.digests import package_digest
from su3d_bench.core.types import (
    BoolArray,
    Float32Array,
    Float64Array,
    Frame,
    Int32Array,
    Int64Array,
    Regions,
    UInt8Array,
)
from su3d_bench.perception.cache import CODE, content_key, mask_boxes
from su3d_bench.perception.embedded.join_rules import SegmenterConfig, join_objects, region_quality, remove_structure
from su3d_bench.perception.embedded.surface_graph import Graph, Pieces, measure_borders

MAX_LEVELS = 2048


def superpixels(frame: Frame, config: SegmenterConfig) -> tuple[Int32Array, Graph]:
    """The superpixels (H, W) of ``frame`` and the graph of their borders, at working resolution."""
    from su3d_bench.perception.embedded import kernels

    rgb, depth_m, intrinsics = _at_working_size(frame, config.max_width)
    height, width = depth_m.shape
    lab = _smooth_lab(rgb, config)
    x = (np.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (np.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1]
    known = np.isfinite(depth_m) & (depth_m > 0)
    disparity = np.zeros((height, width), np.float32)
    disparity[known] = 1 / depth_m[known]
    disparity, noise = _denoised(disparity, config)
    planes = _planes(disparity, noise, x, y, config)
    normal_unit = 2 * np.sin(np.deg2rad(config.normal_unit_degrees) / 2)
    colour, depth, normal = kernels.pair_costs(
        lab, disparity, planes, x, y, config.colour_unit, config.depth_jump, config.noise_margin * noise, normal_unit
    )
    cost = np.sqrt(colour**2 + np.maximum(depth, 0) ** 2 + normal**2)
    labels = kernels.grow_superpixels(cost, _cheap_first(cost), config.superpixel_scale, config.min_superpixel_px)
    contrast = colour * np.float32(config.colour_unit)
    pieces = Pieces.from_sums(kernels.sum_pixels(labels, int(labels.max()) + 1, lab, contrast, disparity, planes, x, y))
    borders = measure_borders(labels, contrast, depth, config.depth_jump, pieces)
    graph = Graph(pieces, borders, np.arange(len(pieces)))
    return labels, graph


def _cheap_first(cost: Float32Array) -> Int64Array:
    """Positions of the pairs of neighbours in the flat ``cost`` (2, H, W), sorted by its levels of 1 / 64.

    Pairs of equal level are in row-major order, right neighbours first.
    """
    level = np.minimum(cost * 64, MAX_LEVELS - 1).astype(np.int16)
    level[0, :, -1] = level[1, -1] = -1  # no neighbour
    return np.argsort(level, axis=None, kind="stable")[sum(cost.shape[1:]) :]


def _at_working_size(frame: Frame, max_width: int) -> tuple[UInt8Array, Float32Array, Float64Array]:
    """Colour averaged and depth sampled at a whole fraction of the size, with the matching intrinsics."""
    import cv2

    factor = -(-frame.rgb.shape[1] // max_width)
    if factor == 1:
        return frame.rgb, frame.depth_m, frame.intrinsics
    depth_m = np.ascontiguousarray(frame.depth_m[factor // 2 :: factor, factor // 2 :: factor])
    rgb = np.asarray(cv2.resize(frame.rgb, depth_m.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    intrinsics = frame.intrinsics.copy()
    intrinsics[:2] /= factor
    intrinsics[:2, 2] -= (factor // 2) / factor
    return rgb, depth_m, intrinsics


def _smooth_lab(rgb: UInt8Array, config: SegmenterConfig) -> Float32Array:
    import cv2

    smooth = cv2.bilateralFilter(rgb, 5, config.smoothing_colour, 2.0)
    lab = np.asarray(cv2.cvtColor(smooth.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB), np.float32)
    weights: Float32Array = np.array([config.lightness_weight, 1, 1], np.float32)
    return lab * weights


def _denoised(disparity: Float32Array, config: SegmenterConfig) -> tuple[Float32Array, float]:
    """``disparity`` without most of its noise, and the standard deviation of the remaining noise.

    Depth noise grows with the square of depth (Khoshelham and Elberink 2012), so that it is uniform in disparity.
    """
    import cv2

    noise = disparity_noise(disparity)
    if noise <= config.noise_floor:
        return disparity, 0.0
    smooth = np.asarray(cv2.bilateralFilter(disparity, 7, config.noise_smoothing * noise, 3.0), np.float32)
    smooth[disparity <= 0] = 0
    return smooth, disparity_noise(smooth)


def disparity_noise(disparity: Float32Array) -> float:
    """Robust standard deviation of the noise of ``disparity`` in 1/m, from its second differences along rows."""
    left, here, right = disparity[::2, :-2:2], disparity[::2, 1:-1:2], disparity[::2, 2::2]
    size = min(left.shape[1], here.shape[1], right.shape[1])
    left, here, right = left[:, :size], here[:, :size], right[:, :size]
    bends = np.abs(left - 2 * here + right)[(left > 0) & (here > 0) & (right > 0)]
    # 1.2816: the 80th percentile of |x| for unit normal x; it excludes most edges, but still counts the steps of
    # coarsely quantised depth, whose differences are mostly 0. sqrt(6): a second difference adds 1 + 4 + 1 variances.
    return float(np.quantile(bends, 0.8)) / (1.2816 * float(np.sqrt(6))) if len(bends) else 0.0


def _planes(
    disparity: Float32Array, noise: float, x: Float64Array, y: Float64Array, config: SegmenterConfig
) -> Float32Array:
    """Local planes of every pixel (H, W, 3), fitted at half resolution."""
    import cv2

    from su3d_bench.perception.embedded import kernels

    half = np.ascontiguousarray(disparity[::2, ::2])
    broken = kernels.discontinuities(half, 2 * config.depth_jump, config.noise_margin * noise, 2.0)
    distance = cv2.distanceTransform((~broken).astype(np.uint8), cv2.DIST_C, 3)
    radius = np.clip(np.minimum(distance, config.normal_radius + 1).astype(np.int32) - 1, 1, config.normal_radius)
    half_x, half_y = x[::2].copy(), y[::2].copy()
    planes = kernels.fit_planes(half, radius, half_x, half_y)
    reach = config.normal_radius
    planes = kernels.sharpen_planes(
        planes, half, reach, config.normal_min_gain, config.noise_margin * noise, half_x, half_y
    )
    return np.asarray(kernels.double_planes(planes, disparity, x, y), np.float32)


class RgbdSegmenter:
    """Regions of any RGB-D frame: complete ``objects`` without floor, walls and ceiling; or ``parts`` of everything."""

    name = "rgbd"

    def __init__(self, config: SegmenterConfig, level: Literal["objects", "parts"]) -> None:
        weights = config.join
        if level == "parts":
            weights = weights.model_copy(update={"bias": weights.bias - config.part_penalty})
        self._config = config.model_copy(update={"join": weights})
        self._level = level
        self.digest = content_key("rgbd", level, config.model_dump_json(), package_digest(*CODE))

    def segment(self, frame: Frame) -> Regions:
        """Non-overlapping masks, largest first."""
        import cv2

        cv2.setNumThreads(1)
        labels, graph = superpixels(frame, self._config)
        surfaces, is_structure = remove_structure(graph, self._config)
        objects, is_structure = join_objects(surfaces, is_structure, self._config)
        is_left_out = is_structure & (self._level == "objects")
        return self._regions(frame, labels, objects, is_structure, is_left_out)

    def _regions(
        self, frame: Frame, superpixel: Int32Array, graph: Graph, is_structure: BoolArray, is_left_out: BoolArray
    ) -> Regions:
        height, width = frame.depth_m.shape
        labels = graph.piece_of_superpixel.astype(np.int32).take(superpixel)
        factor = -(-width // self._config.max_width)
        labels = np.repeat(np.repeat(labels, factor, axis=0), factor, axis=1)
        labels = np.pad(labels, ((0, max(0, height - len(labels))), (0, max(0, width - labels.shape[1]))), mode="edge")
        labels = labels[:height, :width]
        sizes = np.bincount(labels.ravel(), minlength=len(graph.pieces))
        order = np.argsort(-sizes, kind="stable")
        chosen = [k for k in order if not is_left_out[k] and sizes[k] >= self._config.min_region_px]
        masks = np.empty((len(chosen), height, width), np.bool_)
        for mask, k in zip(masks, chosen, strict=True):
            np.equal(labels, k, out=mask)
        quality = region_quality(graph, is_structure, _pixels_at_image_border(graph, superpixel), self._config)
        return Regions(masks, mask_boxes(masks), quality[np.array(chosen, np.intp)].astype(np.float32))


def _pixels_at_image_border(graph: Graph, superpixel: Int32Array) -> Float64Array:
    rim = np.concatenate([superpixel[0], superpixel[-1], superpixel[:, 0], superpixel[:, -1]])
    return np.bincount(graph.piece_of_superpixel[rim], minlength=len(graph.pieces)).astype(np.float64)
