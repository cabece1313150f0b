"""Texts for the documentation site: escaped for a page, and with adapted links."""

from __future__ import annotations

import html
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from types import MappingProxyType

from su3d_bench.core.safe_output import escaped

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
# Files of the repository's root that are pages of the site; README.md is its first if docs/ has no index.md.
_README = "readme.md" if (DOCS / "index.md").is_file() else "index.md"
ROOT_PAGES = {"README.md": _README, "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
_FENCE = re.compile(r"^ *(```+|~~~+)")
_SPAN = r"(?P<ticks>`+)(?!`)(?:(?!(?P=ticks)).|\n)*?(?P=ticks)(?!`)"
_CODE = re.compile(_SPAN)
# A heading or code, or a link, whose text may contain code and pictures.
_CODE_OR_LINK = re.compile(
    rf"(?P<heading>^#.*$)|(?P<code>{_SPAN})|"
    r"(?P<mark>!?)\[(?P<words>(?:`[^`]*`|\[[^\[\]]*\]|[^\[\]`])*)\]\((?P<target>[^()\s]+)\)",
    re.MULTILINE,
)
_ADDRESS = re.compile(r"https?://(?:www\.|github\.com/)?(?P<words>[^\s;,()<>&\"']+?)/?(?=[\s;,()<>&\"']|$)")
_QUOTED = re.compile(r"``(.+?)``|`(.+?)`", re.DOTALL)


def plain(text: object) -> str:
    """``text`` in one line, escaped so that a page shows its characters literally.

    >>> plain("a  <b>\\n& c")
    'a &lt;b&gt; &amp; c'
    """
    return html.escape(escaped(" ".join(str(text).split())))


def heading(text: object) -> str:
    """``text`` as in ``plain``, escaped for Markdown.

    >>> heading("a_b <i> *c*")
    'a\\\\_b &lt;i&gt; \\\\*c\\\\*'
    """
    return re.sub(r"[\\`*_{}\[\]()#!]", r"\\\g<0>", plain(text))


def prose(text: object) -> str:
    """``text`` as in ``plain``, with addresses as links and quoted parts as code.

    >>> prose("``a<b``: https://example.org/x, read")
    '<code>a&lt;b</code>: <a href="https://example.org/x">example.org/x</a>, read'
    """
    linked = _ADDRESS.sub(r'<a href="\g<0>">\g<words></a>', plain(text))
    return _QUOTED.sub(lambda match: f"<code>{match[1] or match[2]}</code>", linked)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, is_stacked: bool = False) -> str:
    """A table of escaped cells; without a header if ``head`` is empty.

    ``is_stacked``: on a phone, its cells are stacked.
    """
    # one line per cell: otherwise the search would join the words of two cells
    heads = ["<thead><tr>", *(f"<th>{cell}</th>" for cell in head), "</tr></thead>"] if head else []
    lines = [line for row in rows for line in ("<tr>", *(f"<td>{cell}</td>" for cell in row), "</tr>")]
    whole = "\n".join(["<table>", *heads, "<tbody>", *lines, "</tbody></table>"])
    return f'<div class="stacked">\n{whole}\n</div>' if is_stacked else whole


def for_site(
    text: str,
    page: str,
    is_file: Callable[[str], bool],
    repository: str | None,
    names: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """The Markdown of a page, whose path in the repository is ``page``, adapted to the site.

    A link to a page in the root (README.md) leads to its page of the site; one to any other file outside docs/ leads to
    the ``repository`` on its code host or, if the project has none yet, becomes the file's path as code. Broken links
    are kept and reported by the build. For ``names``, whose generated pages are unknown to
    the code host, the first occurrence in code links to its page.
    """
    here = str(PurePosixPath(place_of(page)).parent)
    unnamed = dict(names)

    def link(match: re.Match[str]) -> str:
        words, (target, _, anchor) = match["words"], (match["target"] or "").partition("#")
        if match["code"] is not None:
            there = unnamed.pop(match["code"].strip("`"), None)
            return match[0] if there is None else f"[{match[0]}]({relpath(there, here)})"
        if not target or re.match(r"[a-z]+:", target):
            return match[0]
        path = normpath(str(PurePosixPath(page).parent / target))
        anchor = f"#{anchor}" if anchor else ""
        if path.startswith("docs/") or path in ROOT_PAGES:
            return f"{match['mark']}[{words}]({relpath(place_of(path), here)}{anchor})"
        if path.startswith("../") or not is_file(path):
            return match[0]
        if repository is not None:
            return f"{match['mark']}[{words}]({repository}/blob/main/{path}{anchor})"
        return f"`{path}`" if words.strip("`") in path else f"{words} (`{path}`)"

    return outside_fences(text, lambda part: _CODE_OR_LINK.sub(link, _with_bars(part)))


def place_of(path: str) -> str:
    """Path in the site of a page of the repository.

    >>> place_of("CHANGELOG.md"), place_of("docs/running/gpu.md")
    ('changelog.md', 'running/gpu.md')
    """
    return ROOT_PAGES.get(path, path.removeprefix("docs/"))


def _with_bars(text: str) -> str:
    r"""``text`` with ``|`` unescaped in code of tables: code hosts need ``\|``, the site shows the backslash."""
    row = re.compile(r"^\|.*$", re.MULTILINE)
    return row.sub(lambda line: _CODE.sub(lambda code: code[0].replace("\\|", "|"), line[0]), text)


def outside_fences(text: str, change: Callable[[str], str]) -> str:
    r"""``text`` with ``change`` applied to each part outside fenced blocks.

    >>> print(outside_fences("a\n```sh\na\n```\na", str.upper))
    A
    ```sh
    a
    ```
    A
    """
    parts: list[tuple[bool, str]] = []
    fence = ""
    for line in text.splitlines(keepends=True):
        mark = _FENCE.match(line)
        is_code = bool(fence or mark)
        if mark and not fence:
            fence = mark[1]
        elif mark and mark[1].startswith(fence) and not line.strip().strip(fence[0]):
            fence = ""
        if parts and parts[-1][0] == is_code:
            parts[-1] = (is_code, parts[-1][1] + line)
        else:
            parts.append((is_code, line))
    return "".join(part if is_code else change(part) for is_code, part in parts)


def with_examples(docstring: str) -> str:
    """A docstring with each example in a fenced block; Markdown would read ``>>>`` as three quotations."""
    lines: list[str] = []
    is_example = False
    for line in inspect.cleandoc(docstring).splitlines():
        if line.startswith(">>> ") and not is_example:
            lines += [*([""] if lines and lines[-1] else []), "```pycon"]
            is_example = True
        elif is_example and not line.strip():
            lines.append("```")
            is_example = False
        lines.append(line)
    return "\n".join([*lines, *(["```"] if is_example else [])])
