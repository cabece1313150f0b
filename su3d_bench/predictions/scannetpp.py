"""Submissions of the ScanNet++ benchmark: lists of run-length masks, and the likeliest classes of every vertex.

Their class numbers are places in the benchmark's list of classes, from 0. Source: semantic/eval of
scannetpp/scannetpp at commit f3b4712.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, counted, reading, shown
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Int32Array
from su3d_bench.formats.arrays import MOST_POINTS
from su3d_bench.formats.text_integers import integer_lines
from su3d_bench.predictions.base import ScenePrediction, VertexLabels, VertexMasks
from su3d_bench.predictions.scannet_text import MASK_OF_RUNS, ScannetText, TextFiles, list_words

TOP = 3  # classes a vertex, where a line has several: eval_semantic.py takes 1 or the largest of its k
SEPARATOR = ","


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
        with reading(where):
            content = file_bytes(place)
        numbers = _ranked_numbers(content, where)
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
