"""Materials: a procedural texture with its colours, evaluated in object space so that all views agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float32Array

Rgb = tuple[float, float, float]  # linear light, 0..1
_TABLE: Mapping[str, Any] = parse_toml(file_text(Path(__file__).with_name("looks.toml")))
COLOUR_RGB: Mapping[str, tuple[int, int, int]] = {name: tuple(rgb) for name, rgb in _TABLE["colours"].items()}
COLOURS = tuple(COLOUR_RGB)
LOOKS: Mapping[str, Mapping[str, Any]] = _TABLE["looks"]
HOMES_LOOKS: Mapping[str, Mapping[str, Any]] = _TABLE["looks"] | _TABLE["homes_looks"]


def colours_of(words: Sequence[str]) -> tuple[str, ...]:
    """The colours of a list in which the name of a palette means all of its colours."""
    return tuple(colour for word in words for colour in _TABLE["palettes"].get(word, [word]))


# The textures that ``pattern_kernels`` can paint.
Texture = IntEnum(
    "Texture",
    "PLAIN WOOD WEAVE TILES SPECKLE STRIPES CHECKS DOTS BRUSHED PICTURE KEYS SCREEN PLANKS WICKER LEAF CARPET SKY "
    "CLOCK_FACE RUG MARBLE CARDBOARD LABEL ZIGZAG GORES WALL "
    "VIEW PAINTING STAINS FABRIC2 BRICK PARQUET TILES2 POSTER LABEL2 BOOKSPINE",
    start=0,
)


@dataclass(frozen=True)
class Material:
    """The look of a part: ``texture`` paints with colours ``a`` and ``b`` at ``scale`` metres along ``axis``.

    ``extent`` (u0, u1, v0, v1) bounds textures that fill a face (pictures, screens, rugs); ``gloss`` 0..1 is the
    strength of the highlight, ``glow`` the light it emits. ``mirror`` and ``clear`` are the shares of light reflected
    and let through, ``wear`` the strength of variation at 0.6 m, 0.12 m and 0.025 m: ``SampledRenderer`` shows these.
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
    mirror: float = 0.0
    clear: float = 0.0
    wear: float = 0.0

    def row(self) -> Float32Array:
        """The material as the kernel reads it."""
        return np.array(
            [self.texture, *self.a, *self.b, self.scale, self.gloss, self.glow, self.axis, *self.extent, self.seed,
             self.mirror, self.clear, self.wear],
            np.float32,
        )  # fmt: skip


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
    """Linear light of a named colour; ``rng`` varies brightness and hue within what the name allows."""
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


def of_kind(kind: str, rgb: Rgb, rng: np.random.Generator, axis: int = 0) -> Material:
    """The typical look of a kind of material: from ``LOOKS``, or fabric, plain or with a large pattern.

    ``axis`` is the direction of a wood grain.
    """
    if kind.endswith("fabric"):
        return _fabric(kind, rgb, rng)
    look = LOOKS[kind]
    texture = Texture.MARBLE if kind == "stone" and rng.random() >= 0.6 else Texture[look["texture"]]
    rgb = linear(look["colour"]) if "colour" in look else rgb
    scale = look.get("scale", 0.05)
    scale = rng.uniform(*scale) if isinstance(scale, list) else scale
    seed = _seed(rng) if look.get("is_seeded") else 0
    axis = axis if kind == "wooden" else 0
    return Material(texture, rgb, shade(rgb, look["second"]), scale, look.get("gloss", 0.05), axis=axis, seed=seed)


def _fabric(kind: str, rgb: Rgb, rng: np.random.Generator) -> Material:
    """Fabric in one colour, or with a second tone in stripes, checks, dots or zigzag."""
    second = mix(rgb, (0.85, 0.83, 0.78), 0.75) if sum(rgb) < 1.2 else shade(rgb, 0.45)
    size = rng.uniform(0.05, 0.09) if kind == "large fabric" else rng.uniform(0.025, 0.05)
    plain = Material(Texture.WEAVE, rgb, shade(rgb, 0.72), scale=0.006, gloss=0.0, seed=_seed(rng))
    if kind == "plain fabric" or rng.random() < 0.45:
        return plain
    pattern = Texture(int(rng.choice([Texture.STRIPES, Texture.CHECKS, Texture.DOTS, Texture.ZIGZAG])))
    return replace(plain, texture=pattern, b=second, scale=size, axis=int(rng.integers(0, 2)))
