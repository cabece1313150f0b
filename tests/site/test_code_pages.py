"""Generated documentation pages, navigation and links of the documentation site."""

from __future__ import annotations

import doctest
import re
import runpy
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import code_pages
import pytest
import site_hooks
import site_text
import yaml
from code_pages import API, METHODS, PROTOCOLS, protocol_page, summary_of
from places import ROOT
from site_hooks import filled
from site_text import ROOT_PAGES, for_site, heading, plain, prose, with_examples

import su3d_bench
from su3d_bench.core import registry
from su3d_bench.core.config import flatten
from su3d_bench.metrics.protocols import loading
from su3d_bench.reports.tables.paper import figures_of

TAGS = {"p", "div", "table", "thead", "tbody", "tr", "th", "td", "code", "a", "details", "summary", "pre"}


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return code_pages.made_pages()


def words(page: str) -> str:
    """The text of a page without its tags, addresses for links out of the site."""
    page = re.sub(r'<a href="(https?:[^"]+)">[^<]+</a>', r"\1", page)
    return " ".join(unescape(re.sub(r"<[^>]+>", "", page)).split())


def test_each_protocol_page_has_every_rule_source_and_class(pages: dict[str, str]) -> None:
    for name in loading.protocol_names():
        rules, text = loading.load_protocol(name), pages[f"{PROTOCOLS}/{name}.md"]
        shown = words(text)
        for path, value in flatten(rules.model_dump(mode="json", exclude={"classes", "not_comparable_with"})):
            assert ".".join(path) in shown or path == ("summary",)
            assert not isinstance(value, str) or value in shown, (name, path)
        for remark in (line for lines in loading.remarks_of(loading.rules_files(name)).values() for line in lines):
            assert " ".join(remark.replace("`", "").split()) in shown.replace("`", ""), (name, remark)
        for other in loading.not_comparable_with(rules):
            assert f'href="./{other}.html"' in text
        scored = {entry.id for entry in rules.scored}
        for entry in rules.classes:
            group = f"<td>{entry.group}</td>\n" if entry.group else ""
            ignored = "" if entry.id in scored else "ignored"
            assert f"<td>{entry.id}</td>\n<td>{entry.name}</td>\n{group}<td>{ignored}</td>" in text
        assert rules.digest in shown


def test_each_method_page_has_every_setting_preset_and_published_row(pages: dict[str, str]) -> None:
    for name in registry.BUILT_IN["method"]:
        text, result = pages[f"{METHODS}/{name}.md"], summary_of(name)
        assert all(f"<td><code>{'.'.join(path)}</code></td>" in text for path, _ in flatten(result["settings"]))
        assert all(f"<td><code>{name}@{preset}</code></td>" in text for preset in result["presets"])
        shown = words(text)
        assert all(
            result[field] in shown for field in ("summary", "paper", "source", "licence", "status") if result[field]
        )
        for figure in figures_of(method=name):
            assert f"<td>{', '.join(f'{metric} {value}' for metric, value in figure.values.items())}</td>" in text


def test_reference_lists_every_public_name(pages: dict[str, str]) -> None:
    assert sorted(re.findall(r"^::: su3d_bench\.(\w+)$", pages[API], re.MULTILINE)) == sorted(su3d_bench.__all__)


def test_hostile_text_of_a_protocol_file_is_never_markup(tmp_path: Path) -> None:
    text = (ROOT / "su3d_bench/metrics/rules/rooms/rooms-instance.toml").read_text()
    hostile = "</td></table><script>alert(1)</script><img src=x onerror=y> `<b>` **"
    text = text.replace('name = "rooms-instance"', f"name = '{hostile} name'")
    text = re.sub(r'summary = ".*"', f"summary = '{hostile}'", text)
    text = text.replace('prompt = "a {} in a scene"  # ours', f"prompt = '{{}} {hostile}'  # {hostile}")
    text = text.replace('classes = "rooms"  # ours', f"classes = [[1, '{hostile}']]  # {hostile}")
    text = re.sub(r"ignore = \[.*?\]", "ignore = []", text)
    file = tmp_path / "own.toml"
    file.write_text(f"# {hostile}\n\n{text}")
    page = protocol_page(loading.load_protocol(str(file)), [file])
    assert set(_Tags(page).found) <= TAGS
    assert page.count("alert(1)") >= 6
    assert {name for _, attributes in _Tags(page).attributes for name, _ in attributes} <= {"href", "class"}


class _Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.attributes: list[tuple[str, list[tuple[str, str | None]]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.append(tag)
        self.attributes.append((tag, attributes))


def test_every_page_is_in_the_navigation_once(pages: dict[str, str]) -> None:
    docs = ROOT / "docs"
    there = {str(path.relative_to(docs)) for path in docs.rglob("*.md")} | set(pages)
    there |= set(ROOT_PAGES.values())
    placed = site_hooks._leaves(filled(_settings()["nav"], there))
    assert sorted(placed) == sorted(there)


def _settings() -> dict[str, Any]:
    """The settings of mkdocs.yml, without its Python object."""

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        pass

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda *_: None)
    settings: dict[str, Any] = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
    return settings


def test_site_loads_nothing_from_the_network() -> None:
    settings = _settings()
    assert settings["theme"]["font"] is False
    assert "offline" in settings["plugins"]
    assert all((ROOT / "docs" / name).is_file() for name in [*settings["extra"]["polyfills"], *settings["extra_css"]])


def test_site_check_finds_dead_links_and_external_resources(tmp_path: Path) -> None:
    (tmp_path / "a.css").write_text("b { background: url( 'https://example.org/x.png') }")
    (tmp_path / "b.html").write_text('<h1 id="there">b</h1>')
    (tmp_path / "index.html").write_text(
        '<a href="b.html#there">fine</a><a href="https://example.org/">fine</a><a href="b.html#gone">1</a>'
        '<a href="gone.html">2</a><a href="#no">3</a><script src="//example.org/x.js"></script><img src="gone.png">'
        '<link href="https://example.org/x.css"><style>@import "x"</style><img src="data:image/png;base64,">'
    )
    found = [
        line
        for line in runpy.run_path(str(ROOT / ".ci/site.py"))["faults_of"](tmp_path)
        if not line.startswith("reference/")
    ]
    assert found == [
        "index.html: b.html#gone: the page has no such anchor",
        "index.html: gone.html does not exist",
        "index.html: #no: the page has no such anchor",
        "index.html: loads //example.org/x.js",
        "index.html: gone.png does not exist",
        "index.html: loads https://example.org/x.css",
        "index.html: a style loads from elsewhere",
        "a.css: loads from elsewhere",
    ]


# conversion of texts for the site

HERE = {"su3d_bench/core/types.py", "action.yml", "benchmarks/README.md"}


def as_site(text: str, page: str = "docs/running/gpu.md", repository: str | None = None) -> str:
    return for_site(text, page, HERE.__contains__, repository)


def test_docstring_examples_of_site_tools_pass() -> None:
    assert doctest.testmod(site_hooks).failed == doctest.testmod(site_text).failed == 0


@pytest.mark.parametrize(
    ("page", "link", "there"),
    [
        ("docs/running/gpu.md", "[a](clusters.md#x)", "[a](clusters.md#x)"),
        ("docs/running/gpu.md", "[a](../../README.md)", f"[a](../{ROOT_PAGES['README.md']})"),
        ("docs/running/gpu.md", "[a](../../CONTRIBUTING.md#rules)", "[a](../contributing.md#rules)"),
        (
            "README.md",
            "[`a`](docs/running/gpu.md) ![p](docs/pictures/p.png)",
            "[`a`](running/gpu.md) ![p](pictures/p.png)",
        ),
        ("README.md", "[a](https://example.org/x)", "[a](https://example.org/x)"),
        ("README.md", "[a](#licence)", "[a](#licence)"),
    ],
)
def test_links_are_converted_to_pages_of_the_site(page: str, link: str, there: str) -> None:
    assert as_site(f"See {link}.", page) == f"See {there}."


def test_link_to_code_is_a_path_without_a_repository_url() -> None:
    text = "[core/types.py](../../su3d_bench/core/types.py), [`action.yml`](../../action.yml)"
    text += ", [the check](../../action.yml)"
    assert as_site(text) == "`su3d_bench/core/types.py`, `action.yml`, the check (`action.yml`)"
    assert as_site("[the check](../../action.yml#L3)", repository="https://example.org/a/b") == (
        "[the check](https://example.org/a/b/blob/main/action.yml#L3)"
    )


@pytest.mark.parametrize("link", ["[a](../../gone.py)", "[a](../../../outside.md)"])
def test_dead_link_is_kept_for_the_build_to_reject(link: str) -> None:
    assert as_site(link) == link
    assert as_site(link, repository="https://example.org/a/b") == link


def test_hostile_text_is_never_markup_on_the_site() -> None:
    hostile = '</p><script>alert(1)</script>\n\n# x `<b>` ![y](z) https://a.b/"><script> \x1b[31m\u202e'
    for shown in (plain(hostile), prose(hostile), heading(hostile)):
        assert "<script" not in shown and "<b>" not in shown and "\n" not in shown
        assert "\x1b" not in shown and "\u202e" not in shown
    assert "![y]" not in heading(hostile)


def test_docstring_example_becomes_a_code_block() -> None:
    text = "One.\n\n    Two:\n    >>> f(\n    ...     1)\n    2\n    >>> 3\n    3\n\n    ``a`` > b.\n    "
    assert with_examples(text) == "One.\n\nTwo:\n\n```pycon\n>>> f(\n...     1)\n2\n>>> 3\n3\n```\n\n``a`` > b."
    assert with_examples("No example, a > b.") == "No example, a > b."
