"""Published numbers: digit for digit as in the papers, and their conversion to per cent."""

from __future__ import annotations

import pytest

from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reports.tables.paper import Figure, published


def rows(table: str) -> dict[tuple[str, str, str | None], tuple[str, ...]]:
    return {(one.method, one.dataset, one.row): tuple(one.values.values()) for one in published() if one.table == table}


def test_tables_ii_and_iii_match_the_paper() -> None:
    assert rows("II") == {
        ("conceptfusion", "replica", None): ("24.2", "31.3"),
        ("conceptfusion-sam", "replica", None): ("31.5", "38.7"),
        ("conceptgraphs", "replica", None): ("40.6", "36.0"),
        ("conceptgraphs-detector", "replica", None): ("38.7", "35.4"),
        ("opensu3d", "replica", None): ("42.6", "40.9"),
    }
    assert rows("III") == {
        ("openmask3d", "replica", None): ("13.0", "18.4", "24.2"),
        ("openmask3d-segment3d", "replica", None): ("18.7",),
        ("opensu3d", "replica", None): ("8.9", "19.6", "27.7"),
    }


def test_tables_iv_and_v_and_reasoning_match_the_paper() -> None:
    assert rows("IV")["opensu3d", "scannet", "scheme4"] == ("0.9", "0.7", "0.7", "0.7")
    assert len(rows("IV")) == 8
    assert rows("V")["opensu3d", "replica", "llm"] == ("0.87", "0.88")
    reasoning = [one.values["reasoning-accuracy"] for one in published() if "reasoning-accuracy" in one.values]
    assert reasoning == ["0.83", "0.68"]


def test_protocols_of_published_numbers_exist() -> None:
    for name in {one.protocol for one in published() if one.protocol is not None}:
        assert load_protocol(name).name == name


@pytest.mark.parametrize(("text", "shown"), [(".231", "23.1"), ("0.9", "90"), (".30", "30"), ("1.0", "100")])
def test_fraction_is_shown_in_per_cent_with_its_printed_decimals(text: str, shown: str) -> None:
    one = Figure(method="a", dataset="b", setup="c", source="d", unit="fraction", values={"AP": text})
    assert one.percent("AP") == shown
    assert one.percent("AP50") is None
