"""Self-contained HTML pages of runs and registries; all text is data, never markup."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.safe_output import escaped_json, plain_value
from su3d_bench.core.system.files import file_text
from su3d_bench.formats.tables.table import Prose, Table
from su3d_bench.reports.tables.formats import html_tables

HERE = Path(__file__).parent
REGISTRY = HERE.parent / "registry"
SCRIPTS = (  # in the order in which they run
    *("elements", "maps/shaders", "maps/view", "maps/cloud", "sections", "maps/paint", "maps/link", "maps/pane"),
    *("maps/scene", "gallery", "errors", "timing", "compare", "page"),
)
STYLE = "page.css"
TEMPLATE = "page.html.j2"
MAX_NAME_CHARACTERS = 80
_ENDS_WITH_DIGITS = re.compile(r"(^|-)[0-9a-f]{8}$")
PAGE = re.compile(r"[a-z0-9][a-z0-9-]{0,100}\.html")  # of every page of a site
Kind = Literal["index", "method", "scene"]


def page_html(
    title: str,
    numbers: Mapping[str, Any],
    scenes: Sequence[Mapping[str, Any]],
    maps: Sequence[str],
    galleries: Sequence[Mapping[str, Any]] = (),
) -> str:
    """The page. All but ``maps`` are plain values; those are in base64, in the order of ``numbers``."""
    script = (
        "(() => {\n'use strict';\n"
        + "\n".join(file_text(HERE / f"scripts/{name}.js") for name in SCRIPTS)
        + "\n})();\n"
    )
    return rendered(
        HERE,
        script,
        title=title,
        data=embedded_json(numbers),
        scenes=[embedded_json(scene) for scene in scenes],
        maps=maps,
        galleries=[embedded_json(gallery) for gallery in galleries],
    )


def registry_page_html(
    kind: Kind, title: str, data: Mapping[str, Any], without_scripts: Sequence[Table | Prose] = ()
) -> str:
    """A page of the site; ``data`` are plain values, ``without_scripts`` what stands there where no script runs."""
    parts = (file_text(HERE / "scripts" / "elements.js"), file_text(REGISTRY / "page.js"))
    script = "(() => {\n'use strict';\n" + "\n".join(parts) + "\n})();\n"
    return rendered(
        REGISTRY,
        script,
        begins_with=file_text(HERE / STYLE),
        title=title,
        kind=kind,
        home="index.html" if kind == "index" else "../index.html",
        data=embedded_json({**data, "kind": kind}),
        plain=html_tables(without_scripts),
    )


def page_name(name: str) -> str:
    """What a page about ``name`` is called on disk, without suffix; no two names have one, whatever the system.

    >>> page_name("opensu3d"), page_name("rooms/living0"), page_name("Rooms/living0")
    ('opensu3d', 'rooms-living0-75a7be8c', 'rooms-living0-07d100aa')
    """
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:MAX_NAME_CHARACTERS]
    if plain == name and not _ENDS_WITH_DIGITS.search(name):
        return name
    digits = digest_bytes(name.encode("utf-8", "surrogatepass"))[:8]
    return f"{plain}-{digits}" if plain else digits


def rendered(folder: Path, script: str, *, begins_with: str = "", **values: Any) -> str:
    """The template of ``folder`` with its style: nothing loads, goes out or runs but what stands in it, by digest.

    ``begins_with``: what stands before the style of the folder, such as that of another page.
    """
    from jinja2 import Environment

    style = begins_with + file_text(folder / STYLE)
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    template = Environment(autoescape=True, keep_trailing_newline=True).from_string(file_text(folder / TEMPLATE))
    return template.render(policy=policy, style=style, script=script, **values)


def embedded_json(value: Any) -> str:
    """JSON that may stand in a script element: no ``<``, so that no text ends the element or begins a comment.

    >>> embedded_json({"name": "</script><!--"})
    '{"name":"\\\\u003c/script>\\\\u003c!--"}'
    """
    text = escaped_json(plain_value(value), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
