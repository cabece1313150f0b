"""What papers report, as data: digit for digit, with source and set-up, in a strict form."""

from __future__ import annotations

from pathlib import Path

import pytest

from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols import load_protocol
from su3d_bench.reports.tables.published import Figure, figures_of, published, read_published

WHOLE = """
[[figure]]
method = "a"
dataset = "replica"
setup = "8 scenes"
source = "A paper, Table I"
values = { AP = "1.0" }
"""


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


def test_every_protocol_that_a_figure_names_exists() -> None:
    for name in {one.protocol for one in published() if one.protocol is not None}:
        assert load_protocol(name).name == name


def test_no_row_stands_twice() -> None:
    keys = [(one.method, one.dataset, one.source, one.setup, one.row, tuple(one.values)) for one in published()]
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize(("text", "shown"), [(".231", "23.1"), ("0.9", "90"), (".30", "30"), ("1.0", "100")])
def test_a_fraction_is_shown_in_per_cent_with_the_decimals_it_was_printed_with(text: str, shown: str) -> None:
    one = Figure(method="a", dataset="b", setup="c", source="d", unit="fraction", values={"AP": text})
    assert one.percent("AP") == shown
    assert one.percent("AP50") is None


def test_a_percentage_stays_as_printed() -> None:
    assert Figure(method="a", dataset="b", setup="c", source="d", values={"AP": "18.70"}).percent("AP") == "18.70"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (WHOLE.replace("setup", "set-up"), "figure 1: set-up: extra inputs are not permitted"),
        (WHOLE.replace('setup = "8 scenes"\n', ""), "figure 1: setup: field required"),
        (WHOLE.replace('"1.0"', "1.0"), "figure 1: values.AP = 1.0: input should be a valid string"),
        (WHOLE.replace('"1.0"', '"about 1"'), "figure 1: values.AP = 'about 1': string should match pattern"),
        (WHOLE.replace('{ AP = "1.0" }', "{}"), "figure 1: values = {}: dictionary should have at least 1 item"),
        (
            WHOLE + 'table = "VI"\n',
            "figure 1: table = 'VI': input should be 'I', 'II', 'III', 'IV', 'V' or 'reasoning'",
        ),
        (WHOLE.replace('"A paper', '"A \\u001b[31m'), ""),
        ("figure = 3", "'figure' is no list; write each as [[figure]]"),
        ("figure = [", "is no TOML"),
        ("more = 1\n" + WHOLE, "more: extra inputs are not permitted"),
        ("x = " + "[" * 3000, "is no TOML"),
    ],
)
def test_a_file_of_another_form_is_one_line_that_names_the_place(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    if not reason:
        assert len(read_published(path)) == 1  # a control character is text here; what shows it escapes it
        return
    with pytest.raises(ConfigError) as caught:
        read_published(path)
    assert str(caught.value).startswith("mine.toml: ")
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_or_a_giant_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        read_published(tmp_path / "none.toml")
    (tmp_path / "big.toml").write_bytes(b"#" * (1 << 20) + b"\n")
    with pytest.raises(ConfigError, match="expected at most"):
        read_published(tmp_path / "big.toml")
