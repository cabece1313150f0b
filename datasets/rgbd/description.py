"""``rgbd.toml``: what a folder of colour, depth and pose files holds, as a strict model with one-line errors."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from su3d_bench.core.config import Setting, Settings, flatten, resolve
from su3d_bench.core.errors import ConfigError, DataError, suggest
from su3d_bench.core.toml import parse_toml
from su3d_bench.core.types import UpAxis
from su3d_bench.formats.text_files import read_text

FILE_NAME = "rgbd.toml"
INDEX = "{index}"
MAX_DESCRIPTION_BYTES = 1 << 14  # some twenty lines are in use; deeply nested keys take quadratic time
MAX_MESSAGE_LENGTH = 480
ASSIGNMENT = re.compile(r"""\s*["']?([\w-]+)["']?\s*=""")
Number = Annotated[float, Field(allow_inf_nan=False)]
DepthValue = Annotated[int, Field(ge=0, le=65535)]


class RgbdDescription(BaseModel):
    """The keys of ``rgbd.toml``; every file but ``folder`` is named relative to ``folder`` and lies inside it.

    - ``folder``: where the data is, relative to the TOML file
    - ``colour``, ``depth``, ``pose``: patterns. With ``{index}`` in all of them, files of one number belong together;
      with ``*`` or ``?`` in all of them, the k-th file of each in numeric order. JPEG, PNG, PPM; PNG, PGM of 16 bits
    - ``pose``: text files of a 4x4 matrix; or ``trajectory``: one file with a pose for every image or, where images are
      missing, for every number from the first to the last. ``trajectory_format``: ``open3d`` (blocks of five lines,
      ``trajectory.log``), ``tum`` (time tx ty tz qx qy qz qw) or ``kitti`` (12 numbers a line) or
      ``matrix`` (16 numbers a line, row by row, as 7-Scenes, NICE-SLAM and many others keep them in one file)
    - ``pose_direction`` and ``camera_axes``: what the matrices map, and whether y points down and z into the scene
      (``opencv``) or y up and z back (``opengl``)
    - ``depth_unit_m``: metres of one unit. ``depth_rotated_bits``: by how many bits stored values are rotated to the
      left; with 3, a value p means ((p >> 3) | (p << 13)) & 0xffff units. ``depth_invalid``: how many units, besides 0,
      mean no depth; 65535 need not be named, it means none wherever it stands apart from all other depths of its image
    - ``intrinsics``: fx, fy, cx, cy in pixels; or ``intrinsics_file``: 3x3 (or 4x4) numbers, or Open3D's camera (JSON)
    - ``up``: the axis of the poses' world that points up, such as ``-y``; poses and mesh are turned until it is z.
      Without it the world stays as it is; where the frames show another axis to point up, that is said
    - ``mesh``: a mesh of the scene in the world of the poses (.ply), for methods that work on one
    - ``frames_per_second``: gives frames their times where the trajectory has none
    - ``check_convention``: off to read poses that the depth images contradict
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    folder: str = Field(default=".", min_length=1)
    colour: str
    depth: str
    pose: str | None = None
    trajectory: str | None = None
    trajectory_format: Literal["open3d", "tum", "kitti", "matrix"] = "open3d"
    pose_direction: Literal["camera_to_world", "world_to_camera"] = "camera_to_world"
    camera_axes: Literal["opencv", "opengl"] = "opencv"
    depth_unit_m: float = Field(ge=1e-7, le=10, allow_inf_nan=False)
    depth_rotated_bits: int = Field(default=0, ge=0, le=15)
    depth_invalid: tuple[DepthValue, ...] = ()
    intrinsics: tuple[Number, Number, Number, Number] | None = None
    intrinsics_file: str | None = None
    up: UpAxis | None = None
    mesh: str | None = None
    frames_per_second: float = Field(default=30.0, gt=0, le=1e4, allow_inf_nan=False)
    check_convention: bool = True

    @field_validator("colour", "depth", "pose")
    @classmethod
    def _check_pattern(cls, pattern: str) -> str:
        if pattern.count(INDEX) > 1 or "**" in pattern or not (INDEX in pattern or "*" in pattern or "?" in pattern):
            raise ValueError("expected a pattern with one {index}, or with * or ?")
        return pattern

    @model_validator(mode="after")
    def _check_pairs(self) -> RgbdDescription:
        for key, other in (("pose", "trajectory"), ("intrinsics", "intrinsics_file")):
            if (getattr(self, key) is None) == (getattr(self, other) is None):
                raise ValueError(f"give '{key}' or '{other}', one of the two")
        patterns = [pattern for pattern in (self.colour, self.depth, self.pose) if pattern is not None]
        if len({INDEX in pattern for pattern in patterns}) > 1:
            raise ValueError("some patterns have {index} and some have not; give it to all of them or to none")
        return self


def read_description(path: Path, where: str) -> RgbdDescription:
    """The description in ``path``; ``where`` begins each message, which is a ``DataError``."""
    where = f"{where}: {path.name}"
    text = read_text(path, where, f"describe the folder in a {FILE_NAME}")
    if len(text) > MAX_DESCRIPTION_BYTES:
        raise DataError(f"{where} has {len(text)} characters; expected a description of a few lines")
    try:
        table = parse_toml(text)
        lines = _lines_of(text)
        _check_keys(table, lines, where)
        leaves = flatten(table)
        settings = Settings(
            tuple(Setting(("rgbd", *leaf), value, f":{lines.get(leaf[0], 1)}") for leaf, value in leaves)
        )
        return resolve(settings, ("rgbd",), RgbdDescription)
    except tomllib.TOMLDecodeError as error:
        raise DataError(_one_line(f"{where}: not valid TOML: {error}")) from error
    except ConfigError as error:
        # A rule on several keys has no line of its own.
        place, of_whole, rule = str(error).partition(" rgbd = '...':")
        raise DataError(_one_line(f"{where}:{rule}" if of_whole else f"{where}{place}")) from error


def _lines_of(text: str) -> dict[str, int]:
    """The line on which each key stands first."""
    line_of: dict[str, int] = {}
    for number, line in enumerate(text.split("\n"), start=1):
        if match := ASSIGNMENT.match(line):
            line_of.setdefault(match[1], number)
    return line_of


def _check_keys(table: dict[str, Any], lines: dict[str, int], where: str) -> None:
    """What is misspelt before what is missing: a misspelt key is both."""
    fields = RgbdDescription.model_fields
    for key in table:
        if key not in fields:
            hint = suggest(key[:40], fields)
            raise DataError(_one_line(f"{where}:{lines.get(key, 1)}: unknown key '{key[:40]}'{hint}"))
    for key, field in fields.items():
        if field.is_required() and key not in table:
            raise DataError(f"{where}: the key '{key}' is missing; needed: colour, depth, depth_unit_m, and more")


def _one_line(message: str) -> str:
    line = "".join(character if character.isprintable() else " " for character in message)
    return line if len(line) <= MAX_MESSAGE_LENGTH else f"{line[:MAX_MESSAGE_LENGTH]}..."
