"""Fetch ScanNet scans, which require signed terms of use: with the user's own script or link.

The options and output of the official script are from a public copy (download-scannet.py of
HungnotDumb/DenseMultimodalAlignment-DMA at 0240b72, in dataset/scannet): ``-o DIR --id SCAN --type SUFFIX`` writes
``DIR/scans/SCAN/SCAN+SUFFIX`` (``scans_test`` for scans of the test split), ``-o DIR --label_map`` the table of labels;
it waits for a key that confirms the terms, and skips existing files. On the server, recordings are in ``v1/scans``,
everything else in ``v2/scans`` and ``v2/tasks``.
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
from su3d_bench.fetching.download import N_RETRIES, Download, Expected, Progress, checked
from su3d_bench.fetching.fetch import FetchedFile, FetchResult, Planned, fetch_file, locked_state, move, write_arrival
from su3d_bench.fetching.sources import Source, check_address

RECORDING = ".sens"
TEST_SUFFIXES = (".txt", "_vh_clean_2.ply", RECORDING)
# The files of a scan that datasets/scannet reads, the recording last: it makes a folder a scan with frames.
SUFFIXES = (".aggregation.json", "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.labels.ply", *TEST_SUFFIXES)
KEYS = b"\n" * 8  # answers to the script's questions: the terms were confirmed here, and nothing is excluded
LAST_WORDS = 4000


@dataclass(frozen=True)
class Scans:
    """Requested scans with their missing files; ``label_table``: whether that table is missing too."""

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
    """The missing files of the scans or splits ``names``: ``paper`` (the default), ``train``, ``val``, ``test``."""
    scans: list[str] = []
    for name in names or ("paper",):
        if name in SPLITS:
            scans += split_scenes(name)
        elif name == "paper":
            scans += PAPER_SCENES
        elif SCAN_NAME.fullmatch(name):
            scans.append(name)
        else:
            raise ConfigError(f"fetch: unknown scan '{name}'{suggest(name, ('paper', *SPLITS, 'scene0000_00'))}")
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
    """The error for users without script and link, with the steps to get one."""
    return ConfigError(
        f"scannet: requires signed terms of use: fill in {source.licence.address} and send it to "
        f"{source.licence.signed_with}; then run this again with --script FILE, the download script named in the "
        "reply, or with --from URL"
    )


def fetch_by_script(source: Source, scans: Scans, script: Path, watch: Progress) -> FetchResult:
    """Fetch missing files one by one with the user's own script, and move each complete scan to its place."""
    if not script.is_file():
        raise ConfigError(f"--script {script}: no such file; give the script named in ScanNet's reply")
    n_done = itertools.count()

    def fetch_one(planned: Planned, scan: str, name: str) -> tuple[Path, FetchedFile]:
        watch(name, next(n_done), scans.n_files)
        words = ["--id", scan, "--type", name.removeprefix(scan)] if scan else ["--label_map"]
        path = planned.state / _folder(scan) / name
        _run(script, planned.state, words, path)
        sha256, n_bytes = checked(path, Expected())[0], path.stat().st_size
        arrived = FetchedFile(source.name, name, "the user's own script", n_bytes, sha256, ())
        write_arrival(planned.root, arrived)
        return path, arrived

    return _fetch(source, scans, fetch_one)


def fetch_from(source: Source, scans: Scans, address: str, watch: Progress, n_retries: int = N_RETRIES) -> FetchResult:
    """Fetch missing files from the user's own link, the folder that contains ``v1`` and ``v2``."""
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


def _fetch(source: Source, scans: Scans, fetch: Callable[[Planned, str, str], tuple[Path, FetchedFile]]) -> FetchResult:
    """Fetch each missing file and move each complete scan to its place, the table of labels (of no scan) last."""
    planned, files = Planned(source, scans.root), list[FetchedFile]()
    with locked_state(planned):
        for scan, names in (scans.missing | ({"": (TABLE_NAME,)} if scans.label_table else {})).items():
            new = [fetch(planned, scan, name) for name in names]
            files += [arrived for _, arrived in new]
            move([path for path, _ in new], scans.root / _folder(scan))
    return FetchResult(source, scans.root / "scans", tuple(files))


def _folder(scan: str) -> Path:
    """The folder of a scan, relative to the root; the root itself for files of no scan."""
    return Path("scans_test" if scan in split_scenes("test") else "scans", scan) if scan else Path()


def _run(script: Path, folder: Path, words: Sequence[str], result: Path) -> None:
    """Run the script for one file, unless it exists; ``DataError`` with the last output line if it was not written."""
    if result.is_file():
        return
    command = [sys.executable, str(script.absolute()), "-o", str(folder.absolute()), *words]
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(command, input=KEYS, stdout=output, stderr=subprocess.STDOUT, cwd=folder, check=False)
        except OSError as error:
            raise StoreError(f"{script}: cannot be run: {error.strerror or error}") from error
        output.seek(max(0, output.tell() - LAST_WORDS))
        lines = [line for line in output.read().decode(errors="replace").splitlines() if line.strip()]
    if done.returncode != 0 or not result.is_file() or not result.stat().st_size:
        last = printable(lines[-1], 200) if lines else "nothing"
        raise DataError(
            f"{script}: did not download {result.name} (exit code {done.returncode}): {last}; rerun to resume"
        )
