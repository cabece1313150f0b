"""One page for some runs: a single file that loads nothing, in which every text of a run is data and never markup."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from su3d_bench.core.printing import escaped_json, plain_value
from su3d_bench.core.system.files import file_text

HERE = Path(__file__).parent
SCRIPTS = (  # in the order in which they run
    "scripts/elements.js",
    "scripts/maps/shaders.js",
    "scripts/maps/view.js",
    "scripts/maps/cloud.js",
    "scripts/sections.js",
    "scripts/maps/paint.js",
    "scripts/maps/link.js",
    "scripts/maps/pane.js",
    "scripts/maps/scene.js",
    "scripts/gallery.js",
    "scripts/errors.js",
    "scripts/timing.js",
    "scripts/compare.js",
    "scripts/page.js",
)
STYLE = "page.css"
TEMPLATE = "page.html.j2"


def page_html(
    title: str,
    numbers: Mapping[str, Any],
    scenes: Sequence[Mapping[str, Any]],
    maps: Sequence[str],
    galleries: Sequence[Mapping[str, Any]] = (),
) -> str:
    """The page. All but ``maps`` are plain values; those are in base64, in the order of ``numbers``."""
    script = "(() => {\n'use strict';\n" + "\n".join(_file(HERE / name) for name in SCRIPTS) + "\n})();\n"
    return rendered(
        HERE,
        script,
        title=title,
        data=embedded_json(numbers),
        scenes=[embedded_json(scene) for scene in scenes],
        maps=maps,
        galleries=[embedded_json(gallery) for gallery in galleries],
    )


def rendered(folder: Path, script: str, *, begins_with: str = "", **values: Any) -> str:
    """The template of ``folder`` with its style: nothing loads, goes out or runs but what stands in it, by digest.

    ``begins_with``: what stands before the style of the folder, such as that of another page.
    """
    from jinja2 import Environment

    style = begins_with + _file(folder / STYLE)
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    template = Environment(autoescape=True, keep_trailing_newline=True).from_string(_file(folder / TEMPLATE))
    return template.render(policy=policy, style=style, script=script, **values)


def embedded_json(value: Any) -> str:
    """JSON that may stand in a script element: no ``<``, so that no text ends the element or begins a comment.

    >>> embedded_json({"name": "</script><!--"})
    '{"name":"\\\\u003c/script>\\\\u003c!--"}'
    """
    text = escaped_json(plain_value(value), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _file(path: Path) -> str:
    return file_text(path)


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
