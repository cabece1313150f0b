"""One page with everything in it, on which a person judges the items of a sheet: no network, no server.

What scenes, queries and maps say reaches the page as data and is written with ``textContent``; a policy in the page
lets nothing run or load that is not in it.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header>
<h1>{title}</h1>
<progress id="progress" value="0" max="1" aria-label="answered"></progress>
<span id="count" role="status"></span>
</header>
<main>
<div id="picture"><img id="image" alt="" title="click to enlarge"></div>
<aside>
<p id="text" dir="auto"></p>
<div id="asks"></div>
<nav>
<button type="button" id="back" title="left arrow">&larr; back</button>
<button type="button" id="next" title="right arrow">next &rarr;</button>
<button type="button" id="open" title="n">next open</button>
<button type="button" id="undo" title="u">undo</button>
<button type="button" id="export">export answers</button>
</nav>
<p id="note" role="status"></p>
</aside>
</main>
<footer>Keys: 1, 2, 3 answer; arrows go back and on; n goes to the next open item; u takes the last answer back.
Sheet {sheet}, {annotator}.</footer>
<script type="application/json" id="sheet">{data}</script>
<script>{script}</script>
</body>
</html>
"""


def page_html(title: str, data: Mapping[str, Any]) -> str:
    """The page of one annotator; ``data``: id, annotator, columns, asks and items, pictures in base 64."""
    style = (HERE / "page.css").read_text(encoding="utf-8")
    script = (HERE / "page.js").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return _PAGE.format(
        policy=policy,
        title=html.escape(title),
        style=style,
        script=script,
        sheet=html.escape(str(data["id"])),
        annotator=html.escape(str(data["annotator"])),
        data=json_in_html(data),
    )


def json_in_html(value: Any) -> str:
    """JSON that ends no script element and begins no comment, whatever texts are in it.

    >>> json_in_html(["</script><!--"])
    '["\\\\u003c/script\\\\u003e\\\\u003c!--"]'
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(content: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
