"""``su3d-bench models fetch`` and ``datasets fetch``: download published weights and data."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.options import Parser, Verbs, add_group, add_verb, perception_config
from su3d_bench.cli.output import answer_either, drawn_bars, remark, size_text
from su3d_bench.core.errors import ConfigError, suggest

if TYPE_CHECKING:
    from su3d_bench.fetching.download import Progress
    from su3d_bench.fetching.fetch import FetchResult, Planned
    from su3d_bench.fetching.sources import Source

MB = 1_000_000


def _add_fetch_options(parser: Parser, *, has_servers: bool = True) -> None:
    """Add ``--accept``, ``--dry-run``, ``--retries`` and, with ``has_servers``, ``--mirror`` and ``--sources``."""
    parser.option(
        "--accept NAME...",
        "model, dataset or licence (such as MIT) to accept (default: ask)",
        action="extend",
        default=[],
    )
    parser.shared("--dry-run")
    parser.option("--retries N", "number of retries (of a download; default: 3)", type=int, default=3)
    if has_servers:
        parser.option(
            "--mirror NAME=URL...",
            "download NAME (see --dry-run) from another server or hub",
            action="extend",
            default=[],
        )
        parser.option("--sources FILE", "TOML file of sources that override the built-in ones")


def retries_of(arguments: argparse.Namespace) -> int:
    if not 0 <= arguments.retries <= 1000:
        raise ConfigError(f"--retries {arguments.retries}: expected 0 to 1000")
    return int(arguments.retries)


def fetch_planned(arguments: argparse.Namespace, planned: Sequence[Planned]) -> None:
    """Download what is missing once its licence is accepted; with ``--dry-run`` only show it."""
    from su3d_bench.fetching.fetch import fetch

    _known_terms(arguments, [entry.source for entry in planned])
    if arguments.dry_run:
        lines = [line for entry in planned for line in plan_lines(entry.source, entry.here)]
        answer_either(arguments, [plan_row(entry.source, entry.here) for entry in planned], *lines)
        return
    n_retries = retries_of(arguments)
    missing = [entry for entry in planned if entry.here is None]
    accept(arguments, [entry.source for entry in missing])
    keep = getattr(arguments, "keep_archives", False)
    with progress_callback(arguments) as watch:
        new = [fetch(entry, watch, n_retries, keep_archives=keep) for entry in missing]
    answer_fetched(arguments, [(entry.source.name, entry.here) for entry in planned if entry.here], new)


def answer_fetched(arguments: argparse.Namespace, here: Sequence[tuple[str, Path]], new: Sequence[FetchResult]) -> None:
    """Print folders and checksums."""
    rows: list[dict[str, Any]] = [{"name": name, "folder": str(folder), "files": []} for name, folder in here]
    lines = [f"{name}: already present: {folder}" for name, folder in here]
    for entry in new:
        row = {"name": entry.source.name, "folder": str(entry.place), "files": [asdict(file) for file in entry.files]}
        rows.append(row | {"remarks": list(entry.remarks)})
        lines.append(f"{entry.source.name}: {entry.place}")
        for file in entry.files:
            sums = (
                f"verified against: {', '.join(file.verified_against)}"
                if file.verified_against
                else "no published checksum; recorded"
            )
            lines.append(f"  {file.sha256}  {file.name}  ({sums})")
        remark(*(f"{entry.source.name}: {text}" for text in entry.remarks), quiet=arguments.quiet)
    answer_either(arguments, rows, *lines)


def plan_row(source: Source, here: Path | None) -> dict[str, Any]:
    """A source as ``--dry-run --json`` prints it."""
    from su3d_bench.fetching.download import hub_addresses

    return source.model_dump(mode="json", exclude_none=True) | {
        "n_bytes": source.n_bytes,
        "is_exact": source.is_exact,
        "addresses": [file.address for file in source.files] if source.hub is None else hub_addresses(source),
        "here": None if here is None else str(here),
    }


def plan_lines(source: Source, here: Path | None) -> list[str]:
    """A source as lines: size, licence, addresses."""
    about = "" if source.is_exact else "about "
    size = "size not stated" if source.n_bytes is None else f"{about}{size_text(source.n_bytes)}"
    return [
        f"{source.name}: {source.what}",
        f"  {size}, {f'already present: {here}' if here is not None else 'to be downloaded'}",
        f"  licence {source.licence.name}: {source.licence.address}",
        *(f"  {address}" for address in plan_row(source, here)["addresses"]),
    ]


def accept(arguments: argparse.Namespace, sources: Sequence[Source]) -> None:
    """Ask for each licence not yet accepted; ``ConfigError`` if declined or without a terminal."""
    given = {name.lower() for name in arguments.accept}
    open_ones = [s for s in sources if not {s.name.lower(), s.licence.name.lower(), s.group} & given]
    licences: dict[tuple[str, str], list[Source]] = {}
    for source in open_ones:
        licences.setdefault((source.licence.name, source.licence.address), []).append(source)
    if not licences:
        return
    for source in sources:
        remark(", ".join(line.strip() for line in plan_lines(source, None)[:3]), quiet=arguments.quiet)
    for (name, address), those in licences.items():
        names = ", ".join(source.name for source in those)
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            raise ConfigError(
                f"fetch: licence '{name}' ({address}) of {names} not accepted; read it, then add --accept "
                f"{those[0].name if len(those) == 1 else shlex.quote(name)}"
            )
        remark(f"{names}: licence '{name}', {address}; do you accept it? [y/N]")
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise ConfigError(f"fetch: licence '{name}' of {names} not accepted; nothing was downloaded")


def _known_terms(arguments: argparse.Namespace, sources: Sequence[Source]) -> None:
    """``ConfigError`` if ``--accept`` names neither a requested item nor its licence."""
    known = [name for s in sources for name in (s.name, s.licence.name, s.group)]
    for name in arguments.accept:
        if name.lower() not in {word.lower() for word in known}:
            raise ConfigError(f"--accept '{name}': neither a requested item nor its licence{suggest(name, known)}")


@contextmanager
def progress_callback(arguments: argparse.Namespace) -> Iterator[Progress]:
    """A progress callback that draws one bar per file if stderr is a terminal."""
    with drawn_bars(is_quiet=arguments.quiet) as bars:
        if bars is None:
            yield lambda name, done, total: None
            return
        tasks: dict[str, Any] = {}

        def watch(name: str, n_done: int, n_total: int | None) -> None:
            unit, word = (MB, "MB") if (n_total or 0) > MB else (1, "")
            if name not in tasks:
                for key in list(tasks):
                    bars.remove_task(tasks.pop(key))
                tasks[name] = bars.add_task(name, total=None, remark=word)
            total = None if n_total is None else max(1, n_total // unit)
            bars.update(tasks[name], total=total, completed=n_done // unit)

        yield watch


def add_models(verbs: Verbs) -> None:
    parser = add_verb(verbs, "fetch", call_models, resumes=True)
    parser.option("names [MODEL...]", "names from models list")
    parser.option("--profile PROFILE", "perception profile (all its models: paper)")
    _add_fetch_options(parser)
    parser.shared("--set")


def call_models(arguments: argparse.Namespace) -> None:
    """Download foundation models into $SU3D_MODELS.

    su3d-bench models fetch --profile paper --accept MIT Apache-2.0
    su3d-bench models fetch sam-vit-h --dry-run
    """
    from su3d_bench.fetching.fetch import plan_models
    from su3d_bench.fetching.sources import load_sources
    from su3d_bench.perception.models.files import models_folder

    root = models_folder(perception_config(arguments).models.folder)
    sources = load_sources(arguments.sources, arguments.mirror)
    fetch_planned(arguments, plan_models(sources, arguments.names, arguments.profile, root))


def add_data(verbs: Verbs) -> None:
    """Download published datasets; downloads are resumed and verified.

    su3d-bench datasets fetch replica --dry-run
    su3d-bench datasets fetch scannet --dry-run
    """
    actions = add_group(verbs, "fetch", add_data)
    parser = add_verb(actions, "replica", call_replica, resumes=True, data=True)
    parser.option("parts [PART...]", "frames or meshes (default: both)")
    parser.option("--keep-archives", "keep the archives, in .fetched")
    _add_fetch_options(parser)
    parser = add_verb(actions, "scannet", call_scannet, resumes=True, data=True)
    parser.option("scans [SCAN...]", "scans or splits: scene0000_00, paper, train, val or test (default: paper)")
    given = parser.add_mutually_exclusive_group()
    parser.option("--script FILE", "your official download script", given)
    parser.option("--from URL", "URL that you received, a folder with v1/scans and v2/scans", given, dest="address")
    _add_fetch_options(parser, has_servers=False)


def call_replica(arguments: argparse.Namespace) -> None:
    """Download Replica into $SU3D_DATA: NICE-SLAM's RGB-D frames and the annotated meshes.

    su3d-bench datasets fetch replica --dry-run
    su3d-bench datasets fetch replica frames --accept replica
    """
    from su3d_bench.fetching.fetch import plan_replica
    from su3d_bench.fetching.sources import load_sources
    from su3d_bench.runs.scenes import data_root

    sources = load_sources(arguments.sources, arguments.mirror)
    fetch_planned(arguments, plan_replica(sources, arguments.parts, data_root()))


def call_scannet(arguments: argparse.Namespace) -> None:
    """Download ScanNet into $SU3D_DATA with the official script or the URL that you received.

    su3d-bench datasets fetch scannet --script download-scannet.py
    su3d-bench datasets fetch scannet val --from https://example.org/scannet --accept scannet
    """
    from su3d_bench.fetching.scannet import fetch_by_script, fetch_from, how_to_sign, plan_scans
    from su3d_bench.fetching.sources import built_in
    from su3d_bench.runs.scenes import data_root

    source, root = built_in().named("scannet"), data_root()
    scans = plan_scans(arguments.scans, root)
    here = root if scans.is_available else None
    if arguments.dry_run:
        missing = [name for names in scans.missing.values() for name in names]
        row = plan_row(source, here) | {"missing": missing, "label_table": scans.label_table}
        counts = f"  {scans.n_files} files of {scans.n_asked} scans are missing below {root}"
        answer_either(arguments, [row], *plan_lines(source, here), counts, *(f"  {name}" for name in missing))
        return
    if scans.is_available:
        answer_fetched(arguments, [(source.name, root)], [])
        return
    if arguments.script is None and arguments.address is None:
        raise how_to_sign(source)
    _known_terms(arguments, [source])
    accept(arguments, [source])
    with progress_callback(arguments) as watch:
        if arguments.script is not None:
            new = fetch_by_script(source, scans, arguments.script, watch)
        else:
            new = fetch_from(source, scans, arguments.address, watch, retries_of(arguments))
    answer_fetched(arguments, [], [new])
