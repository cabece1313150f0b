"""The pages of a registry of results: each one file that loads nothing, a bundle's texts data and never markup."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.system.files import file_text
from su3d_bench.formats.tables.table import Prose, Table
from su3d_bench.reports.page import page as page_of_runs
from su3d_bench.reports.page.page import embedded_json, rendered
from su3d_bench.reports.tables.formats import html_tables

HERE = Path(__file__).parent
MOST_OF_A_NAME = 80
_ENDS_WITH_DIGITS = re.compile(r"(^|-)[0-9a-f]{8}$")
PAGE = re.compile(r"[a-z0-9][a-z0-9-]{0,100}\.html")  # of every page of a site
Kind = Literal["index", "method", "scene"]


def page_html(kind: Kind, title: str, data: Mapping[str, Any], without_scripts: Sequence[Table | Prose] = ()) -> str:
    """A page of the site; ``data`` are plain values, ``without_scripts`` what stands there where no script runs."""
    of_runs = page_of_runs.HERE
    parts = (file_text(of_runs / "scripts" / "elements.js"), file_text(HERE / "page.js"))
    script = "(() => {\n'use strict';\n" + "\n".join(parts) + "\n})();\n"
    return rendered(
        HERE,
        script,
        begins_with=file_text(of_runs / page_of_runs.STYLE),
        title=title,
        kind=kind,
        home="index.html" if kind == "index" else "../index.html",
        data=embedded_json({**data, "kind": kind}),
        plain=html_tables(without_scripts),
    )


def page_name(name: str) -> str:
    """What a page about ``name`` is called on disk, without suffix; no two names have one, whatever the system.

    >>> page_name("opensu3d"), page_name("rooms/living0"), page_name("Rooms/living0")
    ('opensu3d', 'rooms-living0-0eb10b42', 'rooms-living0-6c4eb6f5')
    """
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:MOST_OF_A_NAME]
    if plain == name and not _ENDS_WITH_DIGITS.search(name):
        return name
    digits = digest_bytes(name.encode("utf-8", "surrogatepass"))[:8]
    return f"{plain}-{digits}" if plain else digits
