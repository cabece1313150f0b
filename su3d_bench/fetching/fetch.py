"""Fetch sources: plan what is missing, download, check, unpack and move it to its place.

The folder ``.fetched`` in the root (of models, of data) contains unfinished downloads and the record. Only complete
scenes and model files are moved from there to the places where datasets and models are searched.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ValidationError

from su3d_bench.core.errors import ConfigError, DataError, ModelMissing, StoreError
from su3d_bench.core.files.atomic import make_folder, write_error, write_json
from su3d_bench.core.files.locks import clear_unfinished, hold_folder
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.version import documentation
from su3d_bench.datasets.replica import folders
from su3d_bench.fetching.archives import members, unpack_tar_gz, unpack_zip
from su3d_bench.fetching.download import (
    N_RETRIES,
    Download,
    Expected,
    Progress,
    checked,
    download_file,
    hub_files,
    part_of,
    size_of,
)
from su3d_bench.fetching.sources import Source, Sources
from su3d_bench.perception.models.catalogue import MODELS, PAPERS_ENCODERS, PROFILE_MODELS
from su3d_bench.perception.models.files import locate

RENDER, ORIGINAL = "Replica", "replica_v1"  # folders of the two trees, named as in the archives
FETCHED, UNPACKED = ".fetched", "unpacked"


@dataclass(frozen=True)
class FetchedFile:
    """One downloaded file; ``verified_against`` names the checksums that it matched, empty if none is known."""

    source: str
    name: str
    address: str
    n_bytes: int
    sha256: str
    verified_against: tuple[str, ...]


class Record(BaseModel):
    """``record.json`` in ``.fetched``: files by ``source/name``, and the unpacked content of archives by source."""

    files: dict[str, FetchedFile] = {}
    unpacked: dict[str, tuple[str, ...]] = {}


def record_path(root: Path) -> Path:
    return root / FETCHED / "record.json"


def read_record(root: Path) -> Record:
    """The record of files fetched into ``root``."""
    path = record_path(root)
    try:
        return Record.model_validate_json(file_bytes(path)) if path.exists() else Record()
    except (OSError, ValidationError) as error:
        raise StoreError(f"{path}: is not a record of fetched files; move it away to start a new one") from error


def write_arrival(root: Path, arrived: FetchedFile) -> None:
    """Record a downloaded file; an earlier entry of the same name is replaced."""
    record = read_record(root)
    record.files[f"{arrived.source}/{arrived.name}"] = arrived
    write_json(record_path(root), record.model_dump())


@dataclass(frozen=True)
class Planned:
    """A requested source: its local ``root``, and ``here``, where it exists already; None if it must be fetched."""

    source: Source
    root: Path
    here: Path | None = None

    @property
    def state(self) -> Path:
        """The folder of the unfinished download."""
        return self.root / FETCHED / self.source.name


@dataclass(frozen=True)
class FetchResult:
    """A fetched source: its place, its downloaded files, and remarks for the user."""

    source: Source
    place: Path
    files: tuple[FetchedFile, ...]
    remarks: tuple[str, ...] = ()


def plan_models(sources: Sources, names: Sequence[str], profile: str | None, root: Path) -> list[Planned]:
    """The plan for the models ``names`` and those of a profile, each with its existing place."""
    if profile is not None and profile not in PROFILE_MODELS:
        known = ", ".join(PROFILE_MODELS)
        raise ConfigError(f"models fetch --profile {profile}: no models for this profile; known: {known}")
    wanted = [*names, *(PROFILE_MODELS[profile] if profile is not None else ())]
    wanted += PAPERS_ENCODERS if profile == "paper" else ()
    if not wanted:
        raise ConfigError("models fetch: no models given; name models, or the profile that needs them: --profile paper")
    return [_planned_model(sources.named(name, "models"), root) for name in dict.fromkeys(wanted)]


def _planned_model(source: Source, root: Path) -> Planned:
    try:
        files = locate(source.name, folder=root) if source.name in MODELS else None
    except (ModelMissing, ConfigError):
        files = None
    return Planned(source, root, None if files is None else files.folder)


def plan_replica(sources: Sources, names: Sequence[str], root: Path) -> list[Planned]:
    """The plan for the two parts of Replica, or for those in ``names`` (``frames``, ``meshes``)."""
    wanted = [name if name.startswith("replica-") else f"replica-{name}" for name in names]
    chosen = [sources.named(name, "replica") for name in dict.fromkeys(wanted)] or sources.of("replica")
    return [Planned(source, root, _replica_here(source, root)) for source in chosen]


def _replica_here(source: Source, root: Path) -> Path | None:
    """The existing place: with everything that an earlier call unpacked, or with all official scenes of any origin."""
    place = root / (RENDER if source.archive == "zip" else ORIGINAL)
    names = read_record(root).unpacked.get(source.name, ())
    if names and all((place / name).exists() for name in names):
        return place
    if source.archive == "zip":
        tree = folders.find_render_tree(root)
        is_whole = tree is not None and set(folders.OFFICIAL_SCENES) <= set(tree.scenes)
        return tree.folder if tree is not None and is_whole and (tree.folder / "cam_params.json").is_file() else None
    found = [folders.find_original_scene(root, scene) for scene in folders.OFFICIAL_SCENES]
    whole = [f for f in found if f is not None and all((f / "habitat" / n).is_file() for n in folders.ORIGINAL_FILES)]
    return whole[0].parent if len(whole) == len(folders.OFFICIAL_SCENES) else None


def fetch(planned: Planned, watch: Progress, n_retries: int = N_RETRIES, *, keep_archives: bool = False) -> FetchResult:
    """Fetch a source to its place; raises ``ConfigError``, ``DataError`` or ``StoreError`` on failure.

    A second call resumes the first one.
    """
    assert planned.here is None
    source, root = planned.source, planned.root
    wanted = hub_files(source) if source.hub is not None else plain_files(source)
    place = root / source.name
    missing = wanted if source.archive is not None else [file for file in wanted if not _is_there(file, place)]
    check_space(planned, missing)
    with locked_state(planned):
        arrived = tuple(fetch_file(planned, file, watch, n_retries) for file in missing)
        left: list[str] = []
        if source.archive is None:  # the weights last: without them the folder is not recognised as a model
            move([planned.state / file.name for file in missing], place)
        else:
            place, left = _unpack(planned, watch)
        shutil.rmtree(planned.state / UNPACKED if keep_archives else planned.state, ignore_errors=True)
    return FetchResult(source, place, arrived, (*_remarks(planned, arrived), *left))


@contextmanager
def locked_state(planned: Planned) -> Iterator[None]:
    """Lock the source against other processes in the block."""
    make_folder(planned.state)
    try:
        handle = hold_folder(planned.state)
    except BlockingIOError:
        raise StoreError(f"{planned.state}: another process is fetching it; wait until it ends and try again") from None
    except OSError as error:
        raise write_error(planned.state, error) from error
    try:
        yield
    finally:
        os.close(handle)


def plain_files(source: Source) -> list[Download]:
    """The files of a source with their own addresses, not from the hub."""
    return [
        Download(file.name, file.address, source.hosts, file.n_bytes, Expected(file.sha256, file.md5_prefix))
        for file in source.files
    ]


def fetch_file(planned: Planned, wanted: Download, watch: Progress, n_retries: int = N_RETRIES) -> FetchedFile:
    """Download one file into the state folder of ``planned``, unless it exists there, and record it."""
    place, known = planned.state / wanted.name, None
    if not wanted.stated.is_published:
        first = read_record(planned.root).files.get(f"{planned.source.name}/{wanted.name}")
        known = None if first is None else first.sha256
    wanted = replace(wanted, stated=replace(wanted.stated, recorded=known))
    if place.is_file():
        sha256, wrong = checked(place, wanted.stated)
        if wrong is not None or wanted.n_bytes not in (None, place.stat().st_size):
            raise DataError(f"{place}: {wrong or 'its size is not the published one'}; delete it and fetch it again")
    else:
        try:
            sha256 = download_file(wanted, place, watch, n_retries)
        except DataError as error:
            if known is not None and known in str(error):
                raise DataError(f"{error}; the first one is recorded in {record_path(planned.root)}") from error
            raise
    n_bytes = place.stat().st_size
    arrived = FetchedFile(planned.source.name, wanted.name, wanted.address, n_bytes, sha256, wanted.stated.kinds)
    if known is None:
        write_arrival(planned.root, arrived)
    return arrived


def check_space(planned: Planned, files: Sequence[Download]) -> None:
    """Raise ``StoreError`` if the disk lacks space for the remaining download; a zip archive needs it twice."""
    sizes = [file.n_bytes for file in files]
    total = sum(size for size in sizes if size is not None) if None not in sizes else planned.source.n_bytes or 0
    places = [planned.state / file.name for file in files]
    n_present = sum(size_of(place) or size_of(part_of(place)) for place in places)
    needed = total - n_present + (total if planned.source.archive == "zip" else 0)
    check_room(planned.root, needed, planned.source.name)


def check_room(root: Path, needed: int, what: str) -> None:
    """Raise ``StoreError`` if the disk of ``root`` has fewer than ``needed`` bytes free."""
    above = next(folder for folder in (root, *root.parents) if folder.is_dir())
    free = shutil.disk_usage(above).free
    if needed > free:
        raise StoreError(
            f"{what}: needs {needed:,} more bytes in {root}, but its disk has {free:,} free; free some space, or "
            "use a folder on another disk"
        )


def _is_there(wanted: Download, place: Path) -> bool:
    path = place / wanted.name
    if not path.exists():
        return False
    _, wrong = checked(path, wanted.stated)
    if wrong is not None:
        raise DataError(f"{path}: differs from the published file: {wrong}; move it away and fetch again")
    return True


def move(paths: Sequence[Path], folder: Path) -> None:
    """Move files and folders into ``folder``."""
    make_folder(folder)
    for path in paths:
        try:
            os.replace(path, folder / path.name)
        except OSError as error:
            raise write_error(folder / path.name, error) from error


def _unpack(planned: Planned, watch: Progress) -> tuple[Path, list[str]]:
    """Unpack the archives in the state folder and move each scene to its place; returns the place and remarks."""
    source = planned.source
    archives = [planned.state / file.name for file in source.files]
    folder = planned.state / UNPACKED
    make_folder(folder)
    try:
        if source.archive == "zip":
            room = sum(size for name, size in members(archives[0]) if _rendered(PurePosixPath(name)) is not None)
            n_present = sum(size_of(path) for path in folder.rglob("*"))
            check_room(planned.root, room - n_present, f"{source.name}, unpacked,")
            n, top = unpack_zip(archives[0], folder, _rendered, watch), RENDER
        else:
            n, top = unpack_tar_gz(archives, folder, _annotated, watch), ORIGINAL
        if not n:
            raise DataError(f"{archives[0]}: contains nothing of {source.what}; give the right archive with --mirror")
    except DataError:
        shutil.rmtree(folder, ignore_errors=True)  # do not keep the content of a damaged archive
        raise
    place = planned.root / top
    for above, _, _ in os.walk(folder):
        clear_unfinished(Path(above))
    # Single files (cam_params.json) first: the dataset exists as soon as a scene's folder does.
    unpacked = sorted((folder / top).iterdir(), key=lambda path: (path.is_dir(), path.name))
    left = [path.name for path in unpacked if (place / path.name).exists()]
    move([path for path in unpacked if path.name not in left], place)
    record = read_record(planned.root)
    record.unpacked[source.name] = tuple(sorted(path.name for path in unpacked))
    write_json(record_path(planned.root), record.model_dump())
    return place, [f"{name} exists already and was not changed" for name in left]


def _rendered(path: PurePosixPath) -> PurePosixPath | None:
    """The target of a member of NICE-SLAM's archive: everything in its folder, as datasets/replica reads it."""
    return path if path.parts[:1] == (RENDER,) and not path.name.startswith(".") else None


def _annotated(path: PurePosixPath) -> PurePosixPath | None:
    """The target of a member of the release: the two files per scene that datasets/replica reads, in any parent."""
    if len(path.parts) < 3 or path.parts[-2] != "habitat" or path.name not in folders.ORIGINAL_FILES:
        return None
    return PurePosixPath(ORIGINAL, *path.parts[-3:])


def _remarks(planned: Planned, arrived: Sequence[FetchedFile]) -> tuple[str, ...]:
    remarks = []
    if unstated := [file.name for file in arrived if not file.verified_against]:
        first = unstated[0] + (f" and {len(unstated) - 1} more" if len(unstated) > 1 else "")
        remarks.append(
            f"the publisher states no checksum of {first}: that of this first download is recorded in "
            f"{record_path(planned.root)}, and later downloads are compared with it"
        )
    if planned.source.name == "ram-plus":
        remarks.append(f"RAM++ must be exported; see {documentation('methods/models')}")
    return tuple(remarks)
