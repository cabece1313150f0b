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


def disturb(
    masks: list[BoolArray], names: list[str], known: list[str], noise: OracleNoise, frame_index: int
) -> tuple[list[BoolArray], list[str]]:
    """``masks`` and ``names`` with the faults of ``noise``; ``known`` are the names that a flip may give."""
    generator = np.random.default_rng([noise.seed, frame_index])
    masks, names = _drop(masks, names, noise.drop_probability, generator)
    masks, names = _merge(masks, names, noise.merge_probability, generator)
    masks, names = _split(masks, names, noise.split_probability, generator)
    if noise.erode_px or noise.dilate_px:
        masks = [_resize(mask, noise.erode_px, noise.dilate_px) for mask in masks]
    return masks, _flip(names, known, noise.flip_probability, generator)


def _drop(
    masks: list[BoolArray], names: list[str], probability: float, generator: np.random.Generator
) -> tuple[list[BoolArray], list[str]]:
    is_kept = generator.random(len(masks)) >= probability
    kept = np.flatnonzero(is_kept)
    return [masks[k] for k in kept], [names[k] for k in kept]


def _merge(
    masks: list[BoolArray], names: list[str], probability: float, generator: np.random.Generator
) -> tuple[list[BoolArray], list[str]]:
    """Each drawn mask joins the touching mask of the most pixels, under the name of the larger of the two."""
    is_drawn = generator.random(len(masks)) < probability
    masks, alive = list(masks), np.ones(len(masks), bool)
    names = list(names)
    for k in np.flatnonzero(is_drawn):
        if not alive[k]:
            continue
        grown = _resize(masks[k], 0, 2)
        touching = [j for j in np.flatnonzero(alive) if j != k and np.any(grown & masks[j])]
        if not touching:
            continue
        sizes = [int(np.count_nonzero(masks[j])) for j in touching]
        other = touching[int(np.argmax(sizes))]
        if np.count_nonzero(masks[k]) > max(sizes):
            names[other] = names[k]
        masks[other] = masks[other] | masks[k]
        alive[k] = False
    kept = np.flatnonzero(alive)
    return [masks[k] for k in kept], [names[k] for k in kept]


def _split(
    masks: list[BoolArray], names: list[str], probability: float, generator: np.random.Generator
) -> tuple[list[BoolArray], list[str]]:
    is_drawn = generator.random(len(masks)) < probability
    angles = generator.random(len(masks)) * math.pi
    pieces: list[BoolArray] = []
    piece_names: list[str] = []
    for mask, name, drawn, angle in zip(masks, names, is_drawn, angles, strict=True):
        if not drawn or not mask.any():
            pieces.append(mask)
            piece_names.append(name)
            continue
        v, u = np.nonzero(mask)
        side = (u - u.mean()) * math.cos(angle) + (v - v.mean()) * math.sin(angle) > 0
        first, second = np.zeros_like(mask), np.zeros_like(mask)
        first[v[side], u[side]] = True
        second[v[~side], u[~side]] = True
        pieces += [first, second]
        piece_names += [name, name]
    return pieces, piece_names


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
