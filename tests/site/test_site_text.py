"""Texts on their way into the documentation site."""

from __future__ import annotations

import doctest

import pytest
import site_text
from site_text import ROOT_PAGES, for_site, heading, plain, prose, with_examples

HERE = {"su3d_bench/core/types.py", "action.yml", "benchmarks/README.md"}


def as_site(text: str, page: str = "docs/running/gpu.md", repository: str | None = None) -> str:
    return for_site(text, page, HERE.__contains__, repository)


def test_the_examples_of_the_texts_hold() -> None:
    assert doctest.testmod(site_text).failed == 0


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
def test_links_lead_to_pages_of_the_site(page: str, link: str, there: str) -> None:
    assert as_site(f"See {link}.", page) == f"See {there}."


def test_a_link_out_of_the_docs_is_a_path_where_no_code_host_is_known() -> None:
    text = "[core/types.py](../../su3d_bench/core/types.py), [`action.yml`](../../action.yml)"
    text += ", [the gate](../../action.yml)"
    assert as_site(text) == "`su3d_bench/core/types.py`, `action.yml`, the gate (`action.yml`)"
    assert as_site("[the gate](../../action.yml#L3)", repository="https://example.org/a/b") == (
        "[the gate](https://example.org/a/b/blob/main/action.yml#L3)"
    )


@pytest.mark.parametrize("link", ["[a](../../gone.py)", "[a](../../../outside.md)"])
def test_a_link_to_what_is_not_there_stays_for_the_build_to_refuse(link: str) -> None:
    assert as_site(link) == link
    assert as_site(link, repository="https://example.org/a/b") == link


def test_no_text_acts_on_the_page() -> None:
    hostile = '</p><script>alert(1)</script>\n\n# x `<b>` ![y](z) https://a.b/"><script> \x1b[31m\u202e'
    for shown in (plain(hostile), prose(hostile), heading(hostile)):
        assert "<script" not in shown and "<b>" not in shown and "\n" not in shown
        assert "\x1b" not in shown and "\u202e" not in shown
    assert "![y]" not in heading(hostile)


def test_an_example_is_a_block_of_code_and_the_rest_of_the_text_as_it_was() -> None:
    text = "One.\n\n    Two:\n    >>> f(\n    ...     1)\n    2\n    >>> 3\n    3\n\n    ``a`` > b.\n    "
    assert with_examples(text) == "One.\n\nTwo:\n\n```pycon\n>>> f(\n...     1)\n2\n>>> 3\n3\n```\n\n``a`` > b."
    assert with_examples("No example, a > b.") == "No example, a > b."
