"""A sweep in the HTML report and in a registry: its cells are no methods, but curves, pictures and changes."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from painted_runs import metrics, painted_page
from PIL import Image
from registry_bundles import painted_bundle, read_bundle, rewrite_bundle

from su3d_bench.analysis.sweeps import without_cells
from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.reproducing.registry import rows_of_bundle
from su3d_bench.robustness.page import page_sweeps
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.verify import read_checked
from su3d_bench.store.records import UnscoredRecord

CLEAN = ["collector", "collector@drop=1"]
CONDITIONS = ["masks/dropped/1", "masks/dropped/5", "pose/jumps/5"]
PROTOCOL = "rooms-instance"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sweep ``runs/sweep`` of two methods under three conditions, and its bundle."""
    folder = tmp_path_factory.mktemp("sweep")
    suffixes = ["", *(f"~{one}" for one in CONDITIONS)]
    painted_bundle(folder, "sweep", [f"{one}{suffix}" for suffix in suffixes for one in ("", "@drop=1")], scenes="ab")
    return folder


@pytest.fixture(scope="module")
def data(made: Path) -> dict[str, Any]:
    page = painted_page(made / "runs" / "sweep", made / "page.html")
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    found: dict[str, Any] = json.loads(text)
    return found


def values_of(run: Path) -> dict[str, float]:
    """Method -> the first headline metric in ``metrics.json``."""
    results = [one for one in metrics(str(run))["results"] if one["protocol"] == PROTOCOL]
    return {one["method"]: one["result"]["metrics"][one["headline"][0]] for one in results}


def test_page_lists_only_clean_methods_of_a_sweep(data: dict[str, Any]) -> None:
    assert data["runs"][0]["methods"] == CLEAN
    for part in ("results", "timing", "errors", "maps"):
        assert {one["method"] for one in data[part]} == set(CLEAN), part
    assert len(data["comparisons"]) == 1


def test_reasons_why_cells_were_not_scored_are_left_out(made: Path) -> None:
    run = read_checked(made / "runs" / "sweep")
    unscored = tuple(UnscoredRecord("painted/a", method, PROTOCOL, "no instances") for method in run.methods)
    clean = without_cells(replace(run, record=replace(run.record, unscored=unscored)))
    assert [reason.method for reason in clean.record.unscored] == CLEAN


def test_page_has_the_scores_of_every_cell(made: Path, data: dict[str, Any]) -> None:
    (sweep,) = data["robustness"]
    assert (sweep["run"], sweep["n_cells"], sweep["reason"]) == (0, 6, None)
    assert sweep["conditions"] == {
        "masks/dropped/1": ["masks/dropped", 1],
        "masks/dropped/5": ["masks/dropped", 5],
        "pose/jumps/5": ["pose/jumps", 5],
    }
    values = values_of(made / "runs" / "sweep")
    (result,) = [one for one in sweep["results"] if one["protocol"] == PROTOCOL]
    for method in result["methods"]:
        for name, cell in method["cells"].items():
            assert cell["value"] == pytest.approx(values[f"{method['method']}~{name.replace('/', '-')}"])
    assert values["collector~masks-dropped-5"] < values["collector"]


def test_page_has_a_small_picture_of_one_scene_at_each_severity(data: dict[str, Any]) -> None:
    (sweep,) = data["robustness"]
    assert (sweep["scene"], sweep["no_pictures"]) == ("painted/a", None)
    shown = {name: [text for text, _ in one["pictures"]] for name, one in sweep["corruptions"].items()}
    assert shown == {"masks/dropped": ["0: 0", "1: 0.1", "5: 0.8"], "pose/jumps": ["0: 0", "5: 24"]}
    for name, one in sweep["corruptions"].items():
        jpegs = [base64.b64decode(jpeg) for _, jpeg in one["pictures"]]
        assert all(Image.open(io.BytesIO(jpeg)).size == (160, 120) for jpeg in jpegs)
        assert name == "masks/dropped" or jpegs[0] != jpegs[-1]  # no mask is found in so small an image


def test_sweep_whose_frames_are_gone_has_curves_and_the_reason(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(run: FinishedRun, scene: str) -> Any:
        raise DataError(f"{scene}: is gone")

    monkeypatch.setattr(FinishedRun, "dataset", gone)
    (sweep,) = page_sweeps([made / "runs" / "sweep"])
    assert sweep["no_pictures"] == "painted/a: is gone"
    assert not any(one["pictures"] for one in sweep["corruptions"].values())
    assert len(sweep["results"]) == 2


def test_registry_has_one_row_per_clean_method_with_its_changes(made: Path) -> None:
    rows, refused = rows_of_bundle(made / "sweep.zip")
    assert refused == []
    of_protocol = [row for row in rows if row.protocol == PROTOCOL]
    assert [row.method for row in of_protocol] == CLEAN
    values = values_of(made / "runs" / "sweep")
    for row in of_protocol:
        dropped = [values[f"{row.method}~masks-dropped-{severity}"] - values[row.method] for severity in (1, 5)]
        jumps = values[f"{row.method}~pose-jumps-5"] - values[row.method]
        assert dict(row.changes) == pytest.approx({"masks": sum(dropped) / 2, "pose": jumps})


def test_registry_site_shows_the_changes(made: Path, tmp_path: Path) -> None:
    (tmp_path / "bundles").mkdir()
    (tmp_path / "bundles" / "sweep.zip").write_bytes((made / "sweep.zip").read_bytes())
    assert main(["dev", "registry", "build", str(tmp_path), "--out", str(tmp_path / "site"), "--quiet"]) == 0
    value = json.loads((tmp_path / "site" / "registry.json").read_text())
    assert [one["name"] for one in value["methods"]] == CLEAN
    assert all([family for family, _ in row["changes"]] == ["masks", "pose"] for row in value["boards"][0]["rows"])
    index = (tmp_path / "site" / "index.html").read_text()
    assert "change under corruptions, points" in index
    assert re.search(r"<td[^>]*>masks -\d", index)


def test_leaderboard_ranks_only_clean_methods(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["report", "leaderboard", str(made / "runs"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["method"] for board in found["boards"] for row in board} == set(CLEAN)


def test_method_with_wrong_numbers_in_a_cell_is_rejected(made: Path, tmp_path: Path) -> None:
    files, manifest = read_bundle(made / "sweep.zip")
    record = json.loads(files["runs/sweep/metrics.json"])
    for one in record["results"]:
        if (one["method"], one["protocol"]) == ("collector~masks-dropped-5", PROTOCOL):
            one["result"]["metrics"][one["headline"][0]] = 0.99
    files["runs/sweep/metrics.json"] = json.dumps(record).encode()
    rows, refused = rows_of_bundle(rewrite_bundle(tmp_path / "sweep.zip", files, manifest))
    assert [one.what for one in refused] == [f"collector / {PROTOCOL}"]
    assert "collector" not in [row.method for row in rows if row.protocol == PROTOCOL]
