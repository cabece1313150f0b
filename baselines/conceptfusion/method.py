"""ConceptFusion: pixel-aligned features of image and regions, fused into points; one feature per point, no instances.

Each pixel gets a mixture of the image's feature and those of the regions over it. Source:
extract_conceptfusion_features.py of concept-fusion at 4457c1f and its branch fastsam at 668c26c; the uniqueness term
is the paper's (Eq. 4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.baselines.conceptfusion.point_fusion import ABSENT, FeatureTable, Place, PointFusion, View, view_of
from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.files.state import read_state, write_state
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Float64Array,
    Frame,
    Int32Array,
    Int64Array,
    PerceptionNeeds,
    SceneInfo,
)
from su3d_bench.formats.numpy_files import map_npy
from su3d_bench.store.predictions import write_rows

Weights = Literal["softmax", "uniqueness"]
Overlaps = Literal["sum", "small-over-large"]
SMALLEST_LENGTH = 1e-12  # lower bound of the divisor in torch's normalize


@dataclass(frozen=True)
class PixelFeatures:
    """The row of ``features`` (C, D) float16 for each pixel: ``row`` (height, width) int32.

    Pixels under the same masks share a row; the row of pixels under no mask is zero.
    """

    row: Int32Array
    features: NDArray[np.float16]


def picked(n_pixels: int, n_picked: int) -> Int64Array:
    """The positions (of ``n_pixels``) used by a nearest-neighbour resize to ``n_picked``: floor(i n / m), as in torch.

    >>> picked(6, 4).tolist(), picked(2, 4).tolist()
    ([0, 1, 3, 4], [0, 0, 1, 1])
    """
    return np.arange(n_picked, dtype=np.int64) * n_pixels // n_picked


def mixing_weights(whole: Float32Array, regions: Float32Array, rule: Weights, temperature: float = 1.0) -> Float64Array:
    """Weight of the image's feature in each region's pixels (K,): a softmax over the regions of one image.

    ``softmax`` is over the cosines of regions (K, D) with the image's feature (D,); ``uniqueness`` adds to each the
    mean cosine with the other regions. A single region gets weight 1, hence nothing of its own feature.

    >>> mixing_weights(np.ones(2, np.float32), np.eye(2, dtype=np.float32), "softmax").tolist()
    [0.5, 0.5]
    """
    directions = _normalised(np.asarray(regions, np.float64))
    score = directions @ _normalised(np.asarray(whole, np.float64)[None])[0]
    if rule == "uniqueness" and len(regions) > 1:
        between = directions @ directions.T
        score = score + (between.sum(axis=1) - np.diag(between)) / (len(regions) - 1)
    share = np.exp((score - score.max(initial=-np.inf)) / temperature)
    weights: Float64Array = share / share.sum()
    return weights


def mixed_features(whole: Float32Array, regions: Float32Array, weights: Float64Array) -> Float64Array:
    """The feature (K, D) of the pixels of each region: normalise(w f_G + (1 - w) f_i)."""
    share = weights[:, None]
    return _normalised(share * np.asarray(whole, np.float64) + (1 - share) * np.asarray(regions, np.float64))


def paint(
    masks: BoolArray, boxes: Float32Array, features: Float64Array, overlaps: Overlaps, height: int, width: int
) -> PixelFeatures:
    """The field of ``height`` x ``width`` pixels, from masks (K, H, W) of any size.

    ``sum``: masks in their order, F <- normalise(F + f_i), so that the last counts as much as all before it together.
    ``small-over-large``: masks by descending box area, each overwriting the previous ones.
    The originals paint at full size and then resize, or vice versa; with nearest-neighbour resizing both are the same.
    """
    k, n_dimensions = features.shape
    if k == 0:
        return PixelFeatures(np.zeros((height, width), np.int32), np.zeros((1, n_dimensions), np.float16))
    rows, columns = picked(masks.shape[1], height), picked(masks.shape[2], width)
    is_inside = masks[:, rows[:, None], columns].reshape(k, -1)
    # one feature per set of masks covering some pixel, not per pixel
    packed = np.ascontiguousarray(np.packbits(is_inside, axis=0).T)
    _, example, row = np.unique(
        packed.view(np.dtype((np.void, packed.shape[1]))).ravel(), return_index=True, return_inverse=True
    )
    is_under = is_inside[:, example]
    field = np.zeros((len(example), n_dimensions))
    for i in _painting_order(boxes, overlaps):
        hit = is_under[i]
        field[hit] = _normalised(field[hit] + features[i]) if overlaps == "sum" else features[i]
    return PixelFeatures(row.reshape(height, width).astype(np.int32), field.astype(np.float16))


def _painting_order(boxes: Float32Array, overlaps: Overlaps) -> Int64Array:
    if overlaps == "sum":
        return np.arange(len(boxes))
    areas = (boxes[:, 2] - boxes[:, 0]).astype(np.float64) * (boxes[:, 3] - boxes[:, 1])
    return np.argsort(areas, kind="stable")[::-1]  # of equal boxes the first in the list is painted last, on top


def _normalised(rows: Float64Array) -> Float64Array:
    length = np.sqrt((rows * rows).sum(axis=-1, keepdims=True))
    normalised: Float64Array = rows / np.maximum(length, SMALLEST_LENGTH)
    return normalised


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
PAPER = "Jatavallabhula et al.: ConceptFusion: Open-set Multimodal 3D Mapping, RSS 2023"
SOURCE = (
    "https://github.com/concept-fusion/concept-fusion, commit 4457c1f (its branch fastsam: 668c26c); "
    "https://github.com/gradslam/gradslam, branch conceptfusion, commit 59ca872"
)


class ConceptFusionConfig(BaseModel):
    """Every hyper-parameter; defaults are those of the released scripts unless a comment states otherwise."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    stride: int = Field(default=20, ge=1)
    # The size at which pixels are fused, for all images: image_height and image_width of the fusion script.
    height: int = Field(default=120, ge=2, le=4096)
    width: int = Field(default=160, ge=2, le=4096)
    # The paper's Eq. 4: according to its README, Mask2Former's masks need it and SAM's do not.
    weights: Weights = "uniqueness"
    temperature: Positive = 1.0
    # "small-over-large" is that of the branch fastsam.
    mask_overlap: Overlaps = "sum"
    # gradslam at 59ca872 averages a feature only if no channel is zero; its comment (and forks) suggest
    # "not all channels are zero": "any-channel".
    valid_feature_rule: Literal["no-zero-channel", "any-channel"] = "no-zero-channel"
    # gradslam at 59ca872 multiplies confidence by feature in half precision, so that points beyond about 3 m, with
    # minimal confidence, lose the feature of the first image: "half", the preset half-products. The default is
    # "single", because that loss is neither in the paper nor intended.
    matmul_precision: Literal["single", "half"] = "single"
    distance_m: Positive = 0.05  # PointFusion's dist_th
    normal_angle_deg: float = Field(default=20.0, ge=0, le=180)  # angle_th
    sigma: Positive = 0.6  # m, of alpha
    # Ours: the same numbers in memory or in a file; a scene of 2 M points x 1024 dimensions takes 4.1 GB.
    feature_storage: Place = "disk"


FEATURES = "features.npy"  # of a saved state
_FORMS = {"points": "f8 N 3", "normals": "f8 N 3", "counts": "f8 N", "confidences": "f8 N", "lengths": "f8 N"}


class ConceptFusion:
    """Pixel features from masks of named objects, fused into one feature per point; no instances."""

    name = "conceptfusion"
    warms_up = True
    Config: type[ConceptFusionConfig] = ConceptFusionConfig
    presets: ClassVar[Mapping[str, Mapping[str, str]]] = {"half-products": {"matmul_precision": "half"}}
    about = MethodAbout(
        paper=PAPER,
        source=f"{SOURCE}; masks of Mask2Former and the uniqueness term are from the paper only",
        licence="MIT (concept-fusion and gradslam)",
        needs=("masks of named objects",),
        status="each formula of the released code and of the paper is tested on hand-worked values; compared with the "
        "original programs on one generated room with the same detections: points within 2e-6 m; they multiply "
        "confidence by feature in half precision, where 15 % of the first frame's points (the far ones) lose their "
        "feature (as with the preset half-products); no results of a paper have been reproduced",
    )

    def __init__(self, config: ConceptFusionConfig | None = None) -> None:
        self.config = config or self.Config()
        self._features: FeatureTable | None = None
        self._clear()

    def _clear(self) -> None:
        self.close()
        self._features = None
        self._map = PointFusion(self.config.distance_m, self.config.normal_angle_deg)

    @property
    def needs(self) -> PerceptionNeeds:
        """Masks of named objects and surfaces, including background, as from Mask2Former in the paper.

        ConceptGraphs' table distinguishes the two this way: its ConceptFusion+SAM replaces Mask2Former by SAM.
        """
        return PerceptionNeeds(masks="grounded")

    @property
    def finishes_in_fork(self) -> bool:
        """Whether features are in memory: a file is shared with a forked process, whose map would change with it."""
        return self.config.feature_storage == "memory"

    @property
    def n_points(self) -> int:
        """Points of the map so far, including those without a feature."""
        return len(self._map)

    @property
    def map_bytes(self) -> int:
        """Bytes of points, normals, counts and features, in memory or on disk."""
        features = self._features
        return self._map.n_bytes + (features.n_bytes + len(features) * 8 if features else 0)

    def start(self, scene: SceneInfo) -> None:
        """Resets the map; the new scene needs no preparation."""
        self._clear()

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Fuses one image into the map; association scans the whole map, the rest only the image."""
        detections.check_of(frame)
        features = self._table_for(detections)
        with timer.stage("backproject"):
            rows, columns = map(picked, frame.depth_m.shape, (self.config.height, self.config.width))
            view = view_of(frame, rows, columns, self.config.sigma)
        with timer.stage("paint"):
            field = self._field(detections)
        with timer.stage("match"):
            matched = self._map.associate(view)
        with timer.stage("fuse"):
            self._map.fuse(view, matched)
            self._average(features, view, field, matched)
        with timer.stage("insert"):
            pixel = self._map.insert(view, matched)
            # a pixel outside all masks creates a point too, with zero feature and normal confidence
            features.append(field.features, field.row.ravel()[pixel], view.alpha[pixel])

    def _table_for(self, detections: Detections) -> FeatureTable:
        n_dimensions = len(detections.global_feature)
        if self._features is None:
            self._features = FeatureTable(n_dimensions, self.config.feature_storage)
        if self._features.n_dimensions != n_dimensions:
            raise DataError(
                f"frame {detections.frame_index}: features have {n_dimensions} dimensions, those of the map have "
                f"{self._features.n_dimensions}; use one encoder for all"
            )
        return self._features

    def _field(self, detections: Detections) -> PixelFeatures:
        config, whole, regions = self.config, detections.global_feature, detections.crop_features[:, 0]
        mixed = np.zeros((0, len(whole)))
        if len(regions):
            weights = mixing_weights(whole, regions, config.weights, config.temperature)
            mixed = mixed_features(whole, regions, weights)
        return paint(detections.masks, detections.boxes, mixed, config.mask_overlap, config.height, config.width)

    def _average(self, features: FeatureTable, view: View, field: PixelFeatures, matched: Int64Array) -> None:
        is_set = np.all if self.config.valid_feature_rule == "no-zero-channel" else np.any
        is_valid = is_set(field.features != 0, axis=1)
        is_met = matched != ABSENT
        pixel = np.flatnonzero(is_met & is_valid[field.row.ravel()])
        seen = matched[pixel], field.features, field.row.ravel()[pixel], view.alpha[pixel]
        if self.config.matmul_precision == "single":
            features.average(*seen)
        elif is_met.any():
            features.average_in_half(*seen)

    def finish(self) -> DenseFeatures:
        """The points so far, each with its feature, zero for none; features are a view until the next update."""
        features = np.zeros((0, 0), np.float16) if self._features is None else self._features.features()
        return DenseFeatures(self._map.points.astype(np.float32), features)

    def save_state(self, folder: Path) -> None:
        """Store the points, and the features in a file of their own."""
        table, fused = self._features, self._map
        if table is not None:
            write_rows(folder / FEATURES, table.features())
        state = None if table is None else table.state()
        write_state(
            folder, {"points": fused.points, "normals": fused.normals, "counts": fused.counts, "features": state}
        )

    def load_state(self, folder: Path) -> None:
        """Continue from a stored state."""
        values = read_state(folder, _FORMS)
        self._clear()
        self._map.restore(values["points"], values["normals"], values["counts"])
        if values["features"] is not None:
            rows, confidences = map_npy(folder / FEATURES), values["features"]["confidences"]
            if rows.dtype != np.float16 or rows.ndim != 2 or {len(rows), len(confidences)} != {len(self._map)}:
                raise StoreError(f"{folder / FEATURES}: has {rows.dtype} {rows.shape}; expected one row per point")
            self._features = FeatureTable(rows.shape[1], self.config.feature_storage)
            self._features.restore(rows, confidences, values["features"]["lengths"])

    def close(self) -> None:
        """Give the features' disk space back; the map cannot be updated after that."""
        if self._features is not None:
            self._features.close()


class ConceptFusionSamConfig(ConceptFusionConfig):
    """ConceptFusion's, without the uniqueness term: according to its README, SAM's masks do not need it."""

    weights: Weights = "softmax"


class ConceptFusionSam(ConceptFusion):
    """Pixel features from class-agnostic masks of every region, fused into one feature per point; no instances."""

    name = "conceptfusion-sam"
    Config = ConceptFusionSamConfig
    about = replace(
        ConceptFusion.about,
        paper=f"{PAPER}; with SAM's masks: Gu et al.: ConceptGraphs, ICRA 2024, Table II",
        source=SOURCE,
        needs=("class-agnostic masks",),
    )

    @property
    def needs(self) -> PerceptionNeeds:
        """Every region of an image, objects and their parts, which may overlap."""
        return PerceptionNeeds(masks="class-agnostic", automatic="conceptfusion")
