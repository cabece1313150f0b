"""Text predictions of ScanNet's benchmark: lists of masks, also exported by Mask3D and Segment3D, and labels; the
lists of the OpenSUN3D challenge, without classes; and those of the ScanNet++ benchmark, lists of run-length masks
and the most likely classes of every vertex.

Class numbers of ScanNet++ are indices into the benchmark's list of classes. Source: semantic/eval of
scannetpp/scannetpp at commit f3b4712.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
from codecs import BOM_UTF8
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from su3d_bench.core.errors import PredictionError, counted, printable, reading, shown
from su3d_bench.core.system.files import file_bytes, opened
from su3d_bench.core.types import Int32Array
from su3d_bench.formats.arrays import MAX_POINTS, check_members, integer_lines, run_members
from su3d_bench.metrics.instance.average_precision import last_line_of_each_mask_file
from su3d_bench.predictions.base import Numbering, Parse, Parsed, Reader, VertexLabels, scene_files, vertex_masks

EVALUATOR_OUTPUT = "semantic_instance_evaluation"  # the original evaluator's own output, which it ignores
MASK3D_FOLDER = "decoder_-1"  # Mask3D and Segment3D write the lists of the last decoder here
MASK_OF_RUNS = ".json"  # ScanNet++'s
TOP = 3  # classes per vertex if a line of ScanNet++ has several: eval_semantic.py accepts 1 or the largest of its k
SEPARATOR = ","  # between them
LIST_FORM = "'mask file, class id, confidence' separated by single spaces"
MAX_FIRST_LINE = 4096
MAX_INSPECTED = 50


class Line(NamedTuple):
    """One line of a list: the mask file as written and as a normalized path, its class and score."""

    number: int
    file: str
    label: int
    score: float


def text_format(name: str, looks: Callable[[str], str | None], parse: Parse) -> Reader:
    """A format with one text file per scene; ``looks`` states why the first non-empty line is of this format."""

    def recognise(path: Path) -> str | None:
        found = first_line(path)
        return None if found is None else looks(found[1])

    return Reader(name, recognise, _scenes, parse)


def _scenes(path: Path) -> Mapping[str, Path]:
    folder = path / MASK3D_FOLDER if (path / MASK3D_FOLDER).is_dir() else path
    return {name: file for name, file in scene_files(folder, (".txt",)).items() if name != EVALUATOR_OUTPUT}


def first_line(path: Path) -> tuple[Path, str] | None:
    """The first file whose first line is not empty, and this line, which is empty if all are; None without files."""
    files = _scenes(path).values() if path.is_dir() or path.suffix == ".txt" else ()
    lines = []
    for file in list(files)[:MAX_INSPECTED]:
        with suppress(OSError), opened(file) as stream:
            line = stream.readline(MAX_FIRST_LINE).decode("utf-8-sig", "replace")
            lines.append((file, line.rstrip("\r\n")))
    return next((pair for pair in lines if pair[1]), lines[0] if lines else None)


# ---- masks


def looks_like_list(line: str) -> str | None:
    if not line:
        return "its .txt files are empty lists"
    is_list = _is_list(line) and not _fields(line)[0].endswith(MASK_OF_RUNS)
    return "its .txt files list a mask file, a class and a confidence per line" if is_list else None


def looks_like_scannetpp(line: str) -> str | None:
    is_list = _is_list(line) and _fields(line)[0].endswith(MASK_OF_RUNS)
    return "its .txt files list a .json mask, a class and a confidence per line" if is_list else None


def looks_like_opensun3d(line: str) -> str | None:
    return "its .txt files list a mask file and a confidence per line" if _is_list(line, n_numbers=1) else None


def _is_list(line: str, n_numbers: int = 2) -> bool:
    """Whether a line is meant to be a mask file, a class and a confidence, even if ``read_list`` rejects it."""
    file, *numbers = _fields(line)
    is_file = _number(file) is None or (n_numbers == 2 and SEPARATOR not in line)
    return is_file and len(numbers) == n_numbers and all(map(_is_number, numbers))


def _fields(line: str) -> list[str]:
    return re.split(r"[\s,;]+", line.strip())


def scannet_masks(place: Path, scene: str, numbering: Numbering = "id") -> Parsed:
    lines = read_list(place)
    pairs = last_line_of_each_mask_file([line.file for line in lines])
    entries = [lines[first]._replace(label=lines[last].label, score=lines[last].score) for first, last in pairs]
    numbers = np.array([line.label for line in entries], np.int32)
    n_more = len(lines) - len(pairs)
    remark = (
        f"{n_more} lines repeat a mask file: class and confidence of its last line are used, at the position of its "
        "first, as in the official evaluator"
    )
    return _masks(place, entries, [remark] * bool(n_more), class_numbers=numbers, numbering=numbering)


def scannetpp_masks(place: Path, scene: str) -> Parsed:
    return scannet_masks(place, scene, "line")


def opensun3d_masks(place: Path, scene: str) -> Parsed:
    """Every line is a mask, even if it repeats a file: the original numbers the lines."""
    return _masks(place, read_list(place, has_classes=False), ["masks without classes"])


def _masks(place: Path, lines: Sequence[Line], remarks: Sequence[str], **more: Any) -> Parsed:
    members, n_points = _read_masks(place.parent, lines, shown(place))
    scores = np.array([line.score for line in lines], np.float64)
    keys = [printable(line.file, 200) for line in lines]
    return vertex_masks(shown(place), members, n_points, scores=scores, keys=keys, **more), remarks


# ---- labels


def looks_like_labels(line: str) -> str | None:
    words = line.split()
    is_label = len(words) == 1 and words[0].removeprefix("-").isdigit()
    return "its .txt files contain one integer per line" if is_label else None


def looks_like_ranked(line: str) -> str | None:
    words = line.split(SEPARATOR)
    is_ranked = len(words) > 1 and all(word.strip().isdigit() for word in words)
    return "its .txt files contain integers separated by commas" if is_ranked else None


def scannet_labels(place: Path, scene: str) -> Parsed:
    where = shown(place)
    values = integer_lines(_content(place, where), where)
    if not len(values):
        raise PredictionError(f"{where}: is empty; expected one class id per line, one line per point")
    is_wrong = np.abs(values.astype(np.int64)) > np.iinfo(np.int32).max
    if is_wrong.any():
        line = int(np.argmax(is_wrong))
        raise PredictionError(f"{where}:{line + 1}: {int(values[line])} is not a class id")
    return VertexLabels(values.astype(np.int32)), ()


def ranked_labels(place: Path, scene: str) -> Parsed:
    where = shown(place)
    numbers = _ranked_numbers(_content(place, where), where)
    return VertexLabels(numbers[:, 0], numbers[:, 1:] if numbers.shape[1] > 1 else None, "line"), ()


def _ranked_numbers(content: bytes, where: str) -> Int32Array:
    """The class numbers (N, 1) or (N, 3) of the vertices, the most likely first."""
    if (n_lines := content.count(b"\n")) > MAX_POINTS:
        raise PredictionError(f"{where}: has {n_lines} lines; is it damaged?")
    rows = [line.split(SEPARATOR.encode()) for line in content.splitlines()]
    if not rows:
        raise PredictionError(f"{where}: is empty; expected one or three classes per line, one line per vertex")
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
        raise PredictionError(f"{where}:{line + 1}: {shown_row} is not a class index (0-based)")
    return numbers.astype(np.int32)


def read_list(file: Path, *, has_classes: bool = True) -> list[Line]:
    """The lines of a list of masks, each as required by the official script: three fields separated by single spaces.

    A tab is also read as a space. Without classes, as OpenSUN3D's script reads them with numpy: two fields separated
    by blanks, no empty lines and no text after a #; the class is then 0.
    """
    where, lines = shown(file), []
    form = LIST_FORM if has_classes else "'mask file, confidence'"
    for number, raw in enumerate(_content(file, where).removeprefix(BOM_UTF8).splitlines(), 1):
        text = raw.decode("utf-8", "replace")
        words = text.replace("\t", " ").split(" ") if has_classes else text.partition("#")[0].split()
        if not words:
            continue
        if len(words) != 2 + has_classes:
            raise PredictionError(
                f"{where}:{number}: {counted(len(words), 'field')} in '{printable(text, 120)}'; expected {form}"
            )
        label, score = _number(words[1]) if has_classes else 0, _number(words[-1])
        if label is None or not -(1 << 31) < label < 1 << 31 or label != int(label):
            raise PredictionError(f"{where}:{number}: '{printable(words[1], 60)}' is not a class id")
        if score is None:
            raise PredictionError(f"{where}:{number}: confidence '{printable(words[-1], 60)}' is not a finite number")
        lines.append(Line(number, _plain_path(words[0], f"{where}:{number}"), int(label), score))
    return lines


def _plain_path(text: str, where: str) -> str:
    """The normalized path inside the folder from a line."""
    plain = os.path.normpath(text) if text and "\0" not in text and "\ufffd" not in text else ""
    if not plain or plain == "." or os.path.isabs(plain) or plain.split(os.sep)[0] == "..":
        raise PredictionError(
            f"{where}: '{printable(text, 120)}' is not a path inside the folder of the list; mask files must be in it"
        )
    return plain


def _read_masks(folder: Path, lines: Sequence[Line], where: str) -> tuple[list[Int32Array], int | None]:
    """The points in the mask of each line, and the number of points of all; None without any."""
    members: list[Int32Array] = []
    n_members, n_points = 0, None
    folders: dict[Path, Path] = {folder: folder.resolve()}
    for line in lines:
        place = f"{where}:{line.number}: mask '{printable(line.file, 120)}'"
        try:
            is_inside = _is_inside(folder, folder / line.file, folders)
        except (OSError, RuntimeError) as error:
            reason = "does not exist" if isinstance(error, FileNotFoundError) else "cannot be read"
            raise PredictionError(f"{place} {reason}") from error
        if not is_inside:
            raise PredictionError(f"{place} is not a file inside the folder of the list; copy it there")
        n, indices = _parsed_mask(_content(folder / line.file, place), line.file, place)
        if n_points not in {None, n}:
            raise PredictionError(
                f"{place} is of {n} points and '{printable(lines[0].file, 120)}' of {n_points}; all must have the "
                "points of the scene"
            )
        n_points = n
        check_members(n_members := n_members + len(indices), where)
        members.append(indices)
    return members, n_points


def _is_inside(folder: Path, file: Path, folders: dict[Path, Path]) -> bool:
    """Whether ``file`` resolves to a regular file inside ``folder``; ``OSError`` if there is none.

    ``folders`` caches the real path of each folder: one of many masks is resolved once.
    """
    if file.parent not in folders:
        folders[file.parent] = file.parent.resolve(strict=True)
    target = folders[file.parent] / file.name
    if target.is_symlink():
        target = target.resolve(strict=True)
    return stat.S_ISREG(os.lstat(target).st_mode) and target.is_relative_to(folders[folder])


def _parsed_mask(content: bytes, file: str, where: str) -> tuple[int, Int32Array]:
    """The number of points of a mask and those in it."""
    if file.endswith(MASK_OF_RUNS):
        return _run_length_mask(content, where)
    values = integer_lines(content, where)
    return len(values), np.flatnonzero(values != 0).astype(np.int32)  # fast for booleans


def _run_length_mask(content: bytes, where: str) -> tuple[int, Int32Array]:
    """A mask of ScanNet++: JSON with ``length`` and ``counts``, a text of pairs."""
    try:
        value = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise PredictionError(f"{where} is not valid JSON") from error
    if not isinstance(value, dict) or "length" not in value or "counts" not in value:
        raise PredictionError(f"{where} has no 'length' and 'counts'")
    members = run_members(value["length"], value["counts"], where)
    return value["length"], members


def _number(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _is_number(word: str) -> bool:
    """Whether a word is a number, or NaN or infinite."""
    return _number(word) is not None or word.lower().lstrip("+-") in ("nan", "inf", "infinity")


def _content(file: Path, where: str) -> bytes:
    with reading(where):
        return file_bytes(file)
