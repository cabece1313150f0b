"""All tiles of an audit as one page without scripts, which shows the pictures beside it."""

from __future__ import annotations

import html
from collections.abc import Sequence
from urllib.parse import quote

from su3d_bench.reports.sheet.second_looks import POLICY
from su3d_bench.reports.tables.formats import safe

Shade = tuple[int, int, int]
Line = tuple[str, Shade]
Entry = tuple[int, str, str, str, Sequence[Line], str]  # number, scene, kind, text, lines, picture
STYLE = (
    ":root{color-scheme:light dark}body{font:16px/1.4 system-ui,sans-serif;margin:1rem auto;max-width:82rem;"
    "padding:0 1rem}article{border-top:1px solid #8888;padding:.8rem 0}img{max-width:100%;height:auto;display:block}"
    "h1{font-size:1.3rem}h2{font-size:1.1rem;margin:0;overflow-wrap:anywhere}p{margin:.2rem 0;overflow-wrap:anywhere}"
    ".line{border-left:.6rem solid;padding-left:.5rem}"
)


def audit_page(entries: Sequence[Entry]) -> str:
    """The page; every text is escaped, and a policy in it lets nothing load but pictures."""
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>Questions to look at</title>\n'
        f"<style>{STYLE}</style>\n<main>\n<h1>Questions to look at: {len(entries)}</h1>\n"
        "<p>Green: what answers. Blue: what that was held against. Orange: called so too, and no answer.</p>\n"
        + "\n".join(map(_article, entries))
        + "\n</main>\n</html>\n"
    )


def _article(entry: Entry) -> str:
    number, scene, kind, text, lines, picture = entry
    said = "".join(f'<p class="line" style="border-color:rgb{shade}">{safe(line)}</p>' for line, shade in lines)
    return (
        f'<article id="q{number}"><p>{number} &middot; {safe(scene)} &middot; {safe(kind)}</p>'
        f'<h2 dir="auto">{safe(text)}</h2>{said}'
        f'<img loading="lazy" alt="{safe(text)}" src="{html.escape(quote(picture))}"></article>'
    )
