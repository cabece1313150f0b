"""Bundles: runs in one archive with SHA-256 digests (and recipe and tables of a reproduction), and their verification.

A zip without compression, with members sorted by name and a fixed date and mode: the same folder gives the same bytes
on every machine, apart from the date in the manifest of ``bundle_runs``. Predictions are already compressed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import IO, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.analysis.rescoring import TOLERANCE, check_dataset_ground_truth, rescored
from su3d_bench.core import registry
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, StoreError, Su3dError, counted, printable, shown
from su3d_bench.core.files import atomic
from su3d_bench.core.files.atomic import TemporaryFolder, is_file, make_folder, replacing
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.safe_output import escaped_json
from su3d_bench.core.system.files import file_bytes, opened, regular
from su3d_bench.core.version import __version__
from su3d_bench.reproducing.differences import Results, compared_all, compared_json
from su3d_bench.reproducing.recipe import parse_recipe
from su3d_bench.runs.finished import FinishedRun, read_run
from su3d_bench.runs.verify import examine
from su3d_bench.store.records import RunRecord, checked
from su3d_bench.store.run_folder import JOBS, RECORDS, folder_of_scene

MANIFEST, RECIPE, COMPARED, TABLES = "manifest.json", "recipe.toml", "compared.json", "tables.md"
RUNS = "runs"
DATE = (1980, 1, 1, 0, 0, 0)  # the earliest date of the zip format
MODE = (stat.S_IFREG | 0o644) << 16
MAX_MEMBERS = 200_000
MAX_MANIFEST = 64 << 20
MAX_REMARK_CHARACTERS = 400  # characters
PIECE = 1 << 20
_JOB_OPTIONS = re.compile(
    r"(prediction|anytime-[0-9.e+-]+)(\.npz|\.features\.npy)|(updates|schedule)\.csv|log\.txt|done\.json"
    r"|((anytime|seen|ceiling)(-[0-9.e+-]+)?-)?counts\.npz|refined_names\.json"
)
_FILE_OF_RUN = re.compile(
    f"{'|'.join(map(re.escape, RECORDS))}|language/.+|{JOBS}/[^/]+/[^/]+/({_JOB_OPTIONS.pattern})"
)
MAX_HEADER_BYTES = 160  # of a member beside its content and its two names, and at the end of the archive
LFS_POINTER = b"version https://git-lfs.github.com/spec/"  # the first line of the specification's pointer files
_SAFE = re.compile(r"[^/\\:\x00-\x1f\x7f]+(/[^/\\:\x00-\x1f\x7f]+)*")
LINK = r"^(https://[^\s<>\"']+)?$"
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Entry(BaseModel):
    """One file of a bundle."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    n_bytes: Annotated[int, Field(ge=0)]
    sha256: Sha256


class Manifest(BaseModel):
    """The contents of a bundle; ``runs`` are the folders of its runs.

    ``recipe`` is empty if the runs are not from a recipe; ``trained_on``: training data of the weights, as stated by
    the creator of the bundle, as are ``authors`` and ``link``; ``date``: of the bundle, ISO 8601.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    program: str
    recipe: str
    runs: tuple[str, ...]
    files: dict[str, Entry]
    trained_on: Annotated[str, Field(max_length=MAX_REMARK_CHARACTERS)] = ""
    authors: Annotated[str, Field(max_length=MAX_REMARK_CHARACTERS)] = ""
    link: Annotated[str, Field(max_length=MAX_REMARK_CHARACTERS, pattern=LINK)] = ""
    date: Annotated[str, Field(pattern=r"^(\d{4}-\d\d-\d\d)?$")] = ""


def write_bundle(place: Path, recipe: str, recipe_file: Path, runs: Sequence[Path], out: Path) -> None:
    """Write the archive of a recipe's ``runs``, with the tables in ``out``, to ``place`` (atomic)."""
    temporary_path = {name: out / name for name in (COMPARED, TABLES) if is_file(out / name)}
    _write(place, runs, {**temporary_path, RECIPE: recipe_file}, {"recipe": recipe})


def bundle_runs(place: Path, runs: Sequence[Path], **stated: str) -> None:
    """Write the archive of any finished ``runs`` to ``place``, with today's date and other fields of ``Manifest``.

    Raises ``StoreError`` if two folders have the same name, ``ConfigError`` for an invalid ``link``.
    """
    if not re.match(LINK, stated.get("link", "")):
        raise ConfigError(f"--link '{printable(stated['link'], 100)}': expected an address that starts with https://")
    whole = [Path(os.path.abspath(folder)) for folder in runs]
    names = [folder.name for folder in whole]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise StoreError(f"two runs have the name '{printable(twice, 100)}'; rename one of their folders")
    bad = next((name for name in names if not is_safe(name)), None)
    if bad is not None:
        raise StoreError(f"'{printable(bad, 100)}': this run name is not valid on other systems; rename its folder")
    remarks = {name: printable(text, MAX_REMARK_CHARACTERS) for name, text in stated.items() if text}
    _write(place, whole, {}, {"recipe": "", "date": f"{datetime.now(UTC):%Y-%m-%d}", **remarks})


def _write(place: Path, runs: Sequence[Path], temporary_path: Mapping[str, Path], about: Mapping[str, str]) -> None:
    sources = dict(temporary_path)
    names = [f"{RUNS}/{folder.name}" for folder in runs]
    for folder, name in zip(runs, names, strict=True):
        sources |= {f"{name}/{file.relative_to(folder).as_posix()}": file for file in _files_of(folder)}
    entries = {name: {"n_bytes": file.stat().st_size, "sha256": digest_file(file)} for name, file in sources.items()}
    manifest = {
        "schema": 1,
        "program": f"su3d-bench {__version__}",
        **about,
        "runs": sorted(names),
        "files": dict(sorted(entries.items())),
    }
    make_folder(place.absolute().parent)
    with replacing(place) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(_member(MANIFEST), escaped_json(manifest, indent=1) + "\n")
        for name in sorted(entries):
            _add(archive, name, sources[name], str(entries[name]["sha256"]))


def _member(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, DATE)
    info.external_attr, info.create_system = MODE, 3
    return info


def _add(archive: zipfile.ZipFile, name: str, file: Path, sha256: str) -> None:
    """Add a file in pieces; ``StoreError`` if it changes meanwhile."""
    info = _member(name)
    info.file_size = file.stat().st_size
    with opened(file) as source, archive.open(info, "w") as member:
        digest = copy_pieces(source, member)
    if digest != sha256:
        raise StoreError(f"{shown(file)}: changed while it was packed; pack again when its run has finished")


def _files_of(folder: Path) -> Iterator[Path]:
    """The files of a run that go into a bundle: records, maps, counts, times and replies of language models."""
    yield from (folder / name for name in RECORDS if is_file(folder / name))
    run = read_run(folder)
    for job in (run.folder.job(scene, method) for scene in run.scenes for method in {*run.methods, CEILING_METHOD}):
        files = job.path.iterdir() if job.path.is_dir() else ()
        yield from sorted(file for file in files if is_file(file) and _JOB_OPTIONS.fullmatch(file.name))
    yield from sorted(file for file in (folder / "language").rglob("*") if is_file(file) and not file.is_symlink())


def is_bundle(path: Path) -> bool:
    """Whether a file has the suffix of a bundle."""
    return path.suffix.lower() == ".zip"


@dataclass(frozen=True)
class Unpacked:
    """A bundle in a folder, with exactly the files of its manifest."""

    folder: Path
    manifest: Manifest

    @property
    def runs(self) -> tuple[Path, ...]:
        return tuple(self.folder / name for name in self.manifest.runs)


def unpack(bundle: Path, into: Path, keep: Callable[[str], bool] = lambda name: True) -> Unpacked:
    """Unpack ``bundle`` into the empty folder ``into``; all files are checked, only those with ``keep(name)`` written.

    Raises ``StoreError`` if it is not a bundle but a link or anything else, a name leads out of the folder, a file
    differs from the manifest, is missing, not listed there or belongs to no run, or the files are far larger than the
    archive.
    """
    where = shown(bundle)
    try:
        with opened(bundle) as stream:
            if stream.read(len(LFS_POINTER)) == LFS_POINTER:
                raise StoreError(f"{where}: is a Git LFS pointer, not the bundle itself; get it with: git lfs pull")
        if bundle.is_symlink():
            raise StoreError(f"{where}: is a link; give or copy the bundle itself")
        with zipfile.ZipFile(regular(bundle)) as archive:
            members = _members(archive, where)
            _check_only_members(archive, bundle.stat().st_size, where)
            allowance = atomic.allowance_of(archive)
            manifest = _manifest(atomic.member_bytes(archive, members[MANIFEST], allowance), where)
            _check_no_others(members, manifest, where)
            for run in manifest.runs:
                content = atomic.member_bytes(archive, members[f"{run}/run.json"], atomic.allowance_of(archive))
                _check_jobs(run, content, manifest, where)
            for name, entry in manifest.files.items():
                _unpack_one(archive, members[name], entry, into if keep(name) else None, allowance, where)
    except OSError as error:
        raise StoreError(f"{where}: cannot be unpacked: {error.strerror or error}") from error
    except atomic.DAMAGE as error:
        raise StoreError(f"{where}: is not a bundle, or damaged: {printable(str(error), 160)}") from error
    return Unpacked(into, manifest)


def _members(archive: zipfile.ZipFile, where: str) -> dict[str, zipfile.ZipInfo]:
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise StoreError(f"{where}: has {len(infos)} files; a bundle has at most {MAX_MEMBERS}")
    members: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename
        kind = stat.S_IFMT(info.external_attr >> 16)
        if info.orig_filename != name or not is_safe(name) or kind not in (0, stat.S_IFREG):
            raise StoreError(f"{where}: '{printable(name, 120)}' is not a plain file below its folder; not unpacked")
        if name.casefold() in members:
            raise StoreError(f"{where}: contains '{printable(name, 120)}' twice; not unpacked")
        members[name.casefold()] = info
    manifest = members.get(MANIFEST)
    if manifest is None or manifest.filename != MANIFEST or manifest.file_size > MAX_MANIFEST:
        raise StoreError(f"{where}: has no {MANIFEST} of a bundle; create one with su3d-bench report bundle RUN")
    return {info.filename: info for info in members.values()}


def _check_only_members(archive: zipfile.ZipFile, n_bytes: int, where: str) -> None:
    """Raise ``StoreError`` if the archive has bytes before, between or after its members."""
    infos = archive.infolist()
    n_own = sum(info.compress_size + 2 * len(info.filename.encode()) + MAX_HEADER_BYTES for info in infos)
    if min(info.header_offset for info in infos) > 0 or n_bytes > n_own + MAX_HEADER_BYTES:
        raise StoreError(f"{where}: has data outside its files; create it again with su3d-bench report bundle RUN")


def is_safe(name: str) -> bool:
    """Whether a name is a file below the folder that it is unpacked into, on every system.

    >>> is_safe("runs/a/run.json"), is_safe("../a"), is_safe("/a"), is_safe("a//b"), is_safe("C:a")
    (True, False, False, False, False)
    """
    parts = PurePosixPath(name).parts
    return bool(_SAFE.fullmatch(name)) and len(name) <= 1000 and not {".", ".."} & set(name.split("/")) and bool(parts)


def _manifest(content: bytes, where: str) -> Manifest:
    try:
        json.loads(content, object_pairs_hook=atomic.unique_keys)
        return Manifest.model_validate_json(content)
    except (ValueError, RecursionError) as error:
        places = error.errors()[0]["loc"] if isinstance(error, ValidationError) else ()
        key = printable(".".join(map(str, places)), 120)
        raise StoreError(f"{where}: {MANIFEST}: {key or 'content'} is invalid for a bundle") from error


def _check_no_others(members: Mapping[str, zipfile.ZipInfo], manifest: Manifest, where: str) -> None:
    named = {*manifest.files, MANIFEST}
    wrong = {"of its manifest missing": named - set(members), "not in its manifest": set(members) - named}
    for what, names in wrong.items():
        if names:
            raise StoreError(f"{where}: {counted(len(names), 'file')} {what}, such as {printable(min(names), 120)}")
    for name in manifest.runs:
        if not is_safe(name) or name.count("/") != 1 or f"{name}/run.json" not in manifest.files:
            raise StoreError(f"{where}: its manifest names the run '{printable(name, 100)}', but has no run.json of it")
    if not manifest.runs:
        raise StoreError(f"{where}: contains no runs; create a bundle with: su3d-bench report bundle RUN")
    known = set(manifest.runs)
    if len(known) < len(manifest.runs):
        raise StoreError(f"{where}: its manifest names a run twice; create it again with su3d-bench report bundle RUN")
    for name in named - {MANIFEST, *((RECIPE, COMPARED, TABLES) if RECIPE in named else ())}:
        run, file = "/".join(name.split("/")[:2]), "/".join(name.split("/")[2:])
        if run not in known or not _FILE_OF_RUN.fullmatch(file) or not manifest.files[name].n_bytes:
            raise StoreError(f"{where}: '{printable(name, 120)}' belongs to no run of its manifest, or is empty")


def _check_jobs(run: str, content: bytes, manifest: Manifest, where: str) -> None:
    """Raise ``StoreError`` if the manifest has files of jobs that run.json, with this content, does not name."""
    record = checked(RunRecord, json.loads(content, object_pairs_hook=atomic.unique_keys))
    scenes, methods = set(map(folder_of_scene, record.scenes)), {*record.methods, CEILING_METHOD}
    for name in manifest.files:
        parts = name.split("/")
        if name.startswith(f"{run}/{JOBS}/") and not (parts[3] in scenes and parts[4] in methods):
            raise StoreError(f"{where}: '{printable(name, 120)}' belongs to no scene and method of its run.json")


def _unpack_one(
    archive: zipfile.ZipFile,
    info: zipfile.ZipInfo,
    entry: Entry,
    into: Path | None,
    allowance: atomic.Allowance,
    where: str,
) -> None:
    """Check a member against its entry and write it; ``into`` None: only check."""
    if info.file_size != entry.n_bytes:
        remark = f"has {info.file_size} bytes, but {entry.n_bytes} in its manifest"
        raise StoreError(f"{where}: {printable(info.filename, 120)} {remark}")
    atomic.check_member(info, allowance)
    place = Path(os.devnull)
    if into is not None:
        place = into / info.filename
        place.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(info) as member, place.open("wb" if into is None else "xb") as out:
        digest = copy_pieces(member, out)
    if digest != entry.sha256:
        raise StoreError(f"{where}: {printable(info.filename, 120)} differs from its manifest (other SHA-256)")


def copy_pieces(source: IO[bytes], out: IO[bytes]) -> str:
    """Copy a file; return the SHA-256 of its content."""
    digest = hashlib.sha256()
    while piece := source.read(PIECE):
        digest.update(piece)
        out.write(piece)
    return digest.hexdigest()


@dataclass
class Verified:
    """The result of verifying a bundle: ``faults``: lines, empty if valid; ``is_to_the_bit``: all counts identical."""

    bundle: str
    n_files: int = 0
    n_scores: int = 0
    n_cells: int = 0
    is_to_the_bit: bool = True
    faults: list[str] = field(default_factory=list)


def verify_bundle(bundle: Path) -> Verified:
    """Unpack a bundle, check every digest, score every map again, and recompute every number.

    Raises ``StoreError`` if it cannot be unpacked or has no run.
    """
    with TemporaryFolder("su3d-bundle-") as folder:
        unpacked = unpack(bundle, folder)
        found = Verified(bundle.name, n_files=len(unpacked.manifest.files))
        for place in unpacked.runs:
            name = place.relative_to(folder).as_posix()
            try:
                found.faults += [f"{name}: {line}" for line in _faults_of(read_run(place), found)]
            except Su3dError as error:
                found.faults.append(f"{name}: {str(error).replace(str(folder), '').lstrip('/')}")
        if not found.faults:
            found.faults += _cells(unpacked, found)
        found.faults = [line.replace(f"{folder}/", "") for line in found.faults]
        return found


def _faults_of(run: FinishedRun, found: Verified) -> Iterator[str]:
    check_no_custom_code(run)
    check_dataset_ground_truth(run)
    wrong = [f"{where}: {fault}" for where, fault in examine(run, with_maps=True)[1]]
    yield from wrong
    for n_scores, is_to_the_bit, fault in () if wrong else rescored(run):
        found.n_scores += n_scores
        found.is_to_the_bit &= is_to_the_bit
        yield from [] if fault is None else [fault]


def check_no_custom_code(run: FinishedRun) -> None:
    """Raise a ``StoreError`` if scoring would load a code file named in the bundle."""
    asked = {name: run.settings.get((name,), ()) for name in ("methods", "scenes", "protocols")}
    for name, texts in asked.items():
        for text in texts if isinstance(texts, list | tuple) else (texts,):
            if name == "methods" and text in run.external:
                continue
            base = registry.base_name(str(text)).partition("/")[0]
            known = registry.METHODS if name == "methods" else registry.DATASETS if name == "scenes" else None
            if ".py" in str(text) or str(text).endswith(".toml") or (known is not None and base not in known):
                raise StoreError(f"uses the user-defined '{printable(str(text), 80)}', which a bundle cannot contain")


def _cells(unpacked: Unpacked, found: Verified) -> Iterator[str]:
    """A fault for the first cell of ``compared.json`` that the runs do not reproduce."""
    if not is_file(unpacked.folder / COMPARED):
        return
    recipe = parse_recipe(file_bytes(unpacked.folder / RECIPE), RECIPE)
    kept = atomic.read_json(unpacked.folder / COMPARED)
    cells = kept.get("cells") if isinstance(kept, dict) else None
    if not isinstance(cells, list) or not all(isinstance(cell, dict) for cell in cells):
        raise StoreError(f"{COMPARED} does not have the format of a reproduction")
    names = [one.name for one in recipe.experiments if any(cell.get("experiment") == one.name for cell in cells)]
    again = compared_json(recipe, compared_all(recipe.chosen(names) if names else (), Results(unpacked.runs)))["cells"]
    found.n_cells = len(cells)
    if len(again) != len(cells):
        yield f"{COMPARED}: has {counted(len(cells), 'cell')}, but the recipe and runs give {len(again)}"
        return
    for before, now in zip(cells, again, strict=True):
        for key in ("reported", "measured", "interval", "difference", "protocol", "n_scenes"):
            if not _agree(before.get(key), now[key]):
                what = f"{now['experiment']} {now['row']} {now['metric']}"
                yield f"{COMPARED}: {what}: {key} is {printable(str(before.get(key)), 60)}, the runs give {now[key]}"
                return


def _agree(before: object, now: object) -> bool:
    if isinstance(before, list | tuple) and isinstance(now, list | tuple):
        return len(before) == len(now) and all(map(_agree, before, now))
    if isinstance(before, int | float) and isinstance(now, int | float):
        return abs(before - now) <= 100 * TOLERANCE
    return before == now
