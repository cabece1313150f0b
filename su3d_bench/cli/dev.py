"""``su3d-bench dev``: the cache, the installation, shell completion, and registries of results."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

from su3d_bench.cli import doctor
from su3d_bench.cli.new import REGISTRY, add_new
from su3d_bench.cli.options import Verbs, add_group, add_verb, output_path, searched_folder
from su3d_bench.cli.output import answer, answer_either, answer_json, remark, show
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError, counted, printable, shown

SHELLS = ("bash", "zsh", "fish")
KIND_NAMES = ("perception", "model-digests", "replies")
DAY_S = 86400
MAX_REFUSED = 20  # lines


def add_parser(verbs: Verbs) -> None:
    """Manage the cache, check the installation, set up shell completion, keep registries of results.

    su3d-bench dev doctor
    su3d-bench dev cache list
    """
    actions = add_group(verbs, "dev", add_parser)
    _add_cache(actions)
    # computes nothing, and shows the thread settings
    add_verb(actions, "doctor", doctor.call, data=True).set_defaults(uses_all_cores=True)
    parser = add_verb(actions, "completion", call_completion)
    parser.option("shell", "shell to complete for", choices=SHELLS)
    _add_registry(actions)


def _add_cache(verbs: Verbs) -> None:
    """Show and clear the cache in $SU3D_CACHE.

    su3d-bench dev cache list
    su3d-bench dev cache clear perception --older-than 30
    """
    actions = add_group(verbs, "cache", _add_cache, lists=True)
    add_verb(actions, "list", call_cache_list)
    parser = add_verb(actions, "clear", call_cache_clear)
    parser.option(
        "kinds KIND...",
        "perception, model-digests, runs (copies from URLs), replies, or all (but replies)",
        choices=(*KIND_NAMES, "all"),
    )
    parser.option("--older-than DAYS", "remove only older files (default: 0)", type=float, default=0.0)
    parser.shared("--dry-run")


def call_cache_list(arguments: argparse.Namespace) -> None:
    """Show the number, size and age of cached files by kind.

    su3d-bench dev cache list
    su3d-bench dev cache list --json
    """
    from su3d_bench.runs.scenes import cache_root
    from su3d_bench.store.caches import KINDS, cache_entries, size_text

    root = cache_root()
    rows: list[dict[str, Any]] = []
    for kind in KINDS.values():
        entries = list(cache_entries(root, kind))
        times = [entry.written for entry in entries]
        n_bytes = sum(entry.n_bytes for entry in entries)
        ages = {"oldest": min(times, default=None), "newest": max(times, default=None)}
        rows.append({"kind": kind.name, "n_files": len(entries), "n_bytes": n_bytes, **ages})
    n_bytes = sum(row["n_bytes"] for row in rows)
    lines = [f"cache: {shown(root)} ($SU3D_CACHE): {size_text(n_bytes)}"]
    for row in rows:
        old = f"written {_ago(row['newest'])} to {_ago(row['oldest'])} ago" if row["n_files"] else "nothing"
        n_files = counted(row["n_files"], "file")
        lines.append(f"  {row['kind']:<13}  {size_text(row['n_bytes']):>9}  {n_files:>13}  {old}")
        lines.append(f"  {'':<13}  {KINDS[row['kind']].what}")
    answer_either(arguments, {"folder": str(root), "n_bytes": n_bytes, "kinds": rows}, *lines)


def _ago(written: float) -> str:
    seconds = max(0.0, time.time() - written)
    return counted(round(seconds / DAY_S), "day") if seconds >= DAY_S else counted(round(seconds / 3600), "hour")


def call_cache_clear(arguments: argparse.Namespace) -> None:
    """Remove cached files of some kinds or all; only cache files are removed, and links are not followed.

    su3d-bench dev cache clear all --dry-run
    su3d-bench dev cache clear perception --older-than 30
    """
    from su3d_bench.runs.scenes import cache_root
    from su3d_bench.store.caches import KINDS, cache_entries, clear_cache, size_text

    if not 0 <= arguments.older_than < math.inf:
        raise ConfigError(f"--older-than {arguments.older_than:g}: expected a number of days, 0 or more")
    before = time.time() - arguments.older_than * DAY_S if arguments.older_than else math.inf
    root, wanted = cache_root(), arguments.kinds
    rows, lines = [], []
    for kind in KINDS.values():
        if kind.name not in wanted and ("all" not in wanted or kind.is_paid):
            continue
        if arguments.dry_run:
            sizes = [entry.n_bytes for entry in cache_entries(root, kind) if entry.written < before]
            n_files, n_bytes = len(sizes), sum(sizes)
        else:
            n_files, n_bytes = clear_cache(root, kind, before=before)
        rows.append({"kind": kind.name, "n_files": n_files, "n_bytes": n_bytes})
        done = "would be removed" if arguments.dry_run else "removed"
        lines.append(f"{kind.name}: {counted(n_files, 'file')}, {size_text(n_bytes)} {done}")
    answer_either(arguments, {"folder": str(root), "is_dry": arguments.dry_run, "kinds": rows}, *lines)
    if "all" in wanted and "replies" not in wanted and any(cache_entries(root, KINDS["replies"])):
        text = "replies of language models were not removed; to remove them: su3d-bench dev cache clear replies"
        remark(text, quiet=arguments.quiet)


def call_completion(arguments: argparse.Namespace) -> None:
    """Print a shell completion script.

    eval "$(su3d-bench dev completion bash)"
    su3d-bench dev completion fish | source
    """
    from argcomplete.shell_integration import shellcode

    script = shellcode(["su3d-bench"], shell=arguments.shell)
    answer_either(arguments, {"shell": arguments.shell, "script": script}, *script.splitlines())


def _add_registry(verbs: Verbs) -> None:
    """Maintain a registry of results: add re-scored bundles and build a site of rankings.

    su3d-bench dev registry add reproduced/rooms/bundle.zip --registry my-registry
    su3d-bench dev registry build my-registry --out site
    """
    actions = add_group(verbs, "registry", _add_registry)
    parser = add_verb(actions, "add", call_registry_add, data=True)
    parser.option("bundles BUNDLE...", "archives written by report bundle or reproduce")
    parser.option("--registry DIR", "registry folder (default: the current folder)", type=output_path, default=Path())
    parser.option("--bundle-name NAME", "name of the bundle in the registry (default: from its file or recipe)")
    parser = add_verb(actions, "build", call_registry_build)
    parser.option("folder DIR", "registry, or any folder of bundles", type=searched_folder)
    parser.option("--out DIR", "folder of the site (default: site)", type=output_path, default=Path("site"))
    parser.option("--title TEXT", "title of the page (default: Registry of results)")
    parser.option("--bundle-url URL", "base URL for links to bundles (default: no links)")
    add_new(actions, REGISTRY)


def call_registry_add(arguments: argparse.Namespace) -> int:
    """Re-score bundles and add them to a registry; exit code 1 if one is rejected.

    su3d-bench dev registry add bundle.zip --registry my-registry --bundle-name opensu3d-rooms
    su3d-bench dev registry add bundles/mine.zip
    """
    from dataclasses import asdict

    from su3d_bench.reproducing.registry import add_bundle, lines_of

    if arguments.bundle_name is not None and len(arguments.bundles) > 1:
        raise ConfigError("--bundle-name: applies to one bundle; add the bundles one at a time")
    found = []
    for bundle in arguments.bundles:
        found.append(add_bundle(bundle, arguments.registry, arguments.bundle_name))
        if not arguments.json:
            answer(*lines_of(found[-1]))
            show()
    answer_json(arguments, {"bundles": [{**asdict(one), "is_added": not one.reasons} for one in found]})
    return EXIT_CHECK_FAILED if any(one.reasons for one in found) else EXIT_DONE


def call_registry_build(arguments: argparse.Namespace) -> int:
    """Build a static site of a registry; exit code 1 if an entry cannot be ranked.

    su3d-bench dev registry build my-registry --out site
    su3d-bench dev registry build . --out site --title "Maps of rooms" --bundle-url https://example.org/bundles
    """
    from su3d_bench.reproducing.registry import read_registry
    from su3d_bench.reproducing.registry_site import TITLE, write_site

    registry = read_registry(arguments.folder, with_pictures=True)
    title = TITLE if arguments.title is None else printable(arguments.title, 120)
    pages = write_site(registry, arguments.out, title, arguments.bundle_url)
    refused = [f"excluded: {one.run}, {one.what}: {one.reason}" for one in registry.refused]
    remark(*refused[:MAX_REFUSED])
    if len(refused) > MAX_REFUSED:
        remark(f"excluded: {len(refused) - MAX_REFUSED} more")
    counts = f"{counted(len(registry.rows), 'row')} of {counted(registry.n_bundles, 'bundle')} in "
    value: dict[str, Any] = {
        "index": str(pages[0]),
        "n_pages": len(pages) - 1,
        "n_bundles": registry.n_bundles,
        "n_rows": len(registry.rows),
        "left_out": [vars(one) for one in registry.refused],
    }
    answer_either(arguments, value, f"{pages[0]}: {counts}{counted(len(registry.boards), 'ranking')}")
    return EXIT_CHECK_FAILED if refused else EXIT_DONE
