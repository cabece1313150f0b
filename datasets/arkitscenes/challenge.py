"""The OpenSUN3D challenge's files for ARKitScenes: scene lists, the query of each scene, the vertices that answer it.

Read from an unmodified checkout of OpenSun3D/cvpr24-challenge: ``challenge_track_1`` with
``benchmark_file_lists/`` and ``benchmark_data/gt_development_scenes/``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing, PredictionError, converted, printable
from su3d_bench.core.types import Float32Array, GroundTruth, LabelSet
from su3d_bench.formats.arrays import integer_lines, read_text
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.tables.table import separated_rows
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS, values_of_numbers

BASES = ("", "arkitscenes", "ARKitScenes", "opensun3d")  # below the data root
SCENE_NAMES = r"[0-9]{8}"
TRACK = "challenge_track_1"
CHECKOUT = "cvpr24-challenge"
CHALLENGE_URL = "https://github.com/OpenSun3D/cvpr24-challenge"
LISTS_FOLDER = "benchmark_file_lists"
TRUTH_FOLDER = "benchmark_data/gt_development_scenes"
SCENES_COLUMNS = ("video_id", "visit_id", "fold")
QUERIES_COLUMNS = ("video_id", "visit_id", "query")
PARTS = ("development", "test")
GROUPS = {part: f"opensun3d-{part}" for part in PARTS}
# challenge_development_scenes.csv of OpenSun3D/cvpr24-challenge at 59db30f.
DEVELOPMENT_SCENES = ("42445173", "42445677", "42445935", "42446478", "42446588")
VARIANT = "query-vertices"
LABEL_SPACE = "opensun3d"
OBJECT = LabelSet(LABEL_SPACE, (1,), ("object",))  # eval_script_inst.py has the one class 'object'
MAX_CHARACTERS = 1000  # of a query


@dataclass(frozen=True)
class ChallengeQuery:
    """The query of a scene: its text, and the numbers of the objects that answer it."""

    text: str
    answers: tuple[int, ...]
    kind: str = "instance"


@dataclass(frozen=True)
class Challenge:
    """The part of the challenge in ``folder``; None if there is none."""

    folder: Path | None

    @cached_property
    def queries(self) -> Mapping[str, str]:
        """The text of each development and test scene whose list is available."""
        found: dict[str, str] = {}
        for path in self._lists("queries"):
            for at, scene, text in read_list(path, QUERIES_COLUMNS):
                if not text.strip() or len(text) > MAX_CHARACTERS or not text.isprintable():
                    raise DataError(f"{at}: '{printable(text, 40)}' is not a query; expected the words to search for")
                if found.setdefault(scene, text) != text:
                    raise DataError(f"{at}: scene {scene} has two queries; the challenge has one per scene")
        return found

    @cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The scenes of each part; the development scenes are known even without their list."""
        found: dict[str, tuple[str, ...]] = {GROUPS["development"]: DEVELOPMENT_SCENES}
        for path in self._lists("challenge"):
            part = path.name.removeprefix("challenge_").removesuffix("_scenes.csv")
            found[GROUPS[part]] = tuple(dict.fromkeys(scene for _, scene, _ in read_list(path, SCENES_COLUMNS)))
        return found

    def files(self, scene: str) -> tuple[Path, ...]:
        """The files that are read for a scene, if available."""
        truth = self._truth_file(scene)
        return (*self._lists("queries"), *(() if truth is None else (truth,)))

    def query(self, scene: str) -> str:
        """The text of a scene; ``GroundTruthMissing`` if no list has one."""
        if scene not in self.queries:
            wanted = f"{LISTS_FOLDER}/queries_development_scenes.csv"
            raise GroundTruthMissing(f"arkitscenes/{scene}: no query in {wanted}; {self._advice}")
        return self.queries[scene]

    def ground_truth(self, scene: str, vertices: Float32Array) -> GroundTruth:
        """The objects that answer the query of a scene, for the ``vertices`` (V, 3) m of its mesh in file order.

        ``GroundTruthMissing`` if the challenge publishes none.
        """
        path, where = self._truth_file(scene), f"arkitscenes/{scene}"
        if path is None:
            raise GroundTruthMissing(
                f"{where}: no ground truth, {TRUTH_FOLDER}/{scene}.txt is missing; the challenge publishes that of its "
                f"{len(DEVELOPMENT_SCENES)} development scenes; {self._advice}"
            )
        where = f"{where}: {path.name}"
        with converted(PredictionError, DataError):
            values = integer_lines(read_bytes(path, where, self._advice), where).astype(np.int64)
        if len(values) != len(vertices):
            raise DataError(
                f"{where} has {len(values)} lines, the mesh has {len(vertices)} vertices; both must belong to one scene"
            )
        if len(values) and values.min() < 0:
            line = int(values.argmin())
            raise DataError(f"{where}:{line + 1}: {values[line]} is not an object number; {self._advice}")
        coded = values_of_numbers(values)
        number = np.maximum(coded - INSTANCES_PER_CLASS, 0)
        if (coded == INSTANCES_PER_CLASS).any():  # an object in the challenge's script, but 0 means none here
            number = np.unique(np.append(coded, 0), return_inverse=True)[1][:-1]
        source = f"vertices of the mesh with the object numbers in {path.name} of the OpenSUN3D challenge"
        is_object = (coded > 0).astype(np.int32)
        return GroundTruth(vertices, is_object, number.astype(np.int32), OBJECT, VARIANT, source)

    @property
    def _advice(self) -> str:
        if self.folder is not None:
            return f"copy it from {CHALLENGE_URL} into {self.folder}"
        return (
            f"clone {CHALLENGE_URL} next to the scenes, or name the clone: --set "
            f"arkitscenes.challenge=path/to/{CHECKOUT}"
        )

    def _lists(self, kind: str) -> list[Path]:
        folder = None if self.folder is None else self.folder / LISTS_FOLDER
        paths = [] if folder is None else [folder / f"{kind}_{part}_scenes.csv" for part in PARTS]
        return [path for path in paths if path.is_file()]

    def _truth_file(self, scene: str) -> Path | None:
        path = None if self.folder is None else self.folder / TRUTH_FOLDER / f"{scene}.txt"
        return path if path is not None and path.is_file() else None


def find_challenge(root: Path, named: Path | None) -> Challenge:
    """The challenge's files at ``named`` (a clone of its repository or the folder of its first track), or below
    ``root``."""
    if named is not None:
        found = _first_track((named, named / TRACK))
        if found is None:
            raise DataError(
                f"arkitscenes: option challenge: {printable(str(named), 200)} has no {TRACK}/{LISTS_FOLDER} and no "
                f"{TRACK}/{TRUTH_FOLDER}; name a clone of {CHALLENGE_URL}"
            )
        return Challenge(found)
    below = [root / base for base in BASES]
    return Challenge(_first_track([place for base in below for place in (base / TRACK, base / CHECKOUT / TRACK)]))


def _first_track(places: Sequence[Path]) -> Path | None:
    return next((p for p in places if (p / LISTS_FOLDER).is_dir() or (p / TRUTH_FOLDER).is_dir()), None)


def read_list(path: Path, columns: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Position, video and last column of each row; empty rows are skipped."""
    where = f"arkitscenes: {path.name}"
    try:
        rows = separated_rows(read_text(path, where))
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({printable(str(error), 120)}); copy the file again") from error
    if not rows or tuple(word.strip() for word in rows[0]) != tuple(columns):
        raise DataError(f"{where}: the first line must be {','.join(columns)}; copy the file again")
    for number, row in enumerate(rows[1:], 2):
        if not "".join(row).strip():
            continue
        if len(row) != len(columns) or re.fullmatch(SCENE_NAMES, row[0]) is None:
            raise DataError(f"{where}: row {number}: expected {','.join(columns)}, with an eight-digit video")
        yield f"{where}: row {number}", row[0], row[2]


def answered(truth: GroundTruth, text: str) -> ChallengeQuery:
    """The query of a scene with the numbers of all its objects; without any object, every mask counts as wrong."""
    numbers = np.unique(truth.instance[truth.instance > 0])
    return ChallengeQuery(text, tuple(int(number) for number in numbers))
