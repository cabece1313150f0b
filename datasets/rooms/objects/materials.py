"""Materials: a procedural texture with its colours, evaluated in object space, so that every view agrees."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from su3d_bench.core.types import Float32Array
from su3d_bench.datasets.rooms.classes import COLOUR_RGB

Rgb = tuple[float, float, float]  # linear light, 0..1


class Texture(IntEnum):
    """What ``pattern_kernels`` knows how to paint."""

    PLAIN = 0
    WOOD = 1
    WEAVE = 2
    TILES = 3
    SPECKLE = 4
    STRIPES = 5
    CHECKS = 6
    DOTS = 7
    BRUSHED = 8
    PICTURE = 9
    KEYS = 10
    SCREEN = 11
    PLANKS = 12
    WICKER = 13
    LEAF = 14
    CARPET = 15
    SKY = 16
    CLOCK_FACE = 17
    RUG = 18
    MARBLE = 19
    CARDBOARD = 20
    LABEL = 21
    ZIGZAG = 22
    GORES = 23
    WALL = 24


@dataclass(frozen=True)
class Material:
    """How a part looks: ``texture`` paints with colours ``a`` and ``b`` at ``scale`` metres along ``axis``.

    ``extent`` (u0, u1, v0, v1) bounds textures that fill a face (pictures, screens, rugs); ``gloss`` 0..1 is the
    strength of the highlight, ``glow`` the light it sends out itself.
    """

    texture: Texture
    a: Rgb
    b: Rgb
    scale: float = 0.05
    gloss: float = 0.05
    glow: float = 0.0
    axis: int = 0
    extent: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 1.0)
    seed: int = 0

    def row(self) -> Float32Array:
        """The material as the kernel reads it."""
        return np.array(
            [self.texture, *self.a, *self.b, self.scale, self.gloss, self.glow, self.axis, *self.extent, self.seed],
            np.float32,
        )


def linear(rgb: tuple[float, float, float]) -> Rgb:
    """sRGB 0..255 as linear light, by the power 2.2."""
    red, green, blue = ((max(0.0, min(255.0, value)) / 255.0) ** 2.2 for value in rgb)
    return red, green, blue


def shade(rgb: Rgb, factor: float) -> Rgb:
    """A lighter or darker tone of the same hue."""
    return min(1.0, rgb[0] * factor), min(1.0, rgb[1] * factor), min(1.0, rgb[2] * factor)


def mix(first: Rgb, second: Rgb, share: float) -> Rgb:
    red, green, blue = (a + (b - a) * share for a, b in zip(first, second, strict=True))
    return red, green, blue


def tone(name: str, rng: np.random.Generator | None = None) -> Rgb:
    """Linear light of a colour name; with ``rng``, a departure in brightness and hue that keeps the name right."""
    base = COLOUR_RGB[name]
    if rng is None:
        return linear(base)
    brightness = rng.uniform(0.86, 1.14) if name not in ("white", "black") else rng.uniform(0.95, 1.04)
    jitter = rng.uniform(-8, 8, 3) * (0.2 if name in ("white", "black", "grey") else 1.0)
    return linear(
        (base[0] * brightness + jitter[0], base[1] * brightness + jitter[1], base[2] * brightness + jitter[2])
    )


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 4000))


def wood(rgb: Rgb, rng: np.random.Generator, axis: int = 0) -> Material:
    return Material(Texture.WOOD, rgb, shade(rgb, 0.62), scale=rng.uniform(0.02, 0.045), gloss=0.12, axis=axis,
                    seed=_seed(rng))  # fmt: skip


def paint(rgb: Rgb, gloss: float = 0.08) -> Material:
    return Material(Texture.PLAIN, rgb, shade(rgb, 0.9), gloss=gloss)


def plastic(rgb: Rgb) -> Material:
    return Material(Texture.PLAIN, rgb, shade(rgb, 0.95), gloss=0.35)


def metal(rgb: Rgb, rng: np.random.Generator) -> Material:
    return Material(Texture.BRUSHED, rgb, shade(rgb, 0.7), scale=0.01, gloss=0.7, seed=_seed(rng))


def chrome(rng: np.random.Generator) -> Material:
    return metal(linear((178, 180, 184)), rng)


def ceramic(rgb: Rgb) -> Material:
    return Material(Texture.PLAIN, rgb, shade(rgb, 0.93), gloss=0.6)


def glass(rgb: Rgb) -> Material:
    return Material(Texture.PLAIN, rgb, shade(rgb, 0.8), gloss=0.9)


def stone(rgb: Rgb, rng: np.random.Generator) -> Material:
    texture = Texture.SPECKLE if rng.random() < 0.6 else Texture.MARBLE
    return Material(texture, rgb, shade(rgb, 0.55), scale=rng.uniform(0.006, 0.012), gloss=0.3, seed=_seed(rng))


def leather(rgb: Rgb, rng: np.random.Generator) -> Material:
    return Material(Texture.PLAIN, rgb, shade(rgb, 0.7), scale=0.02, gloss=0.3, seed=_seed(rng))


def wicker(rgb: Rgb, rng: np.random.Generator) -> Material:
    return Material(Texture.WICKER, rgb, shade(rgb, 0.35), scale=rng.uniform(0.018, 0.026), seed=_seed(rng))


def paper(rgb: Rgb) -> Material:
    return Material(Texture.PLAIN, rgb, shade(rgb, 0.92), gloss=0.03)


def cloth(rgb: Rgb, rng: np.random.Generator, patterned: bool = True, large: bool = False) -> Material:
    """Fabric in one colour, or with a second tone in stripes, checks, dots or zigzag."""
    second = mix(rgb, (0.85, 0.83, 0.78), 0.75) if sum(rgb) < 1.2 else shade(rgb, 0.45)
    size = rng.uniform(0.05, 0.09) if large else rng.uniform(0.025, 0.05)
    plain = Material(Texture.WEAVE, rgb, shade(rgb, 0.72), scale=0.006, gloss=0.0, seed=_seed(rng))
    if not patterned or rng.random() < 0.45:
        return plain
    pattern = Texture(int(rng.choice([Texture.STRIPES, Texture.CHECKS, Texture.DOTS, Texture.ZIGZAG])))
    return replace(plain, texture=pattern, b=second, scale=size, axis=int(rng.integers(0, 2)))


def plain_cloth(rgb: Rgb, rng: np.random.Generator) -> Material:
    return cloth(rgb, rng, patterned=False)


def light(rgb: tuple[float, float, float], glow: float = 1.0) -> Material:
    """What sends out light of a colour (sRGB 0..255) itself."""
    return Material(Texture.PLAIN, linear(rgb), linear(rgb), glow=glow)


_OF_ONE_LOOK = {"plastic": plastic, "ceramic": ceramic, "glass": glass, "paper": paper}
_DRAWN = {"metal": metal, "fabric": cloth, "leather": leather, "stone": stone, "wicker": wicker}


def of_kind(material: str, rgb: Rgb, rng: np.random.Generator, axis: int = 0) -> Material:
    """The usual look of a material named as in ``MATERIALS``."""
    if material == "wooden":
        return wood(rgb, rng, axis)
    return _OF_ONE_LOOK[material](rgb) if material in _OF_ONE_LOOK else _DRAWN[material](rgb, rng)
