"""``su3d-bench dev cache``: what is kept to be quick, how large and how old it is, and removing it."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.shared.answers import answer_either, remark
from su3d_bench.cli.shared.flags import add_group, add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted, shown

if TYPE_CHECKING:
    from su3d_bench.store.caches import CacheKind

KIND_NAMES = ("perception", "model-digests", "runs", "replies")
DAY = 86400  # seconds


def add_parser(verbs: Any) -> None:
    actions = add_group(
        verbs,
        "cache",
        "List what is kept in $SU3D_CACHE to be quick, and remove it.",
        ("su3d-bench dev cache list", "su3d-bench dev cache clear perception --older-than 30"),
        lists=True,
    )
    add_verb(
        actions,
        "list",
        "List what is kept by kind: how many files, how large, how old.",
        ("su3d-bench dev cache list", "su3d-bench dev cache list --json cache.json"),
        call_list,
    )
    parser = add_verb(
        actions,
        "clear",
        "Remove what is kept, of some kinds or all; nothing but files of the cache's own form, never through links.",
        ("su3d-bench dev cache clear all --dry-run", "su3d-bench dev cache clear perception --older-than 30"),
        call_clear,
    )
    parser.add_argument(
        "kinds",
        nargs="+",
        choices=(*KIND_NAMES, "all"),
        metavar="KIND",
        help=f"{', '.join(KIND_NAMES)}, or all (which leaves replies: they may have cost money)",
    )
    parser.add_argument("--older-than", type=float, metavar="DAYS", help="only what was written so many days ago")
    parser.add_argument("--dry-run", action="store_true", help="say what would be removed, and remove nothing")


def call_list(arguments: argparse.Namespace) -> int:
    from su3d_bench.store.caches import KINDS, size_text

    root, rows = _kept()
    n_bytes = sum(row["n_bytes"] for row in rows)
    lines = [f"cache: {shown(root)} ($SU3D_CACHE): {size_text(n_bytes)}"]
    for row in rows:
        old = f"written {_ago(row['newest'])} to {_ago(row['oldest'])} ago" if row["n_files"] else "nothing"
        n_files = counted(row["n_files"], "file")
        lines.append(f"  {row['kind']:<13}  {size_text(row['n_bytes']):>9}  {n_files:>13}  {old}")
        lines.append(f"  {'':<13}  {KINDS[row['kind']].what}")
    answer_either(arguments, {"folder": str(root), "n_bytes": n_bytes, "kinds": rows}, *lines)
    return EXIT_DONE


def call_clear(arguments: argparse.Namespace) -> int:
    from su3d_bench.runs.scenes import cache_root
    from su3d_bench.store.caches import KINDS, cache_entries, clear_cache, size_text

    days = arguments.older_than
    if days is not None and not 0 <= days < math.inf:
        raise ConfigError(f"--older-than {days:g}: expected a number of days, 0 or more")
    before = math.inf if days is None else time.time() - days * DAY
    root = cache_root()
    rows = []
    for kind in _chosen(arguments.kinds, KINDS):
        if arguments.dry_run:
            found = [entry.n_bytes for entry in cache_entries(root, kind) if entry.written < before]
            n_files, n_bytes = len(found), sum(found)
        else:
            n_files, n_bytes = clear_cache(root, kind, before=before)
        rows.append({"kind": kind.name, "n_files": n_files, "n_bytes": n_bytes})
    done = "would be removed" if arguments.dry_run else "removed"
    lines = [
        f"{row['kind']}: {counted(row['n_files'], 'file')}, {size_text(row['n_bytes'])} {done}"  # type: ignore[arg-type]
        for row in rows
    ]
    answer_either(arguments, {"folder": str(root), "is_dry": arguments.dry_run, "kinds": rows}, *lines)
    if "all" in arguments.kinds and "replies" not in arguments.kinds and any(cache_entries(root, KINDS["replies"])):
        remark(
            "replies of language models stay; su3d-bench dev cache clear replies removes them",
            quiet=arguments.quiet,
        )
    return EXIT_DONE


def _chosen(names: list[str], kinds: dict[str, CacheKind]) -> list[CacheKind]:
    wanted = {name for name, kind in kinds.items() if "all" in names and not kind.is_paid} | set(names)
    return [kind for kind in kinds.values() if kind.name in wanted]


def _kept() -> tuple[Path, list[dict[str, Any]]]:
    """The cache folder and what it holds of each kind."""
    from su3d_bench.runs.scenes import cache_root
    from su3d_bench.store.caches import KINDS, cache_entries

    root = cache_root()
    rows = []
    for kind in KINDS.values():
        entries = list(cache_entries(root, kind))
        times = [entry.written for entry in entries]
        rows.append(
            {
                "kind": kind.name,
                "n_files": len(entries),
                "n_bytes": sum(entry.n_bytes for entry in entries),
                "oldest": min(times, default=None),
                "newest": max(times, default=None),
            }
        )
    return root, rows


def _ago(written: float) -> str:
    seconds = max(0.0, time.time() - written)
    return counted(round(seconds / DAY), "day") if seconds >= DAY else counted(round(seconds / 3600), "hour")
