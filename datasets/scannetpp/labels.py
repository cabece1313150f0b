"""ScanNet++'s benchmark classes: from the words of annotators to the lines of ``top100.txt``, as the official toolkit
maps them.

The lists come with the data (``metadata/semantic_benchmark/``) and are not shipped here. A class id is the number of
the line in ``top100.txt``, from 1; the toolkit counts from 0.

Source: scannetpp/scannetpp at commit f3b4712, semantic/prep/map_semantic.py and semantic/transforms/mesh.py.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import LabelSet
from su3d_bench.datasets.recordings.recorded_frames import numbers
from su3d_bench.formats.text_files import read_text

BASES = ("", "scannetpp", "ScanNetPP", "ScanNet++", "scannetpp_v2", "scannetpp_v1", "scannetpp/v2", "scannetpp/v1")
LABEL_SPACE = "scannetpp"
BENCHMARK_FOLDER = "metadata/semantic_benchmark"
CLASSES_NAME, INSTANCES_NAME, MAP_NAME = LIST_NAMES = ("top100.txt", "top100_instance.txt", "map_benchmark.csv")
WORD, COUNT, TARGET = COLUMNS = ("class", "count", "semantic_map_to")
NO_CLASS = "None"  # in the map: annotated, but not of the benchmark
MOST_CLASSES = 10_000
MOST_LETTERS = 200  # of the name of a class


@dataclass(frozen=True)
class BenchmarkClasses:
    """``id_of``: of every word of annotators that the benchmark has, by way of the map, the class id;
    ``with_instances``: the class ids of ``top100_instance.txt``."""

    labels: LabelSet
    id_of: Mapping[str, int]
    with_instances: frozenset[int]


def read_benchmark_classes(folder: Path, where: str) -> BenchmarkClasses:
    """The lists in ``folder``; ``where`` begins each message.

    A word goes where its row sends it, and nowhere where that is no class of the list, or where no row has the word.
    """
    names = _read_names(folder / CLASSES_NAME, f"{where}: {CLASSES_NAME}")
    instances = _read_names(folder / INSTANCES_NAME, f"{where}: {INSTANCES_NAME}")
    row_of = {name: row for row, name in enumerate(names, 1)}
    if unknown := [name for name in instances if name not in row_of]:
        raise DataError(f"{where}: {INSTANCES_NAME} has {unknown[0][:40]!a}, which {CLASSES_NAME} has not")
    target_of = _read_map(folder / MAP_NAME, f"{where}: {MAP_NAME}")
    return BenchmarkClasses(
        LabelSet(LABEL_SPACE, tuple(row_of.values()), names),
        {word: row_of[target] for word, target in target_of.items() if target in row_of},
        frozenset(row_of[name] for name in instances),
    )


def _read_names(path: Path, where: str) -> tuple[str, ...]:
    names = read_text(path, where).splitlines()
    while names and not names[-1].strip():  # blank lines at the end are no classes, and shift none
        names.pop()
    for number, name in enumerate(names, 1):
        if not name.strip() or not name.isprintable() or len(name) > MOST_LETTERS:
            raise DataError(f"{where} line {number}: {name[:40]!a} is no name of a class; copy the file again")
    if not 1 <= len(names) <= MOST_CLASSES:
        raise DataError(f"{where}: has {len(names)} lines; expected one a class")
    if len(set(names)) != len(names):
        twice = next(name for row, name in enumerate(names) if name in names[:row])
        raise DataError(f"{where}: has {twice[:40]!a} twice; copy the file again")
    return tuple(names)


def _read_map(path: Path, where: str) -> dict[str, str]:
    """Word -> class of each row with a count; an empty cell sends a word to itself, ``None`` nowhere."""
    text = read_text(path, where)
    try:
        rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except csv.Error as error:
        raise DataError(f"{where}: not a table of commas ({error}); copy the file again") from error
    header = rows[0] if rows else []
    if missing := [name for name in COLUMNS if name not in header]:
        raise DataError(f"{where}: has no column '{missing[0]}'; expected the map of the release")
    at = {name: header.index(name) for name in COLUMNS}
    target_of: dict[str, str] = {}
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        if len(row) <= max(at.values()):
            raise DataError(f"{where} row {number}: has {len(row)} cells of {len(header)}; copy the file again")
        word, count, target = (row[at[name]] for name in COLUMNS)
        # A row is kept for count >= 0, which no count is not.
        if not count.strip() or not numbers([count.strip()], f"{where} row {number}: '{COUNT}'")[0] >= 0:
            continue
        if not target:
            target_of.setdefault(word, word)
        elif target != NO_CLASS:
            target_of[word] = target
    return target_of
