"""What papers report, as data: digit for digit, with source and set-up, in a strict form."""

from __future__ import annotations

import pytest

from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reports.tables.paper import Figure, figures_of, published


def rows(table: str) -> dict[tuple[str, str, str | None], tuple[str, ...]]:
    return {(one.method, one.dataset, one.row): tuple(one.values.values()) for one in published() if one.table == table}


def test_tables_ii_and_iii_of_the_paper_are_as_printed() -> None:
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


def test_the_papers_own_contradictions_are_kept_and_said() -> None:
    ablation = rows("I")
    assert ablation["opensu3d", "replica", "m=5"] == ablation["opensu3d", "replica", "k=3"]
    assert ablation["opensu3d", "replica", "m=5"][:2] == ("40.8", "44.7")
    quoted = next(one for one in figures_of(method="conceptgraphs-detector") if one.table == "II")
    own = next(one for one in figures_of(method="conceptgraphs-detector") if one.source.startswith("ConceptGraphs"))
    assert (quoted.values["F-mIoU"], own.values["F-mIoU"]) == ("35.4", "35.82")
    assert quoted.read_from == "quoted"
    assert quoted.note is not None and "35.82" in quoted.note


def test_tables_iv_and_v_and_reasoning_are_as_printed() -> None:
    assert rows("IV")["opensu3d", "scannet", "scheme4"] == ("0.9", "0.7", "0.7", "0.7")
    assert len(rows("IV")) == 8
    assert rows("V")["opensu3d", "replica", "llm"] == ("0.87", "0.88")
    reasoning = [one.values["reasoning-accuracy"] for one in published() if "reasoning-accuracy" in one.values]
    assert reasoning == ["0.83", "0.68"]


def test_each_number_is_attributed_to_where_it_was_read() -> None:
    sources = {(one.method, one.dataset): one for one in published() if one.table is None}
    assert "issue 22" in sources["openmask3d", "scannet200"].source
    assert "issue 37" in sources["Open3DIS (2D and 3D)", "scannet200"].source
    yolo = sources["Open-YOLO 3D", "scannet200"]
    assert "README for AP, third-party" in yolo.source and "does not print AP50 and AP25" in (yolo.note or "")
    of_paper = sources["OpenIns3D, snapshots", "replica"]
    assert tuple(of_paper.values.values()) == ("13.6", "18.0", "19.7")
    of_code = sources["OpenIns3D, snapshots, released code", "replica"]
    assert tuple(of_code.values.values()) == ("15.4", "19.5", "25.2") and "13.6" in (of_code.note or "")
    quoting = [one for one in published() if one.source.startswith("OpenIns3D's README, quoting")]
    assert {one.dataset for one in quoting} == {"replica"}


def test_every_protocol_that_a_figure_names_exists() -> None:
    for name in {one.protocol for one in published() if one.protocol is not None}:
        assert load_protocol(name).name == name


@pytest.mark.parametrize(("text", "shown"), [(".231", "23.1"), ("0.9", "90"), (".30", "30"), ("1.0", "100")])
def test_a_fraction_is_shown_in_per_cent_with_the_decimals_it_was_printed_with(text: str, shown: str) -> None:
    one = Figure(method="a", dataset="b", setup="c", source="d", unit="fraction", values={"AP": text})
    assert one.percent("AP") == shown
    assert one.percent("AP50") is None
