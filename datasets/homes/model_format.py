"""How a model of an object is described in ``models/*.toml``, and checked on load.

A model is a list of parts in metres: x to the right, y away from the viewer, z up; its front is towards -y. The
catalogue centres it over the origin and puts it on the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.datasets.procedural.materials import COLOURS, HOMES_LOOKS, colours_of

Number = Annotated[float, Field(ge=-5, le=5, allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Point = tuple[Number, Number, Number]
Range = tuple[Number, Number]
Axis = Literal["x", "y", "z"]
FABRICS = ("fabric", "plain fabric", "large fabric")
KINDS = (*FABRICS, *HOMES_LOOKS)
SHAPES = ("block", "revolve", "extrude", "tube", "ellipsoid", "cushion", "cloth", "leaf", "loft")


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Repeat(Strict):
    """Copies of a part: ``n`` of them, each ``step`` further, or spread around the z axis over ``ring`` degrees.

    ``n`` may be a range, from which each instance draws. ``jitter`` turns each copy about z by up to that many degrees.
    """

    n: int | tuple[int, int]
    step: Point = (0, 0, 0)
    ring: float = 0.0
    jitter: float = 0.0

    @model_validator(mode="after")
    def _is_small(self) -> Repeat:
        fewest, most = (self.n, self.n) if isinstance(self.n, int) else self.n
        if not 1 <= fewest <= most <= 64:
            raise ValueError("n is 1 to 64, or a range [low, high] within")
        return self


class Ajar(Strict):
    """A door or drawer: with ``chance`` opened, turned about ``axis`` through ``hinge`` or moved along ``slide``.

    The opening is a random share of ``degrees`` or of ``slide``. Parts whose ``ajar`` is equal open together; ``name``
    keeps those apart that differ in nothing else.
    """

    name: str = ""
    chance: Share = 0.3
    axis: Axis = "z"
    hinge: Point = (0, 0, 0)
    degrees: float = 0.0
    slide: Point = (0, 0, 0)


class PartRow(Strict):
    """One part: exactly one shape, then where it is and what it is made of.

    Shapes: ``block`` [width, depth, height] standing on ``at``, with ``round`` edges; ``revolve`` [[radius, z], ...]
    about z, from the axis at the bottom up the outside; ``extrude`` [[x, z], ...], an outline seen from the front,
    ``length`` deep and centred on ``at`` (``along`` "x": [y, z]; "z": [x, y], standing on ``at``); ``tube``
    [[x, y, z], ...] of a ``radius``; ``ellipsoid`` [rx, ry, rz], standing on ``at``; ``cushion`` [width, height,
    thickness] upright; ``cloth`` [width, height], hanging with ``folds`` waves of a ``depth``, its lower edge at
    ``at``; ``leaf`` [length, width, droop] growing from ``at`` along y, rising; ``loft`` [[z, x, y, rx, ry], ...], a
    skin over oval sections, the more rectangular the larger ``power``.

    Then, in this order: ``taper`` scales x and y at the top, ``scale`` [x, y, z] all of it (a revolve becomes oval),
    ``turn`` [[axis, degrees], ...] about the origin, ``at`` moves, ``mirror`` adds copies on the other side ("x", "y"
    or "xy" for four), ``repeat`` copies.
    ``of``: a slot of the model, "main", or a material with a colour such as "plastic black"; "main*0.7" is darker.
    ``only``: the variants of the model that have it. ``chance``: of being there at all.
    """

    block: tuple[Length, Length, Length] | None = None
    revolve: tuple[tuple[Annotated[float, Field(ge=0, le=3)], Number], ...] | None = None
    extrude: tuple[tuple[Number, Number], ...] | None = None
    tube: tuple[Point, ...] | None = None
    ellipsoid: tuple[Length, Length, Length] | None = None
    cushion: tuple[Length, Length, Length] | None = None
    cloth: tuple[Length, Length] | None = None
    leaf: tuple[Length, Length, float] | None = None
    loft: tuple[tuple[Number, Number, Number, Share, Share], ...] | None = None
    power: float = Field(default=2.0, ge=1, le=12)
    round: float = Field(default=0.0, ge=0, le=0.5)
    sides: int | None = Field(default=None, ge=3, le=48)
    length: Length = 0.02
    along: Axis = "y"
    radius: Length = 0.01
    folds: float = Field(default=3.0, ge=0, le=40)
    depth: Length = 0.03
    taper: float = Field(default=1.0, ge=0.05, le=4)
    scale: tuple[Length, Length, Length] = (1, 1, 1)
    turn: tuple[tuple[Axis, float], ...] = ()
    at: Point = (0, 0, 0)
    mirror: Literal["", "x", "y", "xy"] = ""
    repeat: Repeat | None = None
    of: str = "main"
    grain: Axis = "x"
    ajar: Ajar | None = None
    only: tuple[str, ...] = ()
    chance: Share = 1.0

    @model_validator(mode="after")
    def _has_one_shape(self) -> PartRow:
        named = [shape for shape in SHAPES if getattr(self, shape) is not None]
        if len(named) != 1:
            raise ValueError(f"a part has exactly one of {', '.join(SHAPES)}; found {', '.join(named) or 'none'}")
        points = {"revolve": self.revolve, "extrude": self.extrude, "tube": self.tube, "loft": self.loft}.get(named[0])
        if points is not None and not (3 if named[0] == "extrude" else 2) <= len(points) <= 64:
            raise ValueError(f"{named[0]} has too few or too many points")
        return self


class SpotRow(Strict):
    """A level rectangle that can hold things up to ``clearance`` metres tall."""

    x: Range
    y: Range
    z: Number
    clearance: Length = 5.0
    role: Literal["top", "board", "seat", "head", "inside", "burner"] = "top"
    only: tuple[str, ...] = ()


class LampRow(Strict):
    """Light that the object emits: at a position, linear ``power``, from a soft source of ``radius`` m."""

    at: Point
    power: Annotated[float, Field(gt=0, le=4)]
    radius: Length = 0.08
    warmth: Share = 0.5


class ModelRow(Strict):
    """One model. ``made_of`` and ``colours`` (or palettes) are those of the main material, drawn per instance.

    ``slots``: further materials by name, each a string "material colour" with a colour, a palette, or "main" for the
    main colour. ``vary``: an instance is up to that share larger or smaller; ``stretch``: the same for each axis apart.
    ``called``: the everyday name if it differs from that of the class.
    """

    name: str = Field(pattern=r"[a-z][a-z0-9_]{1,40}")
    of_class: str = Field(alias="class")
    made_of: tuple[str, ...] = Field(min_length=1)
    colours: tuple[str, ...] = Field(min_length=1)
    slots: dict[str, str] = {}
    variants: tuple[str, ...] = ()
    vary: float = Field(default=0.1, ge=0, le=0.4)
    stretch: float = Field(default=0.05, ge=0, le=0.4)
    called: str = ""
    parts: tuple[PartRow, ...] = Field(min_length=1, max_length=60)
    spots: tuple[SpotRow, ...] = ()
    lamps: tuple[LampRow, ...] = ()

    @model_validator(mode="after")
    def _names_known_things(self) -> ModelRow:
        for kind in self.made_of:
            _check_kind(kind)
        _check_colours(self.colours)
        for words in self.slots.values():
            check_material(words)
        for part in self.parts:
            slot = part.of.partition("*")[0]
            if slot != "main" and slot not in self.slots:
                check_material(slot)
        for only in [part.only for part in self.parts] + [spot.only for spot in self.spots]:
            if unknown := [name for name in only if name not in self.variants]:
                raise ValueError(f"'only' names an unknown variant: {unknown[0]}")
        return self


def split_material(words: str) -> tuple[str, tuple[str, ...]]:
    """Kind and colour words of a string such as "plain fabric muted" or "chrome"."""
    kinds = [kind for kind in KINDS if words == kind or words.startswith(f"{kind} ")]
    if not kinds:
        raise ValueError(f"'{words}' does not begin with a material: {', '.join(KINDS)}")
    kind = max(kinds, key=len)
    return kind, tuple(words[len(kind) :].split())


def check_material(words: str) -> None:
    kind, colours = split_material(words)
    if colours != ("main",):
        if not colours and "colour" not in HOMES_LOOKS.get(kind, {}):
            raise ValueError(f"'{words}' needs a colour")
        _check_colours(colours)


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise ValueError(f"unknown material '{kind}'; known: {', '.join(KINDS)}")


def _check_colours(words: Sequence[str]) -> None:
    if unknown := [colour for colour in colours_of(words) if colour not in COLOURS]:
        raise ValueError(f"unknown colour '{unknown[0]}'; known: {', '.join(COLOURS)}")


def read_models(path: Path) -> tuple[ModelRow, ...]:
    """The models of a file; a ``DataError`` names the model and the field that is wrong."""
    rows = []
    for row in parse_toml(file_text(path)).get("model", []):
        try:
            rows.append(ModelRow.model_validate(row))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(step) for step in first["loc"])
            raise DataError(f"{path.name}: model '{row.get('name', '?')}': {place}: {first['msg']}") from error
    return tuple(rows)
