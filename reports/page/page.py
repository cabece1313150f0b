"""Self-contained HTML pages of runs and registries; all text is inserted as data, never as markup."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.digests import digest_bytes, git_state
from su3d_bench.core.errors import printable
from su3d_bench.core.safe_output import escaped_json, plain_value
from su3d_bench.core.system.files import file_text
from su3d_bench.core.version import __version__
from su3d_bench.formats.tables.table import Prose, Table
from su3d_bench.reports.tables.costs import COSTS
from su3d_bench.reports.tables.formats import html_tables

HERE = Path(__file__).parent
REGISTRY = HERE.parent / "registry"
SCRIPTS = (  # in execution order
    *("elements", "maps/shaders", "maps/view", "maps/cloud", "sections", "maps/paint", "maps/link", "maps/pane"),
    *("maps/scene", "gallery", "errors", "costs", "timing", "compare", "robustness", "page"),
)
STYLE = "page.css"
TEMPLATE = "page.html.j2"
MAX_NAME_CHARACTERS = 80
_ENDS_WITH_DIGITS = re.compile(r"(^|-)[0-9a-f]{8}$")
PAGE = re.compile(r"[a-z0-9][a-z0-9-]{0,100}\.html")  # file names of the pages of a site
Kind = Literal["index", "method", "scene"]


def page_html(
    title: str,
    numbers: Mapping[str, Any],
    scenes: Sequence[Mapping[str, Any]],
    maps: Sequence[str],
    galleries: Sequence[Mapping[str, Any]] = (),
    command: str = "",
) -> str:
    """Return the HTML report. ``maps`` are in base64, in the order of ``numbers``; all else is plain values.

    ``command``, the date, and version and commit of the program are at its top.
    """
    return rendered(
        HERE,
        _script(HERE / f"scripts/{name}.js" for name in SCRIPTS),
        title=title,
        created=_creation(command),
        data=embedded_json(numbers),
        scenes=[embedded_json(scene) for scene in scenes],
        maps=maps,
        galleries=[embedded_json(gallery) for gallery in galleries],
    )


def _script(files: Iterable[Path]) -> str:
    """Return the scripts in ``files``, with the costs of methods and their labels, as one script."""
    costs = f"const COSTS = {escaped_json([*COSTS.items()])};"
    return "\n".join(["(() => {", "'use strict';", costs, *map(file_text, files), "})();", ""])


def _creation(command: str) -> dict[str, str]:
    """Return date, version and commit of the program, and the command that creates a page."""
    git = git_state() or {}
    commit = str(git.get("commit", ""))[:8] + (", modified" if git.get("is_dirty") else "")
    date = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    return {"date": date, "version": __version__, "commit": commit, "command": printable(command, 2000)}


def registry_page_html(
    kind: Kind, title: str, data: Mapping[str, Any], without_scripts: Sequence[Table | Prose] = ()
) -> str:
    """Return a page of a registry site. ``data``: plain values; ``without_scripts``: shown without JavaScript."""
    return rendered(
        REGISTRY,
        _script((HERE / "scripts/elements.js", HERE / "scripts/costs.js", REGISTRY / "page.js")),
        begins_with=file_text(HERE / STYLE),
        title=title,
        kind=kind,
        home="index.html" if kind == "index" else "../index.html",
        data=embedded_json({**data, "kind": kind}),
        plain=html_tables(without_scripts),
    )


def page_name(name: str) -> str:
    """Return the file name, without suffix, of the page about ``name``; unique even on case-insensitive file systems.

    >>> page_name("opensu3d"), page_name("rooms/living0"), page_name("Rooms/living0")
    ('opensu3d', 'rooms-living0-75a7be8c', 'rooms-living0-07d100aa')
    """
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:MAX_NAME_CHARACTERS]
    if plain == name and not _ENDS_WITH_DIGITS.search(name):
        return name
    digits = digest_bytes(name.encode("utf-8", "surrogatepass"))[:8]
    return f"{plain}-{digits}" if plain else digits


def rendered(folder: Path, script: str, *, begins_with: str = "", **values: Any) -> str:
    """Render the template of ``folder``; its content security policy allows only its own script and style.

    ``begins_with``: CSS placed before the style of the folder, such as that of another page.
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
    """Return JSON that is safe in a script element: without ``<``, no text can end the element or begin a comment.

    >>> embedded_json({"name": "</script><!--"})
    '{"name":"\\\\u003c/script>\\\\u003c!--"}'
    """
    text = escaped_json(plain_value(value), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
