"""The run folder: where its files are, content keys, one writer at a time.

A job is one scene under one method. It has two *steps*, ``predict`` and ``score``; ``done.json`` seals each with the
key of all its inputs and the SHA-256 of the files that it vouches for. A file that is damaged or missing makes its
step run anew; a step sealed under another key is refused, naming the field that changed.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import StoreError, shown
from su3d_bench.core.files.atomic import make_folder, read_json, write_error, write_json
from su3d_bench.core.files.locks import LOCK_FILE, clear_unfinished, hold_folder, is_unfinished, temporary_path
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.records import SCHEMA, CompletionRecord, checked, plain

JOBS = "scenes"
SHARED_FOLDERS = ("language", "language/images")  # where all jobs of a run write; a job clears its own folders
MARKS = ("run.toml", "run.json")  # by which a folder is known for a run's; the first is the first that a run writes
RECORDS = (*MARKS, "metrics.json", "ablation.json")
FILLED_FREELY = ("language", "slurm", ".cache")  # folders of a run whose files have names of many forms
# The files that a run, or a verb beside its map, writes; "refined_names.json" is what the verb refine leaves.
_RUN_OPTIONS = re.compile(
    r"run\.toml|(run|metrics|ablation)\.json|\.lock|(language|slurm|\.cache)/.+|scenes/[^/]+/[^/]+/("
    r"(prediction|anytime-[0-9.e+-]+)(\.npz|\.features\.npy)|anytime-[0-9.e+-]+-counts\.npz|counts\.npz|updates\.csv"
    r"|log\.txt|done\.json|refined_names\.json|pictures/[^/]+\.png)",
    re.DOTALL,
)
BEFORE_MARKS = (JOBS, "language", LOCK_FILE)  # what a run may hold of which a power cut took them
# What a folder's name says otherwise, so that each scene has a folder of its own; "." ends the dataset's name.
_ESCAPES = {"%": "%25", "/": "%2F", ".": "%2E"}
_ESCAPED = re.compile("|".join(_ESCAPES.values()))


def folder_of_scene(address: str) -> str:
    """The name of the folder of a scene, ``<dataset>/<scene>``; no two scenes have one.

    >>> folder_of_scene("rooms/living0"), folder_of_scene("mine/hall/left_1.5")
    ('rooms.living0', 'mine.hall%2Fleft_1.5')
    """
    dataset, _, scene = address.partition("/")
    return f"{_escaped(dataset, '%.')}.{_escaped(scene, '%/')}"


def scene_of_folder(name: str) -> str:
    """The address of the scene whose folder has this name.

    >>> scene_of_folder("rooms.living0"), scene_of_folder("mine.hall%2Fleft_1.5")
    ('rooms/living0', 'mine/hall/left_1.5')
    """
    plain_of = {escape: character for character, escape in _ESCAPES.items()}
    return "/".join(_ESCAPED.sub(lambda found: plain_of[found[0]], part) for part in name.split(".", 1))


def _escaped(text: str, characters: str) -> str:
    return "".join(_ESCAPES[one] if one in characters else one for one in text)


def check_no_links(top: Path, place: Path) -> None:
    """A ``StoreError`` where a folder below ``top`` on the way to ``place``, or that itself, is a link elsewhere."""
    for folder in (place, *place.parents):
        if folder == top:
            return
        if folder.is_symlink():
            raise StoreError(f"{shown(folder)}: is a link, and a run writes into folders of its own alone; remove it")


def check_not_run_file(place: Path) -> None:
    """A ``StoreError`` where a verb would write into the place of what a run itself has written."""
    above = place.absolute().parents
    is_record = place.name in RECORDS and is_run(above[0])
    is_of_job = len(above) > 3 and above[2].name == JOBS and is_run(above[3])
    if (is_record or is_of_job) and os.path.exists(place):
        raise StoreError(f"{shown(place)}: is a file of the run itself, and stays as it is; choose another name")


def is_run(folder: Path) -> bool:
    """Whether the folder is known for a run's."""
    return any(os.path.isfile(folder / name) for name in MARKS)


@dataclass(frozen=True)
class RunFolder:
    """Where one run's files are; see DESIGN for the layout."""

    path: Path

    def job(self, scene: str, method: str) -> JobFolder:
        """The folder of one scene (``<dataset>/<scene>``) under one method."""
        return JobFolder(self.path / JOBS / folder_of_scene(scene) / method)

    def check_is_run_folder(self) -> None:
        """A ``StoreError`` where the folder holds something and is no run's."""
        try:
            names = sorted(os.listdir(self.path))
        except OSError:  # whoever writes there says more
            return
        foreign_files = [name for name in names if name not in BEFORE_MARKS and not is_unfinished(name)]
        if foreign_files and not any(name in MARKS for name in names):
            raise StoreError(
                f"{shown(self.path)}: holds '{foreign_files[0]}' and is no folder of a run; choose a new folder with --out"
            )

    def jobs(self) -> list[JobFolder]:
        """The folder of each job that is there, of this run's request or not."""
        return [JobFolder(path) for path in sorted(self.path.glob(f"{JOBS}/*/*")) if path.is_dir()]

    def foreign_files(self) -> Iterator[str]:
        """What stands in the folder and was written by no run, nor by a verb beside its map; links count among it."""
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
        """Remove the folder with all that it holds, at once or not at all; ``StoreError`` where a run writes there."""
        with self.locked():
            place = temporary_path(self.path)
            try:
                os.rename(self.path, place)
            except OSError as error:
                reason = error.strerror or error
                raise StoreError(f"{shown(self.path)}: cannot be removed: {reason}; nothing was changed") from error
            shutil.rmtree(place, ignore_errors=True)
        if place.exists():
            raise StoreError(f"{shown(place)}: a part of what was removed cannot be; remove it yourself")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder against a second run; the lock dies with the process and leaves no file behind."""
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
    """The files of one scene under one method."""

    path: Path

    @property
    def prediction(self) -> Path:
        return self.path / "prediction.npz"

    def anytime(self, share: float) -> Path:
        """The map after the first ``share`` of the updates."""
        return self.path / f"anytime-{share:g}.npz"

    def anytime_counts(self, share: float) -> Path:
        """The counts of that map."""
        return self.path / f"anytime-{share:g}-counts.npz"

    @property
    def counts(self) -> Path:
        return self.path / "counts.npz"

    @property
    def updates(self) -> Path:
        return self.path / "updates.csv"

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
        """A ``StoreError`` where writing into the job's folders would write elsewhere."""
        check_no_links(self.path.parents[2], self.pictures)

    def picture(self, name: str) -> Path:
        """Where a picture of this name goes."""
        self.check_no_links()
        return self.pictures / name

    def prepare(self) -> None:
        """Make the folder and clear what a killed run left unfinished."""
        self.check_no_links()
        make_folder(self.path)
        clear_unfinished(self.pictures)

    def remove(self) -> None:
        """Remove the folder, and that of its scene where it was the last there."""
        self.check_no_links()
        place = temporary_path(self.path)
        with suppress(FileNotFoundError):
            os.rename(self.path, place)
            shutil.rmtree(place, ignore_errors=True)
        with suppress(OSError):
            self.path.parent.rmdir()

    def completion_records(self) -> dict[str, CompletionRecord]:
        """The sealed steps; nothing where ``done.json`` is missing or damaged."""
        try:
            record = read_json(self.done)
        except StoreError:
            return {}
        steps = record.get("steps") if isinstance(record, dict) and record.get("schema") == SCHEMA else None
        completion_records = {}
        for step, mark_complete in steps.items() if isinstance(steps, dict) else ():
            with suppress(ValidationError, RecursionError):
                completion_records[step] = checked(CompletionRecord, mark_complete)
        return completion_records

    def mark_complete(
        self, step: str, key: Mapping[str, str], files: Sequence[Path], remarks: Mapping[str, Any] | None = None
    ) -> None:
        """Vouch for ``files`` as the outcome of ``step`` under ``key``; sealing ``predict`` breaks the other seal.

        The features beside a dense prediction go with it. ``remarks`` are kept beside them for whoever resumes.
        """
        steps = {} if step == "predict" else self.completion_records()
        temporary_path = [table for file in files if (table := features_beside(file)) != file and table.is_file()]
        digests = {file.relative_to(self.path).as_posix(): digest_file(file) for file in [*files, *temporary_path]}
        steps[step] = CompletionRecord(key, digests, remarks or {})
        write_json(
            self.done,
            {"schema": SCHEMA, "steps": {name: plain(mark_complete) for name, mark_complete in steps.items()}},
        )

    def remarks(self, step: str) -> Mapping[str, Any]:
        """What was kept beside the seal of ``step``."""
        mark_complete = self.completion_records().get(step)
        return {} if mark_complete is None else mark_complete.remarks

    def changed_field(self, step: str, key: Mapping[str, str], *, known_later: Sequence[str] = ()) -> str | None:
        """A clause that names the first field in which the sealed key differs from ``key``; None where none does.

        Fields in ``known_later`` are not compared.
        """
        mark_complete = self.completion_records().get(step)
        sealed = {} if mark_complete is None else mark_complete.key
        if not sealed or (key.items() <= sealed.items() and sealed.keys() - key.keys() <= set(known_later)):
            return None
        for name in [*key, *(name for name in sealed if name not in key)]:
            if name not in known_later and sealed.get(name) != key.get(name):
                return f"{name} was {sealed.get(name, 'not set')}, now {key.get(name, 'not set')}"
        return None

    def is_done(self, step: str, key: Mapping[str, str]) -> bool:
        """Whether ``step`` is sealed under exactly ``key`` and every file that it vouches for is whole."""
        return self.is_whole(self.completion_records().get(step), key)

    def is_whole(self, mark_complete: CompletionRecord | None, key: Mapping[str, str]) -> bool:
        """Whether ``mark_complete``, one of ``completion_records``, is of exactly ``key`` and every file that it vouches for is whole."""
        if mark_complete is None or mark_complete.key != dict(key):
            return False
        files = {self.path / name: digest for name, digest in mark_complete.files.items()}
        return all(file.is_file() and digest_file(file) == digest for file, digest in files.items())
