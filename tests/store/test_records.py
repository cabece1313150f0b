"""The records of a run: they round-trip, and invalid values are reported."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.files.atomic import write_json
from su3d_bench.store import records
from su3d_bench.store.records import MetricsRecord, MidwayRecord, NumbersRecord, ResultRecord, plain, read_record

VALUES = NumbersRecord(
    scenes=("d/a",),
    metrics={"mAcc": 0.5, "n_classes": 3},
    intervals={},
    per_scene={"d/a": {"mAcc": None}},
    per_class={},
)
RESULT = ResultRecord(
    method="m",
    protocol="p",
    version=1,
    kind="semantic",
    headline=("mAcc",),
    profile=None,
    caveat=None,
    encoder=None,
    encoder_digest=None,
    n_planned=1,
    failed=(),
    unscored=(),
    ceiling=None,
    result=VALUES,
)


@pytest.mark.parametrize("anytime", [None, (), (MidwayRecord(0.5, {"mAcc": 0.25}),)])
def test_metrics_record_round_trips(tmp_path: Path, anytime: tuple[MidwayRecord, ...] | None) -> None:
    metrics = MetricsRecord(limit=0, results=(replace(RESULT, anytime=anytime),))
    write_json(tmp_path / "metrics.json", plain(metrics))
    assert read_record(MetricsRecord, tmp_path / "metrics.json", "run") == metrics
    (written,) = json.loads((tmp_path / "metrics.json").read_text())["results"]
    assert ("anytime" in written) == (anytime is not None)
    assert '"n_classes": 3\n' in (tmp_path / "metrics.json").read_text()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"results": []}, "run: metrics.json: limit is invalid (Field required); run it again"),
        ({"limit": 0, "results": 5}, "run: metrics.json: results is invalid ("),
        ([], "run: metrics.json: it is invalid ("),
    ],
)
def test_damaged_record_is_a_one_line_error_that_names_the_field(tmp_path: Path, value: object, message: str) -> None:
    write_json(tmp_path / "metrics.json", value)
    with pytest.raises(StoreError, match=f"^{re.escape(message)}"):
        read_record(MetricsRecord, tmp_path / "metrics.json", "run")


@pytest.mark.parametrize(
    ("changed", "printed"),
    [
        ({"n_scenes": -1}, "result.n_scenes is invalid ("),
        ({"intervals": {"mAcc": (0.5, 100.0)}}, "result.intervals.mAcc.1 is invalid ("),
        ({"n_predictions": {"d/a": -3}}, "result.n_predictions.d/a is invalid ("),
    ],
)
def test_impossible_metric_value_is_reported(changed: dict[str, Any], printed: str, tmp_path: Path) -> None:
    result = replace(RESULT, result=replace(VALUES, **changed))
    write_json(tmp_path / "metrics.json", plain(MetricsRecord(limit=0, results=(result,))))
    with pytest.raises(StoreError) as caught:
        read_record(MetricsRecord, tmp_path / "metrics.json", "run")
    assert printed in str(caught.value)


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("update,total_ms\n0,-1.0\n", "has -1 and 0; expected 0 to 1e+18"),
        ("update,total_ms\n0,7e300\n", "has 0 and 7e+300; expected 0 to"),
        ("total_ms,total_ms\n1,2\n", "has two columns with the same name"),
    ],
)
def test_invalid_updates_table_is_rejected(text: str, printed: str, tmp_path: Path) -> None:
    (tmp_path / "updates.csv").write_text(text)
    with pytest.raises(DataError) as caught:
        records.read_updates(tmp_path / "updates.csv", "run")
    assert printed in str(caught.value)
