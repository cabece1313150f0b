"""The run folder: its files, content keys, one writer at a time.

A job is one scene with one method. It has two *steps*, ``predict`` and ``score``; ``done.json`` has a completion record
for each, with the key of all its inputs and the SHA-256 of its files. If a file is damaged or missing, its step runs
again; a step completed under another key is an error that names the changed field.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import StoreError, shown
from su3d_bench.core.files.atomic import is_file, make_folder, read_json, write_error, write_json
from su3d_bench.core.files.locks import LOCK_FILE, clear_unfinished, hold_folder, is_unfinished, temporary_path
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.records import SCHEMA, CompletionRecord, checked, plain

# Maps scored against the whole ground truth, against what the frames until then had shown, and the latter as a map.
Curve = Literal["anytime", "seen", "ceiling"]
JOBS = "scenes"
SHARED_FOLDERS = ("language", "language/images")  # written by all jobs of a run; a job clears its own folders
MARKS = ("run.toml", "run.json")  # files that identify a run folder; a run writes the first one first
RECORDS = (*MARKS, "metrics.json", "ablation.json")
FILLED_FREELY = ("language", "slurm", ".cache")  # folders of a run with files of any name
# The files written by a run or by a command that adds to a map; "refined_names.json" is written by refine.
_RUN_OPTIONS = re.compile(
    r"run\.toml|(run|metrics|ablation)\.json|\.lock|(language|slurm|\.cache)/.+|scenes/[^/]+/[^/]+/("
    r"(prediction|anytime-[0-9.e+-]+)(\.npz|\.features\.npy)|(updates|schedule)\.csv"
    r"|((anytime|seen|ceiling)(-[0-9.e+-]+)?-)?counts\.npz"
    r"|log\.txt|done\.json|refined_names\.json|pictures/[^/]+\.png)",
    re.DOTALL,
)
BEFORE_MARKS = (JOBS, "language", LOCK_FILE)  # what a run may have left if a power cut removed the MARKS
# Characters escaped in folder names, so that each scene has its own folder; "." ends the dataset's name.
_ESCAPES = {"%": "%25", "/": "%2F", ".": "%2E"}
_ESCAPED = re.compile("|".join(_ESCAPES.values()))


def folder_of_scene(address: str) -> str:
    """The folder name of a scene ``<dataset>/<scene>``, unique to the scene.

    >>> folder_of_scene("rooms/living0"), folder_of_scene("mine/hall/left_1.5")
    ('rooms.living0', 'mine.hall%2Fleft_1.5')
    """
    dataset, _, scene = address.partition("/")
    return f"{_escaped(dataset, '%.')}.{_escaped(scene, '%/')}"


def scene_of_folder(name: str) -> str:
    """The address of the scene with this folder name.

    >>> scene_of_folder("rooms.living0"), scene_of_folder("mine.hall%2Fleft_1.5")
    ('rooms/living0', 'mine/hall/left_1.5')
    """
    plain_of = {escape: character for character, escape in _ESCAPES.items()}
    return "/".join(_ESCAPED.sub(lambda found: plain_of[found[0]], part) for part in name.split(".", 1))


def _escaped(text: str, characters: str) -> str:
    return "".join(_ESCAPES[one] if one in characters else one for one in text)


def check_no_links(top: Path, place: Path) -> None:
    """Raise ``StoreError`` if ``place`` or one of its parents below ``top`` is a symbolic link."""
    for folder in (place, *place.parents):
        if folder == top:
            return
        if os.path.islink(folder):
            raise StoreError(f"{shown(folder)}: is a link, but a run writes only to its own folders; remove the link")


def is_run(folder: Path) -> bool:
    """Whether the folder is a run folder."""
    return any(os.path.isfile(folder / name) for name in MARKS)


@dataclass(frozen=True)
class RunFolder:
    """The files of one run; see DESIGN for the layout."""

    path: Path

    def job(self, scene: str, method: str) -> JobFolder:
        """The folder of one scene (``<dataset>/<scene>``) with one method."""
        return JobFolder(self.path / JOBS / folder_of_scene(scene) / method)

    def check_is_run_folder(self) -> None:
        """Raise ``StoreError`` if the folder is not empty and not a run folder."""
        try:
            names = sorted(os.listdir(self.path))
        except OSError:  # writing there gives a better message
            return
        others = [name for name in names if name not in BEFORE_MARKS and not is_unfinished(name)]
        if others and not any(name in MARKS for name in names):
            raise StoreError(
                f"{shown(self.path)}: contains '{others[0]}' and is not a run folder; choose another with --out"
            )

    def jobs(self) -> list[JobFolder]:
        """The folders of all existing jobs, requested by this run or not."""
        return [JobFolder(path) for path in sorted(self.path.glob(f"{JOBS}/*/*")) if path.is_dir()]

    def foreign_files(self) -> Iterator[str]:
        """Files in the folder that neither a run nor another command has written; including links."""
        for above, folders, files in os.walk(self.path):
            where = Path(above).relative_to(self.path)
            links = [name for name in folders if Path(above, name).is_symlink()]
            for place in (where / name for name in sorted((*files, *links))):
                is_known = any(map(is_unfinished, place.parts)) or _RUN_OPTIONS.fullmatch(place.as_posix())
                if not is_known or (self.path / place).is_symlink():
                    yield place.as_posix()
            if not where.parts:
                known = (JOBS, *FILLED_FREELY)
                yield from (name for name in sorted(folders) if not is_unfinished(name) and name not in known)

    def remove(self) -> None:
        """Remove the folder and its content atomically; ``StoreError`` if a run is writing there."""
        with self.locked():
            place = temporary_path(self.path)
            try:
                os.rename(self.path, place)
            except OSError as error:
                reason = error.strerror or error
                raise StoreError(f"{shown(self.path)}: cannot be removed: {reason}; nothing was changed") from error
            shutil.rmtree(place, ignore_errors=True)
        if place.exists():
            raise StoreError(f"{shown(place)}: was only partly removed; remove the rest yourself")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder; the lock ends with the process and leaves no file."""
        make_folder(self.path)
        try:
            handle = hold_folder(self.path)
        except BlockingIOError as error:
            message = f"{self.path}: another run is writing here; wait for it or choose another folder with --out"
            raise StoreError(message) from error
        except OSError as error:
            raise write_error(self.path, error) from error
        try:
            for folder in (self.path / name for name in SHARED_FOLDERS):
                check_no_links(self.path, folder)
                clear_unfinished(folder)
            yield
        finally:
            os.close(handle)


@dataclass(frozen=True)
class JobFolder:
    """The files of one scene with one method."""

    path: Path

    @property
    def prediction(self) -> Path:
        return self.path / "prediction.npz"

    def anytime(self, point: float) -> Path:
        """The map after the first fraction ``point`` of the updates if it is below 1, otherwise after that many."""
        return self.path / f"anytime-{point:g}.npz"

    def curve_counts(self, curve: Curve, point: float | None) -> Path:
        """The counts of that map, or of the last one if ``point`` is None."""
        at = "" if point is None else f"-{point:g}"
        return self.counts if (curve, point) == ("anytime", None) else self.path / f"{curve}{at}-counts.npz"

    def reached_counts(self, curve: Curve, point: float | None) -> Path:
        """The same to read: a scene with fewer updates than ``point`` counts with its last map."""
        file = self.curve_counts(curve, point)
        has_ended = point is not None and point >= 1 and not is_file(file)
        return self.curve_counts(curve, None) if has_ended else file

    @property
    def counts(self) -> Path:
        return self.path / "counts.npz"

    @property
    def updates(self) -> Path:
        return self.path / "updates.csv"

    @property
    def schedule(self) -> Path:
        """The times of the frames of a real-time run."""
        return self.path / "schedule.csv"

    @property
    def log(self) -> Path:
        return self.path / "log.txt"

    @property
    def pictures(self) -> Path:
        return self.path / "pictures"

    @property
    def done(self) -> Path:
        return self.path / "done.json"

    def check_no_links(self) -> None:
        """Raise ``StoreError`` if a folder of the job is a link."""
        check_no_links(self.path.parents[2], self.pictures)

    def picture(self, name: str) -> Path:
        """The path of the picture ``name``."""
        self.check_no_links()
        return self.pictures / name

    def prepare(self) -> None:
        """Create the folder and remove unfinished files of a killed run."""
        self.check_no_links()
        make_folder(self.path)
        clear_unfinished(self.pictures)

    def remove(self) -> None:
        """Remove the folder, and its scene's folder if that is then empty."""
        self.check_no_links()
        place = temporary_path(self.path)
        with suppress(FileNotFoundError):
            os.rename(self.path, place)
            shutil.rmtree(place, ignore_errors=True)
        with suppress(OSError):
            self.path.parent.rmdir()

    def completion_records(self) -> dict[str, CompletionRecord]:
        """The completion records by step; empty if ``done.json`` is missing or damaged."""
        try:
            record = read_json(self.done)
        except StoreError:
            return {}
        steps = record.get("steps") if isinstance(record, dict) and record.get("schema") == SCHEMA else None
        completion_records = {}
        for step, completion in steps.items() if isinstance(steps, dict) else ():
            with suppress(ValidationError, RecursionError):
                completion_records[step] = checked(CompletionRecord, completion)
        return completion_records

    def mark_complete(
        self, step: str, key: Mapping[str, str], files: Sequence[Path], remarks: Mapping[str, Any] | None = None
    ) -> None:
        """Record ``files`` as the result of ``step`` under ``key``; a new record of ``predict`` removes the other one.

        The features of a dense prediction are included. ``remarks`` are stored for resumed runs.
        """
        steps = {} if step == "predict" else self.completion_records()
        temporary_path = [table for file in files if (table := features_beside(file)) != file and table.is_file()]
        digests = {file.relative_to(self.path).as_posix(): digest_file(file) for file in [*files, *temporary_path]}
        steps[step] = CompletionRecord(key, digests, remarks or {})
        write_json(self.done, {"schema": SCHEMA, "steps": {name: plain(one) for name, one in steps.items()}})

    def remarks(self, step: str) -> Mapping[str, Any]:
        """The remarks in the completion record of ``step``."""
        completion = self.completion_records().get(step)
        return {} if completion is None else completion.remarks

    def changed_field(self, step: str, key: Mapping[str, str], *, known_later: Sequence[str] = ()) -> str | None:
        """A clause with the first field in which the recorded key differs from ``key``; None if equal.

        Fields in ``known_later`` are not compared.
        """
        completion = self.completion_records().get(step)
        key_before = {} if completion is None else completion.key
        if not key_before or (key.items() <= key_before.items() and key_before.keys() - key.keys() <= set(known_later)):
            return None
        for name in [*key, *(name for name in key_before if name not in key)]:
            if name not in known_later and key_before.get(name) != key.get(name):
                return f"{name} was {key_before.get(name, 'not set')}, now {key.get(name, 'not set')}"
        return None

    def is_done(self, step: str, key: Mapping[str, str]) -> bool:
        """Whether ``step`` is completed under exactly ``key`` and all its files are intact."""
        return self.is_whole(self.completion_records().get(step), key)

    def is_whole(self, completion: CompletionRecord | None, key: Mapping[str, str]) -> bool:
        """Whether ``completion``, one of ``completion_records``, has exactly ``key`` and all its files are intact."""
        if completion is None or completion.key != dict(key):
            return False
        files = {self.path / name: digest for name, digest in completion.files.items()}
        return all(file.is_file() and digest_file(file) == digest for file, digest in files.items())
