"""Pages for human evaluation: self-contained annotation sheets and lists of items to review.

What scenes, queries and maps say reaches a sheet as data and is written with ``textContent``; a policy in each page
lets nothing run or load that is not in it, or in lists beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from su3d_bench.core.errors import printable
from su3d_bench.core.system.files import file_text
from su3d_bench.reports.page.page import embedded_json, rendered

HERE = Path(__file__).parent
MAX_CHARACTERS = 2000  # of a text in a list


def page_html(title: str, data: Mapping[str, Any]) -> str:
    """Return the page of one annotator; ``data``: id, annotator, columns, guide, asks, items and base64 pictures."""
    script = file_text(HERE / "page.js")
    names = {"sheet": data["id"], "annotator": data["annotator"]}
    return rendered(HERE, script, title=title, data=embedded_json(data), **names)


@dataclass(frozen=True)
class Entry:
    """Something to look at: ``head`` says which it is, ``lines`` what is said of it; ``pictures`` are file names."""

    head: str
    text: str
    lines: tuple[str, ...]
    pictures: tuple[str, ...]


def list_page(title: str, note: str, entries: Sequence[Entry], pictures: str) -> str:
    """A page without scripts, every text escaped; ``pictures`` is the folder of the pictures, as the page sees it."""
    from jinja2 import Environment

    environment = Environment(autoescape=True)
    environment.filters["text"] = lambda text: printable(text, MAX_CHARACTERS)
    environment.filters["source"] = lambda name: quote(f"{pictures}/{name}")
    template = environment.from_string(file_text(HERE / "list.html.j2"))
    shown = [(entry, [name for name in entry.pictures if is_file_name(name)]) for entry in entries]
    return template.render(title=title, note=note, entries=shown)


def is_file_name(name: str) -> bool:
    """Whether ``name`` is of a file in the folder itself.

    >>> is_file_name("item-1.png"), is_file_name("../item-1.png"), is_file_name("..")
    (True, False, False)
    """
    return bool(name.strip(".")) and not any(character in name for character in "/\\:\0")
