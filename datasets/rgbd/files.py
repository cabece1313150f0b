"""``rgbd.toml`` and the files it names: how files pair up, and their poses and intrinsics."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from su3d_bench.core.config import Setting, Settings, flatten, key_lines, resolve
from su3d_bench.core.errors import ConfigError, DataError, suggest
from su3d_bench.core.geometry import are_rigid, turn_to_z
from su3d_bench.core.system.files import parse_toml
from su3d_bench.core.types import Float64Array, UpAxis
from su3d_bench.datasets.recordings.recorded_frames import Folder, numbers, pinhole, square
from su3d_bench.datasets.tum.dataset import quaternion_poses, rows_of, seconds, unit_quaternion
from su3d_bench.formats.arrays import parsed_json, read_text

FILE_NAME = "rgbd.toml"
INDEX = "{index}"
MAX_DESCRIPTION_BYTES = 1 << 14  # about twenty lines suffice; deeply nested keys take quadratic time
Number = Annotated[float, Field(allow_inf_nan=False)]
DepthValue = Annotated[int, Field(ge=0, le=65535)]


class RgbdDescription(BaseModel):
    """The keys of ``rgbd.toml``; all files except ``folder`` are relative to ``folder`` and inside it.

    - ``folder``: location of the data, relative to the TOML file
    - ``colour``, ``depth``, ``pose``: patterns. With ``{index}`` in all of them, files with the same number pair up;
      with ``*`` or ``?`` in all of them, files pair up in numeric order. JPEG, PNG, PPM; PNG, PGM of 16 bits
    - ``pose``: text files of a 4x4 matrix; or ``trajectory``: one file with a pose per image or, if images are
      missing, for every number from the first to the last. ``trajectory_format``: ``open3d`` (blocks of five lines,
      ``trajectory.log``), ``tum`` (time tx ty tz qx qy qz qw, or without time) or ``kitti`` (12 numbers per line) or
      ``matrix`` (16 numbers per line, row by row, as 7-Scenes, NICE-SLAM and many others keep them in one file)
    - ``pose_direction`` and ``camera_axes``: what the matrices map, and whether y points down and z into the scene
      (``opencv``) or y up and z back (``opengl``)
    - ``depth_unit_m``: metres of one unit. ``depth_rotated_bits``: by how many bits stored values are rotated to the
      left; with 3, a value p is ((p >> 3) | (p << 13)) & 0xffff units. ``depth_invalid``: values that, besides 0,
      mean no depth; 65535 is not needed, it means none if it is far from all other depths of its image
    - ``intrinsics``: fx, fy, cx, cy in pixels; or ``intrinsics_file``: 3x3 (or 4x4) numbers, or Open3D's camera (JSON).
      A negative fy (ICL-NUIM) means that y points up in the camera, in a left-handed world: y of both is negated
    - ``up``: the axis of the poses' world that points up, such as ``-y``; poses and mesh are rotated so that it is z.
      Without it the world is unchanged, with a warning if the frames show another axis to point up
    - ``mesh``: a mesh of the scene in the world of the poses (.ply), for methods that need one
    - ``frames_per_second``: gives the frame times if the trajectory has none
    - ``check_convention``: false to read poses that contradict the depth images
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
                raise ValueError(f"give either '{key}' or '{other}'")
        patterns = [pattern for pattern in (self.colour, self.depth, self.pose) if pattern is not None]
        if len({INDEX in pattern for pattern in patterns}) > 1:
            raise ValueError("some patterns have {index} and some do not; use it in all or none")
        return self


def read_description(path: Path, where: str) -> RgbdDescription:
    """The description in ``path``; ``where`` begins each message, which is a ``DataError``."""
    where = f"{where}: {path.name}"
    text = read_text(path, where, f"describe the folder in a {FILE_NAME}")
    if len(text) > MAX_DESCRIPTION_BYTES:
        raise DataError(f"{where} has {len(text)} characters; expected a description of a few lines")
    try:
        table = parse_toml(text)
        lines = {key[0]: line for key, line in reversed(key_lines(text).items())}
        _check_keys(table, lines, where)
        leaves = flatten(table)
        settings = Settings(
            tuple(Setting(("rgbd", *leaf), value, f":{lines.get(leaf[0], 1)}") for leaf, value in leaves)
        )
        return resolve(settings, ("rgbd",), RgbdDescription)
    except tomllib.TOMLDecodeError as error:
        raise DataError(f"{where}: not valid TOML: {error}") from error
    except ConfigError as error:
        # A rule on several keys has no line number.
        place, of_whole, rule = str(error).partition(" rgbd = '...':")
        raise DataError(f"{where}:{rule}" if of_whole else f"{where}{place}") from error


def _check_keys(table: dict[str, Any], lines: dict[str, int], where: str) -> None:
    """Misspelt keys first, then missing ones, because a misspelt key is also missing."""
    fields = RgbdDescription.model_fields
    for key in table:
        if key not in fields:
            hint = suggest(key[:40], fields)
            raise DataError(f"{where}:{lines.get(key, 1)}: unknown key '{key[:40]}'{hint}")
    for key, field in fields.items():
        if field.is_required() and key not in table:
            raise DataError(f"{where}: the key '{key}' is missing; needed: colour, depth, depth_unit_m, and more")


MAX_NUMBER = 2**31 - 1  # maps store frame numbers in 32 bits; time stamps in names do not fit
MAX_DISTANCE_M = 1e6  # of a camera from the origin
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
MATRIX_ROWS = {"kitti": (3, "the upper rows of a 4x4 matrix"), "matrix": (4, "a 4x4 matrix row by row")}
FORMS_OF_WORDS = {8: "tum", 12: "kitti", 16: "matrix"}  # numbers per line
HEADER = re.compile(r"[#%/\s]*[A-Za-z_](?!(?i:nf|an)\b)")  # a word, which is neither inf nor nan
DIRECTION = re.compile(r"(world|w|cam(?:era)?|c)[\W_]*(?:2|to)[\W_]*(?:world|w|cam(?:era)?|c)", re.IGNORECASE)
Pose = Float64Array | None  # None: tracking was lost, the matrix has non-finite values


def files_of(folder: Folder, pattern: str, where: str) -> dict[int, str]:
    """Number -> name below the folder, ascending: the value of ``{index}``, or the position in numeric order."""
    directory, _, name_pattern = pattern.rpartition("/")
    if any(character in directory for character in "*?{}"):
        raise DataError(f"{where}: {pattern!r}: use *, ? and {INDEX} only in the file name, not in its folder")
    parent = folder.file(directory, where) if directory else folder.path
    try:
        names = [child.name for child in parent.iterdir()]
    except OSError as error:
        raise DataError(f"{where}: {pattern[:80]!r}: {parent.name}/ cannot be read: {error.strerror}") from error
    prefix = f"{directory}/" if directory else ""
    if INDEX in name_pattern:
        name_of = _numbered(names, name_pattern, where)
    else:
        matching = sorted((name for name in names if fnmatchcase(name, name_pattern)), key=_numeric_order)
        name_of = dict(enumerate(matching))
    if not name_of:
        raise DataError(f"{where}: no file matches {pattern[:80]!r}")
    return {number: _checked(folder, prefix + name_of[number], where) for number in sorted(name_of)}


def _checked(folder: Folder, name: str, where: str) -> str:
    folder.file(name, where)
    return name


def _numbered(names: Sequence[str], pattern: str, where: str) -> dict[int, str]:
    before, _, behind = pattern.partition(INDEX)
    form = re.compile(re.escape(before) + r"(\d{1,18})" + re.escape(behind), re.ASCII)
    name_of: dict[int, str] = {}
    for name in sorted(names):
        if match := form.fullmatch(name):
            number = int(match[1])
            if number > MAX_NUMBER:
                raise DataError(f"{where}: {name[:60]}: the number is above {MAX_NUMBER}; use * in the pattern instead")
            if number in name_of:
                raise DataError(
                    f"{where}: {name_of[number][:60]} and {name[:60]} have the same number; expected one file each"
                )
            name_of[number] = name
    return name_of


def _numeric_order(name: str) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"[0-9]{1,18}", name)], name


def read_trajectory_file(path: Path, form: str, where: str) -> tuple[Float64Array, list[float] | None]:
    """The matrix of each pose (n, 4, 4), and the times in seconds if the file has them."""
    if form == "open3d":
        return np.array(_open3d_log(read_text(path, where).split("\n"), where)).reshape(-1, 4, 4), None
    if form in MATRIX_ROWS:
        n_rows, whose = MATRIX_ROWS[form]
        rows = rows_of(path, where, 4 * n_rows, f"{4 * n_rows} numbers, {whose}")
        upper = np.array([numbers(words, f"{where} line {n}") for n, words in rows]).reshape(-1, n_rows, 4)
        lower = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 4 - n_rows, 1)).reshape(len(rows), 4 - n_rows, 4)
        return np.concatenate([upper, lower], axis=1), None
    values, times_s = [], []
    for n, words in rows_of(path, where, 8, "'time tx ty tz qx qy qz qw', or the last seven", 1):
        row = numbers(words[-7:], f"{where} line {n}")
        times_s += [seconds(word, f"{where} line {n}") for word in words[:-7]]
        values.append([*row[:3], *unit_quaternion(row[3:], f"{where} line {n}")])
    table = np.array(values)
    return quaternion_poses(table[:, :3], table[:, 3:]), times_s or None


def _open3d_log(lines: list[str], where: str) -> list[list[float]]:
    """Blocks of a line of three integers and four lines of a matrix, as Open3D writes ``.log`` files."""
    while lines and not lines[-1].strip():
        lines.pop()
    if lines and (form := FORMS_OF_WORDS.get(len(lines[0].split()))):
        n = len(lines[0].split())
        raise DataError(f'{where} line 1: has {n} values; expected three integers, or set trajectory_format = "{form}"')
    if not lines or len(lines) % 5:
        raise DataError(f"{where} has {len(lines)} lines; expected blocks of five, three integers and a 4x4 matrix")
    matrices = []
    for start in range(0, len(lines), 5):
        if not re.fullmatch(r"\s*-?[0-9]{1,18}(\s+-?[0-9]{1,18}){2}\s*", lines[start]):
            raise DataError(f"{where} line {start + 1}: {lines[start][:40]!r}; expected three integers")
        matrix: list[float] = []
        for line in range(start + 1, start + 5):
            row = numbers(lines[line].split(), f"{where} line {line + 1}")
            if len(row) != 4:
                raise DataError(f"{where} line {line + 1} has {len(row)} values; expected 4, a row of a 4x4 matrix")
            matrix += row
        matrices.append(matrix)
    return matrices


def read_pose(folder: Path, name: str, where: str) -> tuple[Float64Array, str]:
    """The matrix (4, 4) in a text file, and the header line that some programs write before it (or empty)."""
    where = f"{where}: {name}"
    text = read_text(folder / name, where)
    first, _, rest = text.lstrip().partition("\n")
    is_header = HEADER.match(first) is not None and not rest.isspace() and rest != ""
    return square((rest if is_header else text).split(), where), first.strip() if is_header else ""


def direction_in(header: str) -> str | None:
    """What a matrix maps according to a header; None if the header does not state it."""
    found = DIRECTION.search(header)
    if found is None:
        return None
    return "world_to_camera" if found[1].lower().startswith("w") else "camera_to_world"


def camera_to_world(matrix: Float64Array, description: RgbdDescription, where: str, *, is_mirrored: bool) -> Pose:
    """The pose with OpenCV axes in a z-up world, from a matrix (4, 4) in the convention of the description.

    ``is_mirrored``: y of camera and world is negated, as in a left-handed world.
    """
    if not np.isfinite(matrix).all():
        return None
    if np.abs(matrix[:3, 3]).max() > MAX_DISTANCE_M or not are_rigid(matrix[None])[0]:
        raise DataError(f"{where}: not a rigid motion in metres; expected a rotation, a translation and 0 0 0 1")
    if description.pose_direction == "world_to_camera":
        matrix = np.asarray(np.linalg.inv(matrix), np.float64)
    if description.camera_axes == "opengl":
        matrix = matrix @ OPENGL_TO_OPENCV
    if is_mirrored:
        matrix = MIRROR_Y @ matrix @ MIRROR_Y
    if description.up is None:
        return matrix
    turned = matrix.copy()
    turned[:3] = turn_to_z(description.up) @ matrix[:3]
    return turned


def signed_pinhole(values: tuple[float, float, float, float], where: str) -> Float64Array:
    """Intrinsics (3, 3) of fx, fy, cx, cy, of which fy may be negative."""
    fx, fy, cx, cy = values
    matrix = pinhole(fx, abs(fy), cx, cy, where)
    matrix[1, 1] = fy
    return matrix


def read_intrinsics(path: Path, where: str) -> tuple[Float64Array, tuple[int, int] | None]:
    """Intrinsics (3, 3), and the image size if the file states it: Open3D's JSON does, a text matrix does not."""
    text = read_text(path, where)
    if path.suffix == ".json":
        return _open3d_camera(text, where)
    return _pinhole_matrix(square(text.split(), where, (3, 4))[:3, :3], where), None


def _open3d_camera(text: str, where: str) -> tuple[Float64Array, tuple[int, int]]:
    content = parsed_json(text, where)
    if isinstance(content, dict) and isinstance(content.get("intrinsic"), dict):
        content = content["intrinsic"]  # of Open3D's PinholeCameraParameters
    values = content.get("intrinsic_matrix") if isinstance(content, dict) else None
    if not (isinstance(values, list) and len(values) == 9 and all(map(_is_number, values))):
        raise DataError(f"{where}: 'intrinsic_matrix' is not a list of 9 numbers, column by column, as in Open3D")
    size = content.get("width"), content.get("height")
    if not all(isinstance(side, int) and not isinstance(side, bool) and 0 < side < 100_000 for side in size):
        raise DataError(f"{where}: width and height are {str(size)[:60]}; expected whole pixels")
    return _pinhole_matrix(np.array(values, np.float64).reshape(3, 3).T, where), size


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < MAX_DISTANCE_M


def _pinhole_matrix(matrix: Float64Array, where: str) -> Float64Array:
    """The matrix, if it is a skew-free pinhole camera's."""
    (fx, skew, cx), (below, fy, cy) = matrix[:2]
    if max(abs(skew), abs(below)) > 1e-6 * max(abs(fx), 1) or not np.array_equal(matrix[2], (0, 0, 1)):
        raise DataError(f"{where}: not a pinhole camera; expected fx 0 cx, 0 fy cy, 0 0 1")
    return signed_pinhole((float(fx), float(fy), float(cx), float(cy)), where)
