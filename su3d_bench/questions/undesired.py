"""The paper's filter of large background objects, applied to a map again once its instances have labels n'.

"Large background objects (walls, ground, roof, ceiling) and objects with bounding boxes > 95 % of image area are
excluded" (section IV, Filtering and Post-Processing); labels n' "help to filter out undesired large instances" (the
text beside Table V).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import PredictionError, printable
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.perception.detections import is_background

_OF_IMAGES = OpenSU3DConfig()


class FilterConfig(BaseModel):
    """Which instances labels n' leave out; no ``background_names`` and a ``max_map_fraction`` of 1 leave out none."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    # The paper's list, by the head noun of a name, as for what is found in images.
    background_names: Annotated[tuple[str, ...], Field(strict=False)] = _OF_IMAGES.background_names
    # The paper's share is of an image's area; the map has no image, so that of its floor plan stands here (ours).
    max_map_fraction: float = Field(default=_OF_IMAGES.max_box_fraction, gt=0, le=1)


def undesired(instances: Instances, names: Sequence[str], config: FilterConfig) -> tuple[str, ...]:
    """Why each instance is left out under its label n' in ``names``; '' where it stays."""
    fractions = _map_fractions(instances)
    return tuple(_reason(name, float(share), config) for name, share in zip(names, fractions, strict=True))


def _reason(name: str, fraction: float, config: FilterConfig) -> str:
    if is_background(name, config.background_names):
        return f"'{printable(name, 60)}' is background"
    if fraction > config.max_map_fraction:
        return f"its box has {100 * fraction:.0f} % of the map's area from above"
    return ""


def _map_fractions(instances: Instances) -> Float64Array:
    """The share (K,) of the map's box from above that the box of each instance has; 0 where the map has no area."""
    k, points, boxes = len(instances), instances.points, instances.boxes.astype(np.float64)
    if boxes.shape != (k, 2, 3) or points.ndim != 2 or points.shape[1] != 3:
        raise PredictionError(f"this map has boxes {boxes.shape} for {k} instances, and points {points.shape}")
    if not len(points):
        return np.zeros(k)
    area = float(np.prod(np.ptp(points[:, :2], axis=0).astype(np.float64)))
    sides = np.maximum(boxes[:, 1, :2] - boxes[:, 0, :2], 0.0)
    answer: Float64Array = np.prod(sides, axis=1) / area if area > 0 else np.zeros(k)
    return answer
