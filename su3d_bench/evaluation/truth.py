"""Ground truth for predictions made elsewhere: a dataset's, or text files in the layout of ScanNet's benchmark."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError, PredictionError, printable, shown, suggest
from su3d_bench.core.types import Int64Array
from su3d_bench.formats.reading import reading
from su3d_bench.formats.text_integers import integer_lines
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.predictions.base import MOST_POINTS, scene_files
from su3d_bench.runs.plan import data_root

LARGEST_LABEL = 1357  # of scannetv2-labels.combined.tsv; values above it are label * 1000 + instance
MAX_NYU40_ID = 40
LARGEST_VALUE = 10_000 * INSTANCES_PER_CLASS  # as the instance metric has it
# Scenes by whose names alone text files are known; the built-in rooms share names with Replica.
SCENE_NAMES = {"scannet": re.compile(r"scene\d{4}_\d\d"), "replica": re.compile(r"(room_?[0-2]|office_?[0-4])")}


@dataclass(frozen=True)
class TextTruth:
    """One value a point of each scene: a class id, or with ``has_instances`` class id * 1000 + instance."""

    values: Mapping[str, Int64Array]
    has_instances: bool

    def labels(self, scene: str) -> Int64Array:
        """Class id of each point, 0 for none."""
        values = self.values[scene]
        return values // INSTANCES_PER_CLASS if self.has_instances else values

    def with_scenes(self, files: Mapping[str, Path]) -> TextTruth:
        """The truth with further scenes."""
        return TextTruth({**self.values, **_read_all(files)}, self.has_instances)

    @cached_property
    def largest_label(self) -> int:
        return max((int(self.labels(scene).max(initial=0)) for scene in self.values), default=0)


def text_scenes(folder: Path) -> dict[str, Path]:
    """Scene -> its file in a folder of ground truth."""
    if not folder.is_dir():
        raise DataError(f"{shown(folder)}: no such folder; give the one with <scene>.txt, one value a point")
    try:
        files = scene_files(folder, (".txt",))
    except PredictionError as error:
        raise DataError(str(error)) from error
    if odd := next((name for name in files if not name.isprintable()), None):
        raise DataError(f"{shown(folder)}: holds a file '{printable(odd, 80)}'; name files after scenes")
    if not files:
        raise DataError(f"{shown(folder)}: has no .txt file; expected <scene>.txt, one value a point")
    return files


def read_text_truth(files: Mapping[str, Path]) -> TextTruth:
    """The truth of the scenes in ``files``; whether values hold instances is told from all of them together."""
    values = _read_all(files)
    largest = max((int(one.max(initial=0)) for one in values.values()), default=0)
    return TextTruth(values, largest > LARGEST_LABEL)


def _read_all(files: Mapping[str, Path]) -> dict[str, Int64Array]:
    return {scene: _read_values(path) for scene, path in files.items()}


def _read_values(path: Path) -> Int64Array:
    where = shown(path)
    try:
        with reading(where):
            values = integer_lines(path.read_bytes(), where).astype(np.int64)
    except PredictionError as error:
        raise DataError(str(error)) from error
    if not 0 < len(values) <= MOST_POINTS:
        raise DataError(f"{where}: has {len(values)} values; expected one a point of the scene")
    is_wrong = (values < 0) | (values > LARGEST_VALUE)
    if is_wrong.any():
        line = int(np.argmax(is_wrong))
        raise DataError(f"{where}:{line + 1}: {int(values[line])} is no class id * 1000 + instance; expected 0 or more")
    return values


def dataset_of_names(scenes: Iterable[str]) -> str | None:
    """The dataset whose scenes have such names; None where that cannot be told.

    >>> dataset_of_names(["scene0011_00", "scene0011_01"]), dataset_of_names(["a"])
    ('scannet', None)
    """
    names = list(scenes)
    fitting = [one for one, form in SCENE_NAMES.items() if names and all(form.fullmatch(name) for name in names)]
    return fitting[0] if fitting else None


def text_variant(truth: TextTruth, space: str) -> str | None:
    """The form of ground truth that the labels speak of, where the label space has several; None otherwise."""
    if space != "scannet":
        return None
    return "nyu40-vertices" if truth.largest_label <= MAX_NYU40_ID else "scannet200-vertices"


def doubts(rules: ProtocolRules, truth: TextTruth) -> tuple[str, ...]:
    """What makes it doubtful that the labels are those of the protocol."""
    if rules.ground_truth == "nyu40-vertices" and truth.largest_label > MAX_NYU40_ID:
        return (
            f"the ground truth holds the label {truth.largest_label}, NYU40 ends at {MAX_NYU40_ID}: are these raw ids "
            "of ScanNet200? points of other classes are void",
        )
    if rules.ground_truth == "scannet200-vertices" and truth.largest_label <= MAX_NYU40_ID:
        return (f"the largest label of the ground truth is {truth.largest_label}: are these NYU40 ids?",)
    return ()


def open_dataset(name: str) -> Any:
    """The dataset called ``name`` with its default settings, below the data root."""
    dataset_class = registry.load("dataset", name)
    return dataset_class(data_root(), dataset_class.Options())


def choose_scenes(asked: Sequence[str], known: Sequence[str], where: str) -> list[str]:
    """The scenes of ``known`` that names or patterns in ``asked`` mean; a dataset before a slash is passed over."""
    import fnmatch

    chosen: dict[str, None] = {}
    for word in asked:
        pattern = word.rpartition("/")[2]
        found = [scene for scene in known if fnmatch.fnmatchcase(scene, pattern)]
        if not found:
            hint = suggest(pattern, known) or "; known: " + ", ".join(known[:8])
            raise DataError(f"no scene of {where} matches '{word}'{hint}")
        chosen.update(dict.fromkeys(found))
    return list(chosen)
