"""Pages for human evaluation: self-contained annotation sheets and lists of items to review.

Texts of scenes, queries and maps reach a sheet as data and are shown with ``textContent``; the content security policy
of each page forbids external scripts and resources (except, for lists, the pictures next to them).
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
MAX_CHARACTERS = 2000  # per text in a list


def page_html(title: str, data: Mapping[str, Any]) -> str:
    """Return the page of one annotator; ``data``: id, annotator, columns, guide, asks, items and base64 pictures."""
    script = file_text(HERE / "page.js")
    names = {"sheet": data["id"], "annotator": data["annotator"]}
    return rendered(HERE, script, title=title, data=embedded_json(data), **names)


@dataclass(frozen=True)
class Entry:
    """An item to review: ``head`` identifies it, ``lines`` are the details, ``pictures`` the file names."""

    head: str
    text: str
    lines: tuple[str, ...]
    pictures: tuple[str, ...]


def list_page(title: str, note: str, entries: Sequence[Entry], pictures: str) -> str:
    """Return a page without scripts, all text escaped; ``pictures``: the picture folder relative to the page."""
    from jinja2 import Environment

    environment = Environment(autoescape=True)
    environment.filters["text"] = lambda text: printable(text, MAX_CHARACTERS)
    environment.filters["source"] = lambda name: quote(f"{pictures}/{name}")
    template = environment.from_string(file_text(HERE / "list.html.j2"))
    shown = [(entry, [name for name in entry.pictures if is_file_name(name)]) for entry in entries]
    return template.render(title=title, note=note, entries=shown)


def is_file_name(name: str) -> bool:
    """Whether ``name`` is a plain file name without a path.

    >>> is_file_name("item-1.png"), is_file_name("../item-1.png"), is_file_name("..")
    (True, False, False)
    """
    return bool(name.strip(".")) and not any(character in name for character in "/\\:\0")
