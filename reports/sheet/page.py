"""One page with everything in it, on which a person judges the items of a sheet: no network, no server.

What scenes, queries and maps say reaches the page as data and is written with ``textContent``; a policy in the page
lets nothing run or load that is not in it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from su3d_bench.core.system.files import file_text
from su3d_bench.reports.page.page import rendered

HERE = Path(__file__).parent


def page_html(title: str, data: Mapping[str, Any]) -> str:
    """The page of one annotator; ``data``: id, annotator, columns, guide, asks and items, pictures in base 64."""
    script = file_text(HERE / "page.js")
    names = {"sheet": data["id"], "annotator": data["annotator"]}
    return rendered(HERE, script, title=title, data=json_in_html(data), **names)


def json_in_html(value: Any) -> str:
    """JSON that ends no script element and begins no comment, whatever texts are in it.

    >>> json_in_html(["</script><!--"])
    '["\\\\u003c/script\\\\u003e\\\\u003c!--"]'
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
