"""A segmenter that needs no weights: surfaces from depth, normals and colour; objects from convexity."""

from __future__ import annotations

from typing import Literal

import numpy as np

from su3d_bench.core.digests import package_digest
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int32Array, Regions
from su3d_bench.perception.cache import CACHE_SOURCES, content_key
from su3d_bench.perception.crops import mask_boxes
from su3d_bench.perception.embedded.segmenter.config import SegmenterConfig
from su3d_bench.perception.embedded.segmenter.graph import Graph
from su3d_bench.perception.embedded.segmenter.pixels import superpixels
from su3d_bench.perception.embedded.segmenter.rules import join_objects, region_quality, take_out_structure

__all__ = ["RgbdSegmenter", "SegmenterConfig"]


# What moves the regions: their key follows it.
SOURCES = (
    "perception/embedded/segmenter",
    "numerics/clusters.py",
    "core/compiled.py",
    *CACHE_SOURCES,
)


class RgbdSegmenter:
    """Regions of any RGB-D frame: whole ``objects`` without floor, walls and ceiling; or ``parts`` of everything."""

    name = "rgbd"

    def __init__(self, config: SegmenterConfig, level: Literal["objects", "parts"]) -> None:
        weights = config.join
        if level == "parts":
            weights = weights.model_copy(update={"bias": weights.bias - config.parts_caution})
        self._config = config.model_copy(update={"join": weights})
        self._level = level
        self.digest = content_key("rgbd", level, config.model_dump_json(), package_digest(*SOURCES))

    def segment(self, frame: Frame) -> Regions:
        """Masks that do not overlap, largest first."""
        import cv2

        cv2.setNumThreads(1)
        labels, graph = superpixels(frame, self._config)
        surfaces, is_structure = take_out_structure(graph, self._config)
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
