"""What somebody should look at again after sheets were scored, as a page with pictures and as CSV."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

from su3d_bench.formats.tables.csv_text import csv_lines
from su3d_bench.reports.tables.formats import safe

COLUMNS = ("item_id", "question", "reason", "answers", "truth", "scene", "methods", "text", "pictures")
STYLE = (
    ":root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:60rem;"
    "padding:0 1rem}"
    "article{border-top:1px solid #8888;padding:1rem 0}img{max-width:100%;height:auto;background:#fff}"
    "h1,h2{font-weight:600}h1{font-size:1.4rem}h2{font-size:1.05rem;margin:0;overflow-wrap:anywhere}"
    "p{margin:.3rem 0;overflow-wrap:anywhere}.reason{font-weight:600}"
)
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' file:"


def second_looks_csv(looks: Sequence[Mapping[str, Any]]) -> str:
    """One line an item and question."""
    rows: list[Sequence[Any]] = [COLUMNS]
    for look in looks:
        row = [look["item_id"], look["ask"], look["reason"], _answers(look), look["automatic"], look["scene"]]
        row += [", ".join(look["methods"]), look["text"], ", ".join(look["pictures"])]
        rows.append(row)
    return csv_lines(rows)


def second_looks_page(looks: Sequence[Mapping[str, Any]], pictures: str, sheet_id: str) -> str:
    """A page without scripts; ``pictures`` is where its picture files are, as the page sees it."""
    body = "\n".join(_article(look, pictures) for look in looks) or "<p>Nothing: all agree.</p>"
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>Second looks</title>\n'
        f"<style>{STYLE}</style>\n<main>\n<h1>Second looks at {safe(sheet_id)}: {len(looks)}</h1>\n{body}\n"
        "</main>\n</html>\n"
    )


def _article(look: Mapping[str, Any], pictures: str) -> str:
    images = "".join(
        f'<p><img loading="lazy" alt="{safe(look["item_id"])}" src="{html.escape(quote(f"{pictures}/{name}"))}"></p>'
        for name in look["pictures"]
        if is_file_name(name)
    )
    truth = f"; ground truth: {safe(look['automatic'])}" if look["automatic"] else ""
    return (
        f'<article><h2 dir="auto">{safe(look["text"])}</h2>'
        f'<p><span class="reason">{safe(look["reason"])}</span>, {safe(look["ask"])}: {safe(_answers(look))}{truth}</p>'
        f"<p>{safe(look['item_id'])}, {safe(look['scene'])}, {safe(', '.join(look['methods']))}</p>{images}</article>"
    )


def is_file_name(name: str) -> bool:
    """Whether ``name`` is of a file in the folder itself.

    >>> is_file_name("item-1.png"), is_file_name("../item-1.png"), is_file_name("..")
    (True, False, False)
    """
    return bool(name.strip(".")) and not any(character in name for character in "/\\:\0")


def _answers(look: Mapping[str, Any]) -> str:
    return "; ".join(f"{name}: {answer}" for name, answer in look["answers"].items())
