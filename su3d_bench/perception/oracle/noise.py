"""Adjustable faults of otherwise perfect masks, drawn from a seed of their own for every frame."""

from __future__ import annotations

import math

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.types import BoolArray, UInt8Array


class OracleNoise(BaseModel):
    """How far the oracle's masks and names are spoilt; every value is 0 by default: none.

    Applied in this order: drop a mask; merge it with a touching one; split it by a line through its centre; erode or
    dilate what is left by whole pixels (a grown mask may overlap its neighbour); flip its name to another class of the
    scene.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = Field(default=0, ge=0)
    erode_px: int = Field(default=0, ge=0)
    dilate_px: int = Field(default=0, ge=0)
    drop_probability: float = Field(default=0.0, ge=0, le=1)
    merge_probability: float = Field(default=0.0, ge=0, le=1)
    split_probability: float = Field(default=0.0, ge=0, le=1)
    flip_probability: float = Field(default=0.0, ge=0, le=1)


Region = tuple[BoolArray, str]


def disturb(
    masks: list[BoolArray], names: list[str], known: list[str], noise: OracleNoise, frame_index: int
) -> tuple[list[BoolArray], list[str]]:
    """``masks`` and ``names`` with the faults of ``noise``; ``known`` are the names that a flip may give."""
    generator = np.random.default_rng([noise.seed, frame_index])
    regions = list(zip(masks, names, strict=True))
    is_kept = generator.random(len(regions)) >= noise.drop_probability
    regions = _merge([regions[k] for k in np.flatnonzero(is_kept)], noise.merge_probability, generator)
    regions = _split(regions, noise.split_probability, generator)
    masks = [mask for mask, _ in regions]
    if noise.erode_px or noise.dilate_px:
        masks = [_resize(mask, noise.erode_px, noise.dilate_px) for mask in masks]
    return masks, _flip([name for _, name in regions], known, noise.flip_probability, generator)


def _merge(regions: list[Region], probability: float, generator: np.random.Generator) -> list[Region]:
    """Each drawn mask joins the touching mask of the most pixels, under the name of the larger of the two."""
    is_drawn = generator.random(len(regions)) < probability
    merged = dict(enumerate(regions))
    for k in np.flatnonzero(is_drawn).tolist():
        mask, name = merged[k]
        grown = _resize(mask, 0, 2)
        sizes = {j: np.count_nonzero(near) for j, (near, _) in merged.items() if j != k and np.any(grown & near)}
        if sizes:
            other = max(sizes, key=lambda j: sizes[j])
            near, near_name = merged[other]
            merged[other] = near | mask, name if np.count_nonzero(mask) > sizes[other] else near_name
            del merged[k]
    return list(merged.values())


def _split(regions: list[Region], probability: float, generator: np.random.Generator) -> list[Region]:
    is_drawn = generator.random(len(regions)) < probability
    angles = generator.random(len(regions)) * math.pi
    pieces: list[Region] = []
    for (mask, name), drawn, angle in zip(regions, is_drawn, angles, strict=True):
        if not drawn or not mask.any():
            pieces.append((mask, name))
            continue
        v, u = np.nonzero(mask)
        side = (u - u.mean()) * math.cos(angle) + (v - v.mean()) * math.sin(angle) > 0
        first = np.zeros_like(mask)
        first[v[side], u[side]] = True
        pieces += [(first, name), (mask & ~first, name)]
    return pieces


def _resize(mask: BoolArray, erode_px: int, dilate_px: int) -> BoolArray:
    import cv2

    image: UInt8Array = mask.astype(np.uint8)
    if erode_px:
        image = np.asarray(cv2.erode(image, _disc(erode_px), borderType=cv2.BORDER_REPLICATE), np.uint8)
    if dilate_px:
        image = np.asarray(cv2.dilate(image, _disc(dilate_px)), np.uint8)
    return image.astype(bool)


def _disc(radius: int) -> UInt8Array:
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.asarray(u**2 + v**2 <= radius**2, np.uint8)


def _flip(names: list[str], known: list[str], probability: float, generator: np.random.Generator) -> list[str]:
    is_drawn = generator.random(len(names)) < probability
    picks = generator.random(len(names))
    flipped = []
    for name, drawn, pick in zip(names, is_drawn, picks, strict=True):
        others = [other for other in known if other != name]
        flipped.append(others[int(pick * len(others))] if drawn and others else name)
    return flipped
