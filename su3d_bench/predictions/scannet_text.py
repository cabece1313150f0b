"""Text predictions of ScanNet's benchmark: lists of masks, as Mask3D and Segment3D export them too, and labels; the
lists of the OpenSUN3D challenge, which have no class; and those of the ScanNet++ benchmark, lists of run-length masks
and the likeliest classes of every vertex.

Class numbers of ScanNet++ are places in the benchmark's list of classes, from 0. Source: semantic/eval of
scannetpp/scannetpp at commit f3b4712.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, counted, printable, reading, shown
from su3d_bench.core.system.files import file_bytes, opened
from su3d_bench.core.types import Int32Array
from su3d_bench.formats.arrays import MOST_POINTS, check_members, integer_lines, run_members
from su3d_bench.metrics.instance.average_precision import last_line_of_each_mask_file
from su3d_bench.predictions.base import SceneFiles, ScenePrediction, VertexLabels, VertexMasks, vertex_masks

OWN_OUTPUT = "semantic_instance_evaluation"  # the original evaluator's own answer, which it leaves out
MASK3D_FOLDER = "decoder_-1"  # Mask3D and Segment3D write the lists of the last decoder here
MASK_OF_RUNS = ".json"  # ScanNet++'s
TOP = 3  # classes a vertex, where a line of ScanNet++ has several: eval_semantic.py takes 1 or the largest of its k
SEPARATOR = ","  # between them
MOST_FIRST_LINE = 4096
MOST_LOOKED_AT = 50


@dataclass(frozen=True)
class Line:
    """One line of a list: the mask file as the line says it and as a path without detours, its class and score."""

    number: int
    file: str
    label: int
    score: float


class TextFiles(SceneFiles):
    """A format of ScanNet's: one text a scene."""

    suffixes = (".txt",)

    def scenes(self, path: Path) -> Mapping[str, Path]:
        return {name: file for name, file in super().scenes(path).items() if name != OWN_OUTPUT}

    def first_lines(self, path: Path) -> list[str]:
        """The first line of some files, empty for empty ones."""
        lines = []
        files = self.scenes(path).values() if path.is_dir() or path.suffix == ".txt" else ()
        for file in list(files)[:MOST_LOOKED_AT]:
            try:
                with opened(file) as stream:
                    lines.append(stream.readline(MOST_FIRST_LINE).decode("utf-8", "replace").rstrip("\r\n"))
            except OSError:
                continue
        return lines


class ScannetText(TextFiles):
    name = "scannet-text"
    summary = "ScanNet's submission: <scene>.txt with lines 'mask file, class id, confidence' (Mask3D, Segment3D)"

    def recognise(self, path: Path) -> str | None:
        lines = self.first_lines(path)
        if not lines:
            return None
        if not any(lines):
            return "its .txt files are empty lists"
        words = list_words(lines)
        is_list = words is not None and not words[0].endswith(MASK_OF_RUNS)
        return "its .txt files list a mask file, a class and a confidence a line" if is_list else None

    def scenes(self, path: Path) -> Mapping[str, Path]:
        return super().scenes(path / MASK3D_FOLDER if (path / MASK3D_FOLDER).is_dir() else path)

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where, lines = shown(place), read_list(place)
        pairs = last_line_of_each_mask_file([line.file for line in lines])
        members, n_points = _read_masks(place.parent, [lines[first] for first, _ in pairs], where)
        masks = vertex_masks(
            where,
            members,
            n_points,
            scores=np.array([lines[last].score for _, last in pairs], np.float64),
            class_numbers=np.array([lines[last].label for _, last in pairs], np.int32),
            keys=[printable(lines[first].file, 200) for first, _ in pairs],
        )
        return ScenePrediction(scene, self.name, place, masks, _remarks(lines, len(pairs)))


class OpenSun3dText(TextFiles):
    name = "opensun3d-challenge"
    summary = "The OpenSUN3D challenge's submission: <scene>.txt with lines 'mask file, confidence', without classes"

    def recognise(self, path: Path) -> str | None:
        words = next((line.split() for line in self.first_lines(path) if line), [])
        is_list = len(words) == 2 and _number(words[0]) is None and _number(words[1]) is not None
        return "its .txt files list a mask file and a confidence a line" if is_list else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        """Every line is a mask, one that names a file again too: the original numbers them anew."""
        where, lines = shown(place), read_list(place, has_classes=False)
        members, n_points = _read_masks(place.parent, lines, where)
        scores = np.array([line.score for line in lines], np.float64)
        keys = [printable(line.file, 200) for line in lines]
        masks = vertex_masks(where, members, n_points, scores=scores, keys=keys)
        return ScenePrediction(scene, self.name, place, masks, ("masks without classes",))


class ScannetSemanticText(TextFiles):
    name = "scannet-semantic-text"
    summary = "ScanNet's semantic submission: <scene>.txt with one class id a line, one line a point"

    def recognise(self, path: Path) -> str | None:
        words = next((line.split() for line in self.first_lines(path) if line), [])
        is_label = len(words) == 1 and words[0].removeprefix("-").isdigit()
        return "its .txt files hold one integer a line" if is_label else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place)
        values = integer_lines(_content(place, where), where)
        if not len(values):
            raise PredictionError(f"{where}: is empty; expected one class id a line, one line a point")
        limits = np.iinfo(np.int32)
        is_wrong = (values < limits.min) | (values > limits.max)
        if is_wrong.any():
            line = int(np.argmax(is_wrong))
            raise PredictionError(f"{where}:{line + 1}: {int(values[line])} is no class id")
        return ScenePrediction(scene, self.name, place, VertexLabels(values.astype(np.int32)))


class ScannetppMasks(ScannetText):
    name = "scannetpp"
    summary = "ScanNet++'s instance submission: <scene>.txt with lines 'mask.json, class, confidence', run-length masks"

    def recognise(self, path: Path) -> str | None:
        words = list_words(self.first_lines(path))
        is_list = words is not None and words[0].endswith(MASK_OF_RUNS)
        return "its .txt files list a .json mask, a class and a confidence a line" if is_list else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        found = super().read_scene(place, scene)
        assert isinstance(found.content, VertexMasks)
        return replace(found, content=replace(found.content, numbering="line"))


class ScannetppLabels(TextFiles):
    name = "scannetpp-semantic"
    summary = "ScanNet++'s semantic submission: <scene>.txt with one class a line, or three with commas between"

    def recognise(self, path: Path) -> str | None:
        words = next((line.split(SEPARATOR) for line in self.first_lines(path) if line), [])
        is_ranked = len(words) > 1 and all(word.strip().isdigit() for word in words)
        return "its .txt files hold integers with commas between" if is_ranked else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place)
        numbers = _ranked_numbers(_content(place, where), where)
        further = numbers[:, 1:] if numbers.shape[1] > 1 else None
        return ScenePrediction(scene, self.name, place, VertexLabels(numbers[:, 0], further, "line"))


def _ranked_numbers(content: bytes, where: str) -> Int32Array:
    """The class numbers (N, 1) or (N, 3) of the vertices, the likeliest first."""
    if (n_lines := content.count(b"\n")) > MOST_POINTS:
        raise PredictionError(f"{where}: has {n_lines} lines; is it damaged?")
    rows = [line.split(SEPARATOR.encode()) for line in content.splitlines()]
    if not rows:
        raise PredictionError(f"{where}: is empty; expected one or three classes a line, one line a vertex")
    width = len(rows[0])
    for number, row in enumerate(rows, 1):
        if len(row) != width or width not in (1, TOP):
            raise PredictionError(
                f"{where}:{number}: has {counted(len(row), 'class')}; expected one in every line, or {TOP} in each"
            )
    columns = [integer_lines(b"\n".join(row[rank] for row in rows) + b"\n", where) for rank in range(width)]
    numbers = np.column_stack(columns)
    is_wrong = ((numbers < 0) | (numbers > np.iinfo(np.int32).max)).any(axis=1)
    if is_wrong.any():
        line = int(np.argmax(is_wrong))
        shown_row = SEPARATOR.join(map(str, numbers[line].tolist()))
        raise PredictionError(f"{where}:{line + 1}: {shown_row} is no place in a list of classes; they count from 0")
    return numbers.astype(np.int32)


def list_words(lines: Sequence[str]) -> list[str] | None:
    """Mask file, class and confidence of the first of ``lines`` that is not empty; None where it is no such line."""
    words = next((line.split(" ") for line in lines if line), [])
    is_list = len(words) == 3 and _number(words[1]) is not None and _number(words[2]) is not None
    return words if is_list else None


def read_list(file: Path, *, has_classes: bool = True) -> list[Line]:
    """The lines of a list of masks, each as the official script takes it: three fields with single spaces between.

    Without classes, as OpenSUN3D's script takes them through numpy: two fields, blanks between, no empty lines and
    nothing behind a #; the class is then 0.
    """
    where, lines = shown(file), []
    form = "mask file, class id, confidence' with single spaces between" if has_classes else "mask file, confidence'"
    for number, raw in enumerate(_content(file, where).splitlines(), 1):
        text = raw.decode("utf-8", "replace")
        words = text.split(" ") if has_classes else text.partition("#")[0].split()
        if not words:
            continue
        if len(words) != 2 + has_classes:
            raise PredictionError(
                f"{where}:{number}: {len(words)} fields in '{printable(text, 120)}'; expected '{form}"
            )
        label, score = _number(words[1]) if has_classes else 0, _number(words[-1])
        if label is None or not -(1 << 31) < label < 1 << 31:
            raise PredictionError(f"{where}:{number}: '{printable(words[1], 60)}' is no class id")
        if score is None:
            raise PredictionError(f"{where}:{number}: confidence '{printable(words[-1], 60)}' is no finite number")
        lines.append(Line(number, _plain_path(words[0], f"{where}:{number}"), int(label), score))
    return lines


def _plain_path(text: str, where: str) -> str:
    """A path inside the folder, without detours, from what a line says."""
    plain = os.path.normpath(text) if text and "\0" not in text and "\ufffd" not in text else ""
    if not plain or plain == "." or os.path.isabs(plain) or plain.split(os.sep)[0] == "..":
        raise PredictionError(
            f"{where}: '{printable(text, 120)}' is no path inside the folder of the list; mask files must be in it"
        )
    return plain


def _read_masks(folder: Path, lines: Sequence[Line], where: str) -> tuple[list[Int32Array], int | None]:
    """The points in the mask of each line, and of how many points all are; None without any."""
    members: list[Int32Array] = []
    n_members, n_points, places = 0, None, _Places(folder)
    for line in lines:
        n, indices = _read_mask(places, line, where)
        if n_points not in {None, n}:
            raise PredictionError(
                f"{where}:{line.number}: mask '{printable(line.file, 120)}' is of {n} points and "
                f"'{printable(lines[0].file, 120)}' of {n_points}; all must have the points of the scene"
            )
        n_points = n
        check_members(n_members := n_members + len(indices), where)
        members.append(indices)
    return members, n_points


class _Places:
    """Where the mask files of a list lie in truth; a folder of many is followed to its own place once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._root = folder.resolve()
        self._real: dict[str, Path] = {}

    def is_inside(self, file: str) -> bool:
        """Whether a regular file inside the folder stands behind ``file``; ``OSError`` where there is none at all."""
        parent, name = os.path.split(file)
        if parent not in self._real:
            self._real[parent] = (self.folder / parent).resolve(strict=True)
        target = self._real[parent] / name
        mode = os.lstat(target).st_mode
        if stat.S_ISLNK(mode):
            target = target.resolve(strict=True)
            mode = os.lstat(target).st_mode
        return stat.S_ISREG(mode) and target.is_relative_to(self._root)


def _read_mask(places: _Places, line: Line, where: str) -> tuple[int, Int32Array]:
    """The number of points of a mask and those in it."""
    file = places.folder / line.file
    place = f"{where}:{line.number}: mask '{printable(line.file, 120)}'"
    try:
        is_inside = places.is_inside(line.file)
    except (OSError, RuntimeError) as error:
        reason = "does not exist" if isinstance(error, FileNotFoundError) else "cannot be read"
        raise PredictionError(f"{place} {reason}") from error
    if not is_inside:
        raise PredictionError(f"{place} is no file inside the folder of the list; copy it there")
    content = _content(file, place)
    if file.suffix == MASK_OF_RUNS:
        return _run_length_mask(content, place)
    values = integer_lines(content, place)
    return len(values), np.flatnonzero(values != 0).astype(np.int32)  # of booleans they are found at once


def _run_length_mask(content: bytes, where: str) -> tuple[int, Int32Array]:
    """A mask of ScanNet++: JSON with ``length`` and ``counts``, a text of pairs."""
    try:
        value = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise PredictionError(f"{where} is not readable as JSON") from error
    if not isinstance(value, dict) or "length" not in value or "counts" not in value:
        raise PredictionError(f"{where} has no 'length' and 'counts'")
    members = run_members(value["length"], value["counts"], where)
    return value["length"], members


def _remarks(lines: list[Line], n_files: int) -> tuple[str, ...]:
    n_more = len(lines) - n_files
    if not n_more:
        return ()
    return (
        f"{n_more} lines name a mask file again: class and confidence of its last line count, at the place of its "
        "first, as in the official evaluator",
    )


def _number(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _content(file: Path, where: str) -> bytes:
    with reading(where):
        return file_bytes(file)
