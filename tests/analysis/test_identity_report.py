"""``report identity``: ids of successive maps of a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from painted_runs import COLLECTOR, painted_run, see_painted
from places import SCENES

from su3d_bench.cli.main import main

RENAMER = f"{SCENES}/painted.py:Renamer"


def test_changed_ids_halve_the_association(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three maps of the same objects with the ids a, a, b: associations 2/3, 2/3 and 1/3, identity in 2 of 3."""
    run = painted_run(tmp_path / "run", "--anytime-every", "2", methods=(COLLECTOR, RENAMER, "oracle"), scenes="a")
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main(["report", "identity", str(run), "--json"]) == 0
    collector, renamer, oracle = json.loads(capsys.readouterr().out)["methods"]
    assert (collector["values"], collector["reason"]) == (None, "its ids do not persist")
    assert (oracle["values"], oracle["reason"]) == (None, "it uses no frames, so its map does not change")
    assert renamer["n_maps"] == 3
    values = renamer["values"]
    assert values["AssA"] == pytest.approx(5 / 9)
    assert values["AssA by object"] == pytest.approx(5 / 9)
    assert values["IDF1"] == pytest.approx(2 / 3)
    assert values["changed ids"] == pytest.approx(1 / 2)


def test_unknown_method_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = painted_run(tmp_path / "run", "--anytime-every", "2", scenes="a")
    capsys.readouterr()
    assert main(["report", "identity", str(run), "--methods", "colector"]) == 2
    assert "has no method 'colector'; did you mean 'collector'" in capsys.readouterr().err


def test_run_without_intermediate_maps_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = painted_run(tmp_path / "run", scenes="a")
    capsys.readouterr()
    assert main(["report", "identity", str(run)]) == 2
    assert "has no intermediate maps; run with --anytime-every N" in capsys.readouterr().err
