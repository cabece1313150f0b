"""Scans of ScanNet, which are given to whoever signed its terms: by their own script, or out of their own link.

What the official script takes and writes was read in a public copy of it (download-scannet.py of
HungnotDumb/DenseMultimodalAlignment-DMA at 0240b72, in dataset/scannet): ``-o DIR --id SCAN --type SUFFIX`` writes
``DIR/scans/SCAN/SCAN+SUFFIX`` (``scans_test`` for scans of the test split), ``-o DIR --label_map`` the table of labels;
it waits for a key by which the terms are confirmed, and passes over what is there. On the server recordings lie in
``v1/scans``, all else in ``v2/scans`` and ``v2/tasks``.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from su3d_bench.core.errors import ConfigError, DataError, StoreError, printable, suggest
from su3d_bench.datasets.scannet.folders import (
    PAPER_SCENES,
    SCAN_NAME,
    SPLITS,
    find_file,
    find_scans,
    find_table,
    split_scenes,
)
from su3d_bench.datasets.scannet.truth import TABLE_NAME
from su3d_bench.fetching.download import N_RETRIES, Download, ExpectedContent, Progress, checked
from su3d_bench.fetching.fetch import FetchedFile, FetchResult, Planned, fetch_file, locked_state, move, write_arrival
from su3d_bench.fetching.sources import Source, check_address

RECORDING = ".sens"
TEST_SUFFIXES = (".txt", "_vh_clean_2.ply", RECORDING)
# What datasets/scannet reads of a scan, the recording last: it is what makes a folder a scan with frames.
SUFFIXES = (".aggregation.json", "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.labels.ply", *TEST_SUFFIXES)
KEYS = b"\n" * 8  # for the script's questions: the terms were confirmed here, and nothing is left out
LAST_WORDS = 4000


@dataclass(frozen=True)
class Scans:
    """Scans that were asked for, and those of their files that are not here; ``label_table`` whether it is wanted."""

    root: Path
    missing: dict[str, tuple[str, ...]]
    n_asked: int
    label_table: bool

    @property
    def is_available(self) -> bool:
        return not self.missing and not self.label_table

    @property
    def n_files(self) -> int:
        return sum(map(len, self.missing.values())) + self.label_table


def plan_scans(names: Sequence[str], root: Path) -> Scans:
    """What is missing of the scans or splits ``names``: ``paper`` (the default), ``train``, ``val``, ``test``."""
    scans: list[str] = []
    for name in names or ("paper",):
        if name in SPLITS:
            scans += split_scenes(name)
        elif name == "paper":
            scans += PAPER_SCENES
        elif SCAN_NAME.fullmatch(name):
            scans.append(name)
        else:
            raise ConfigError(f"fetch scannet: '{name}' is no scan{suggest(name, ('paper', *SPLITS, 'scene0000_00'))}")
    found = find_scans(root)
    missing = {}
    for scan in dict.fromkeys(scans):
        wanted = [f"{scan}{suffix}" for suffix in _suffixes(scan)]
        lacking = [name for name in wanted if find_file(found, scan, name) is None]
        if lacking:
            missing[scan] = tuple(lacking)
    return Scans(root, missing, len(dict.fromkeys(scans)), find_table(found) is None)


def _suffixes(scan: str) -> tuple[str, ...]:
    return TEST_SUFFIXES if scan in split_scenes("test") else SUFFIXES


def how_to_sign(source: Source) -> ConfigError:
    """What to say to whoever has neither script nor link yet."""
    return ConfigError(
        f"scannet: is given to whoever signed its terms: fill in {source.licence.address} and send it to "
        f"{source.licence.signed_with}; then run this again with --script FILE, the download script that the answer "
        "names, or with --from URL"
    )


def fetch_by_script(source: Source, scans: Scans, script: Path, watch: Progress) -> FetchResult:
    """Let the user's own script bring what is missing, a file at a time, and move each whole scan to its place."""
    if not script.is_file():
        raise ConfigError(f"--script {script}: there is no such file; name the script that ScanNet's answer led to")
    n_done = itertools.count()

    def fetch_one(planned: Planned, scan: str, name: str) -> tuple[Path, FetchedFile]:
        watch(name, next(n_done), scans.n_files)
        words = ["--id", scan, "--type", name.removeprefix(scan)] if scan else ["--label_map"]
        path = planned.state / _folder(scan) / name
        _run(script, planned.state, words, path)
        sha256, n_bytes = checked(path, ExpectedContent())[0], path.stat().st_size
        arrived = FetchedFile(source.name, name, "the user's own script", n_bytes, sha256, ())
        write_arrival(planned.root, arrived)
        return path, arrived

    return _fetch(source, scans, fetch_one)


def fetch_from(source: Source, scans: Scans, address: str, watch: Progress, n_retries: int = N_RETRIES) -> FetchResult:
    """Bring what is missing out of the user's own link, the folder in which ``v1`` and ``v2`` lie."""
    try:
        check_address(address)
    except ValueError as error:
        raise ConfigError(f"--from: {error}") from error
    base, hosts = address.rstrip("/"), (urlsplit(address).hostname or "",)

    def fetch_one(planned: Planned, scan: str, name: str) -> tuple[Path, FetchedFile]:
        release = "v1" if name.endswith(RECORDING) else "v2"
        wanted = Download(name, f"{base}/{release}/{f'scans/{scan}' if scan else 'tasks'}/{name}", hosts)
        return planned.state / name, fetch_file(planned, wanted, watch, n_retries)

    return _fetch(source, scans, fetch_one)


def _fetch(
    source: Source, scans: Scans, fetch_one: Callable[[Planned, str, str], tuple[Path, FetchedFile]]
) -> FetchResult:
    """Bring each missing file and move each whole scan to its place, the table of labels (of no scan) at last."""
    planned, files = Planned(source, scans.root), list[FetchedFile]()
    with locked_state(planned):
        for scan, names in (scans.missing | ({"": (TABLE_NAME,)} if scans.label_table else {})).items():
            brought = [fetch_one(planned, scan, name) for name in names]
            files += [arrived for _, arrived in brought]
            move([path for path, _ in brought], scans.root / _folder(scan))
    return FetchResult(source, scans.root / "scans", tuple(files))


def _folder(scan: str) -> Path:
    """Where a scan lies below the root, which is the folder of what belongs to no scan."""
    return Path("scans_test" if scan in split_scenes("test") else "scans", scan) if scan else Path()


def _run(script: Path, folder: Path, words: Sequence[str], result: Path) -> None:
    """Run the script for one file, unless that is there; ``DataError`` with its last word where it did not write it."""
    if result.is_file():
        return
    command = [sys.executable, str(script.absolute()), "-o", str(folder.absolute()), *words]
    with tempfile.TemporaryFile() as said:
        try:
            done = subprocess.run(command, input=KEYS, stdout=said, stderr=subprocess.STDOUT, cwd=folder, check=False)
        except OSError as error:
            raise StoreError(f"{script}: cannot be run: {error.strerror or error}") from error
        said.seek(max(0, said.tell() - LAST_WORDS))
        lines = [line for line in said.read().decode(errors="replace").splitlines() if line.strip()]
    if done.returncode != 0 or not result.is_file() or not result.stat().st_size:
        last = printable(lines[-1], 200) if lines else "nothing"
        raise DataError(
            f"{script}: did not bring {result.name} (exit code {done.returncode}); it said last: {last}; run the same "
            "command again to go on"
        )
