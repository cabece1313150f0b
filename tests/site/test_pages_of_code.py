"""Pages that are made from the code, and the place of every page in the navigation."""

from __future__ import annotations

import doctest
import importlib.util
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any

import pages_of_code
import pytest
import site_hooks
import yaml
from pages_of_code import API, METHODS, PROTOCOLS, protocol_page, told_of
from places import ROOT
from site_hooks import filled
from site_text import ROOT_PAGES

import su3d_bench
from su3d_bench.core import registry
from su3d_bench.core.config import flatten
from su3d_bench.metrics.protocols.loading import (
    load_protocol,
    not_comparable_with,
    protocol_names,
    remarks_of,
    rules_files,
)
from su3d_bench.reports.tables.paper import figures_of

TAGS = {"p", "div", "table", "thead", "tbody", "tr", "th", "td", "code", "a", "details", "summary", "pre"}


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return pages_of_code.made_pages()


def words(page: str) -> str:
    """The text of a page without its tags."""
    return " ".join(unescape(re.sub(r"<[^>]+>", "", page)).split())


def test_every_protocol_has_a_page_with_every_rule_source_and_class(pages: dict[str, str]) -> None:
    for name in protocol_names():
        rules, text = load_protocol(name), pages[f"{PROTOCOLS}/{name}.md"]
        shown = words(text)
        for path, value in flatten(rules.model_dump(mode="json", exclude={"classes", "not_comparable_with"})):
            assert ".".join(path) in shown or path == ("summary",)
            assert not isinstance(value, str) or value in shown, (name, path)
        for remark in (line for lines in remarks_of(rules_files(name)).values() for line in lines):
            assert " ".join(remark.replace("`", "").split()) in shown.replace("`", ""), (name, remark)
        for other in not_comparable_with(rules):
            assert f'href="./{other}.html"' in text
        for entry in rules.classes:
            group = f"<td>{entry.group}</td>\n" if entry.group else ""
            ignored = "ignored" if entry not in rules.scored else ""
            assert f"<td>{entry.id}</td>\n<td>{entry.name}</td>\n{group}<td>{ignored}</td>" in text
        assert rules.digest in shown


def test_every_method_has_a_page_with_every_setting_preset_and_published_row(pages: dict[str, str]) -> None:
    for name in registry.BUILT_IN["method"]:
        text, told = pages[f"{METHODS}/{name}.md"], told_of(name)
        assert all(f"<td><code>{'.'.join(path)}</code></td>" in text for path, _ in flatten(told["settings"]))
        assert all(f"<td><code>{name}@{preset}</code></td>" in text for preset in told["presets"])
        shown = words(text)
        assert all(told[field] in shown for field in ("summary", "paper", "source", "licence", "status") if told[field])
        for figure in figures_of(method=name):
            assert f"<td>{', '.join(f'{metric} {value}' for metric, value in figure.values.items())}</td>" in text


def test_every_public_name_has_its_place_in_the_reference(pages: dict[str, str]) -> None:
    assert sorted(re.findall(r"^::: su3d_bench\.(\w+)$", pages[API], re.MULTILINE)) == sorted(su3d_bench.__all__)


def test_nothing_in_a_protocol_file_acts_on_its_page(tmp_path: Path) -> None:
    text = (ROOT / "su3d_bench/metrics/rules/rooms/rooms-instance.toml").read_text()
    hostile = "</td></table><script>alert(1)</script><img src=x onerror=y> `<b>` **"
    text = text.replace('name = "rooms-instance"', f"name = '{hostile} name'")
    text = re.sub(r'summary = ".*"', f"summary = '{hostile}'", text)
    text = text.replace('prompt = "a {} in a scene"  # ours', f"prompt = '{{}} {hostile}'  # {hostile}")
    text = text.replace('classes = "rooms"  # ours', f"classes = [[1, '{hostile}']]  # {hostile}")
    text = re.sub(r"ignore = \[.*?\]", "ignore = []", text)
    file = tmp_path / "own.toml"
    file.write_text(f"# {hostile}\n\n{text}")
    page = protocol_page(load_protocol(str(file)), [file])
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


def test_every_page_has_one_place_in_the_navigation(pages: dict[str, str]) -> None:
    docs = ROOT / "docs"
    there = {str(path.relative_to(docs)) for path in docs.rglob("*.md")} | set(pages)
    there |= set(ROOT_PAGES.values())
    placed = site_hooks._leaves(filled(_settings()["nav"], there))
    assert sorted(placed) == sorted(there)
    assert sorted(site_hooks._leaves(filled(_settings()["nav"], there | {"tutorials/new.md", "new.md"}))) == sorted(
        there | {"tutorials/new.md", "new.md"}
    )


def test_the_examples_of_the_hooks_hold() -> None:
    assert doctest.testmod(site_hooks).failed == 0


def _settings() -> dict[str, Any]:
    """mkdocs.yml, whose one value for mkdocs alone is left out."""

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        pass

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda *_: None)
    settings: dict[str, Any] = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
    return settings


def test_the_site_asks_for_nothing_that_is_elsewhere() -> None:
    settings = _settings()
    assert settings["theme"]["font"] is False
    assert "offline" in settings["plugins"]
    assert all((ROOT / "docs" / name).is_file() for name in [*settings["extra"]["polyfills"], *settings["extra_css"]])


def _check() -> ModuleType:
    spec = importlib.util.spec_from_file_location("check_of_the_site", ROOT / ".ci/site.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_check_of_a_site_finds_dead_links_and_what_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "a.css").write_text("b { background: url( 'https://example.org/x.png') }")
    (tmp_path / "b.html").write_text('<h1 id="there">b</h1>')
    (tmp_path / "index.html").write_text(
        '<a href="b.html#there">fine</a><a href="https://example.org/">fine</a><a href="b.html#gone">1</a>'
        '<a href="gone.html">2</a><a href="#no">3</a><script src="//example.org/x.js"></script><img src="gone.png">'
        '<link href="https://example.org/x.css"><style>@import "x"</style><img src="data:image/png;base64,">'
    )
    found = [line for line in _check().faults_of(tmp_path) if not line.startswith("reference/")]
    assert found == [
        "index.html: b.html#gone: the page has no such place",
        "index.html: gone.html is not there",
        "index.html: #no: the page has no such place",
        "index.html: loads //example.org/x.js",
        "index.html: gone.png is not there",
        "index.html: loads https://example.org/x.css",
        "index.html: a style loads from elsewhere",
        "a.css: loads from elsewhere",
    ]


def test_the_check_of_a_site_misses_pages_and_names(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("")
    found = set(_check().faults_of(tmp_path))
    assert {"reference/protocols/rooms-instance.html is missing", "reference/methods/oracle.html is missing"} <= found
    assert {f"reference/api.html lacks {name}" for name in su3d_bench.__all__} <= found
