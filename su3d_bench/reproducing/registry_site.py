"""A registry as a static site: one page of all rankings, one page per method and per scene, and everything as JSON."""

from __future__ import annotations

import base64
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import ConfigError, printable, shown, some
from su3d_bench.core.files.atomic import is_file, make_folder, read_json, remove_file, write_json, write_text
from su3d_bench.core.files.locks import is_unfinished
from su3d_bench.formats.tables.table import NOT_MEASURED, Cell, Prose, Table, TableRow, is_count, signed, with_interval
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.reports.page.page import PAGE, Kind, page_name, registry_page_html
from su3d_bench.reports.tables.costs import COSTS, cost_text
from su3d_bench.reports.tables.model import confidence_notes, few_scenes
from su3d_bench.reproducing.registry import SUFFIX, Registry, Row
from su3d_bench.runs.finished import AS_SUBMITTED

INDEX, DATA = "index.html", "registry.json"
METHODS, SCENES = "methods", "scenes"
SCHEMA = 1
KIND = "su3d-bench dev registry"  # identifies an earlier site
MAX_ADDRESS_CHARACTERS = 500
TITLE = "Registry of results"
ROW_FIELDS = (  # fields of a row that pages show unchanged
    "method", "values", "intervals", "ranks", "is_ceiling", "costs", "n_updates", "hardware", "profile",
    "encoder", "trained_on", "command", "changed", "changes", "caveat", "warnings", "code", "commit", "run", "authors",
    "link", "date",
)  # fmt: skip


def write_site(registry: Registry, out: Path, title: str = TITLE, bundle_url: str | None = None) -> list[Path]:
    """Write the pages of ``registry`` to the folder ``out``, replacing an earlier site; return the written files.

    ``bundle_url``: the https address of the bundles' folder; None: bundles are named but not linked. Raises
    ``ConfigError`` if ``out`` contains anything else.
    """
    earlier = _earlier_pages(out)
    address = _checked_address(bundle_url)
    value = _value(registry, title, address)
    pages = {INDEX: registry_page_html("index", title, _index(value), [_plain_tables(registry)])}
    makers: tuple[tuple[Kind, Callable[..., dict[str, Any]]], ...] = (("method", _method_page), ("scene", _scene_page))
    for kind, make in makers:
        for one in value[f"{kind}s"]:
            pages[one["page"]] = registry_page_html(kind, one["name"], {**make(value, one), "registry": title})
    for folder in ("", METHODS, SCENES):
        make_folder(out / folder)
    # written first, so that the folder is recognised as a site even if this is interrupted
    write_json(out / DATA, {"kind": KIND, "schema": SCHEMA, "pages": sorted({*pages, *earlier}), **value})
    for name, text in pages.items():
        write_text(out / name, text)
    for name in earlier - set(pages):
        remove_file(out / name)
    write_json(out / DATA, {"kind": KIND, "schema": SCHEMA, "pages": sorted(pages), **value})
    return [out / name for name in (*pages, DATA)]


def _earlier_pages(out: Path) -> set[str]:
    """The pages of the site that ``out`` already contains."""
    if not os.path.lexists(out):
        return set()
    if not out.is_dir():
        raise ConfigError(f"{shown(out)}: is not a folder; name another with --out")
    if all(is_unfinished(name) for _, _, names in os.walk(out) for name in names):
        return set()
    value = read_json(out / DATA) if is_file(out / DATA) else None
    pages = value.get("pages") if isinstance(value, dict) and value.get("kind") == KIND else None
    if not isinstance(pages, list):
        raise ConfigError(f"{shown(out)}: is not empty and not a registry site; name an empty folder with --out")
    return {name for name in pages if isinstance(name, str) and _is_page(name)}


def _is_page(name: str) -> bool:
    folder, _, file = name.rpartition("/")
    return folder in ("", METHODS, SCENES) and PAGE.fullmatch(file) is not None


def _checked_address(text: str | None) -> str | None:
    if text is None:
        return None
    if not text.startswith("https://") or len(text) > MAX_ADDRESS_CHARACTERS or printable(text, 10_000) != text:
        raise ConfigError(f"--bundle-url '{printable(text, 100)}': expected an address that starts with https://")
    return text.rstrip("/") + "/"


def _page(folder: str, name: str) -> str:
    return f"{folder}/{page_name(name)}.html"


def _value(registry: Registry, title: str, address: str | None) -> dict[str, Any]:
    """The whole site as JSON values; links are relative to the root of the site."""
    boards = [_board(board, address) for board in registry.boards]
    rows = registry.rows
    digests = {scene: digest for row in rows for scene, digest in row.data}
    return {
        "title": title,
        "n_bundles": registry.n_bundles,
        "pictures": {
            digest_bytes(row.picture)[:16]: base64.b64encode(row.picture).decode() for row in rows if row.picture
        },
        "boards": boards,
        "methods": [
            {"name": name, "page": _page(METHODS, name), "n_rows": sum(row.method == name for row in rows)}
            for name in sorted({row.method for row in rows})
        ],
        "scenes": [
            {"name": name, "page": _page(SCENES, name), "digest": digest} for name, digest in sorted(digests.items())
        ],
        "left_out": [vars(one) for one in registry.refused],
    }


def _board(board: Sequence[Row], address: str | None) -> dict[str, Any]:
    first = board[0]
    known = load_protocol(first.protocol) if first.protocol in protocol_names() else None
    return {
        **{name: getattr(first, name) for name in ("protocol", "version", "digest", "scenes", "headline")},
        "summary": "user-defined" if known is None else known.summary,
        "datasets": sorted({scene.partition("/")[0] for scene in first.scenes}),
        "notes": list(_notes(board)),
        "rows": [_row(row, address) for row in board],
    }


def _notes(board: Sequence[Row]) -> Iterator[str]:
    """The notes below a ranking."""
    first = board[0]
    rivals = [row for row in board if not row.is_ceiling]
    yield from confidence_notes({f"{row.method} of {row.bundle.name}": row.confidences for row in rivals})
    yield from dict.fromkeys(f"labels: {row.labels}" for row in rivals if row.labels)
    encoders = dict.fromkeys(row.encoder for row in rivals if row.encoder)
    if len(encoders) > 1:
        yield f"features of several encoders, as the protocol does not fix one: {some(list(encoders), 6)}"
    if any(row.ranks for row in board):
        yield (
            f"rank: simultaneous 95 % interval of the rank by {first.headline[0]}, from sign-flip tests of the means "
            "over scenes of all pairs, corrected by Holm"
        )
    elif len(rivals) > 1:
        yield f"no ranks: {len(rivals)} rows are too many for testing all pairs"
    if rough := few_scenes(len(first.scenes)):
        yield rough
    if len(rivals) < len(board):
        yield "rows that use ground truth are listed last and not ranked"


def _row(row: Row, address: str | None) -> dict[str, Any]:
    file = f"{row.bundle.name}{SUFFIX}"
    return {
        **{name: getattr(row, name) for name in ROW_FIELDS},
        "page": _page(METHODS, row.method),
        "picture": None if row.picture is None else digest_bytes(row.picture)[:16],
        "times": AS_SUBMITTED,
        "of_scenes": dict(row.values_of_scenes),
        "weights": [{**asdict(one), "files": dict(one.files)} for one in row.weights],
        "bundle": {
            **{key: value for key, value in asdict(row.bundle).items() if key != "name"},
            "file": file,
            "address": None if address is None else address + file,
        },
    }


def _index(value: Mapping[str, Any]) -> dict[str, Any]:
    """The data of the first page: everything except the numbers of single scenes."""
    boards = [
        {**board, "rows": [{k: v for k, v in row.items() if k != "of_scenes"} for row in board["rows"]]}
        for board in value["boards"]
    ]
    return {**value, "boards": boards}


def _method_page(value: Mapping[str, Any], method: Mapping[str, Any]) -> dict[str, Any]:
    boards = [
        {
            **board,
            "n_ranked": sum(row["ranks"] is not None for row in board["rows"]),
            "rows": [row for row in board["rows"] if row["method"] == method["name"]],
        }
        for board in value["boards"]
    ]
    pages = {scene["name"]: scene["page"] for scene in value["scenes"]}
    boards = [board for board in boards if board["rows"]]
    shown = {row["picture"] for board in boards for row in board["rows"]}
    pictures = {name: picture for name, picture in value["pictures"].items() if name in shown}
    return {"name": method["name"], "boards": boards, "scene_pages": pages, "pictures": pictures}


def _scene_page(value: Mapping[str, Any], scene: Mapping[str, Any]) -> dict[str, Any]:
    name = scene["name"]
    boards = []
    for board in value["boards"]:
        if name in board["scenes"]:
            rows = [{**row, "of_scenes": {name: row["of_scenes"][name]}} for row in board["rows"]]
            boards.append({**board, "rows": rows})
    return {"name": name, "digest": scene["digest"], "boards": boards}


def _plain_tables(registry: Registry) -> Table | Prose:
    """The content of the first page if scripts are disabled."""
    has_changes = any(row.changes for row in registry.rows)
    rows = [
        TableRow(
            row.method,
            (
                Cell(row.protocol),
                Cell(_headline(row)),
                Cell(NOT_MEASURED if row.ranks is None else " to ".join(map(str, row.ranks))),
                Cell(str(len(row.scenes))),
                *(Cell(cost_text(value)) for value in row.costs.values()),
                Cell(row.hardware),
                Cell(row.trained_on),
                *([Cell(_changes(row))] if has_changes else []),
                Cell(row.authors),
                Cell(row.date or NOT_MEASURED),
                Cell(f"{row.bundle.name}{SUFFIX} {row.bundle.sha256}"),
            ),
            group=row.protocol,
        )
        for row in registry.rows
    ]
    if not rows:
        return Prose(("This registry has no rows.",))
    changes = ["change under corruptions, points"] if has_changes else []
    facts = ("hardware", "weights trained on", *changes, "authors", "date", "bundle")
    columns = ("protocol", "values", "rank", "scenes", *COSTS.values(), *facts)
    return Table("registry", f"All rows, in per cent; times {AS_SUBMITTED}.", "method", columns, tuple(rows), ())


def _changes(row: Row) -> str:
    return ", ".join(f"{family} {signed(change)}" for family, change in row.changes) or NOT_MEASURED


def _headline(row: Row) -> str:
    return ", ".join(
        f"{name} {value:g}" if is_count(name) and value is not None else f"{name} {with_interval(value, interval)}"
        for name, value, interval in zip(row.headline, row.values, row.intervals, strict=True)
    )
