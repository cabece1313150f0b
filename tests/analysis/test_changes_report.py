"""``report changes``: maps of a scene in which an object vanishes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import COLOURS, Painted
from painted_runs import COLLECTOR, painted_run, see_painted

from su3d_bench.cli.main import main
from su3d_bench.core.types import Frame, GroundTruth, SceneChange

CHANGE = 3


class Vanishing(Painted):
    """Painted scenes whose first object is taken away before frame 3."""

    name = "vanishing"

    def frame(self, scene: str, index: int) -> Frame:
        frame = super().frame(scene, index)
        is_gone = (frame.rgb == COLOURS[0]).all(axis=-1) & (index >= CHANGE)
        rgb = np.where(is_gone[..., None], COLOURS[3], frame.rgb)
        return replace(frame, rgb=rgb, depth_m=np.where(is_gone, np.float32(3), frame.depth_m))

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        truth = super().ground_truth(scene, variant)
        points, instance = truth.points.copy(), np.where(truth.instance == 1, 4, truth.instance).astype(np.int32)
        points[truth.instance == 1, 2] = 3
        return replace(
            truth, points=points, instance=instance, semantic=np.array(truth.labels.ids, np.int32)[instance - 1]
        )

    def change(self, scene: str) -> SceneChange:
        return SceneChange(CHANGE, super().ground_truth(scene, "mesh-vertices"), left=(1,), came=())


def report(run: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> Any:
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main(["report", "changes", str(run), *(["--json"] if code == 0 else [])]) == code
    answer = capsys.readouterr()
    return json.loads(answer.out)["methods"] if code == 0 else answer.err


def test_map_that_never_removes_keeps_a_ghost_and_the_oracle_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six updates of a chair, a sofa, a table and a wall, the chair gone from the fourth on."""
    monkeypatch.setattr("painted_runs.PAINTED", f"{__file__}:Vanishing")
    run = painted_run(tmp_path / "run", "--anytime-every", "1", methods=(COLLECTOR, "oracle"), scenes="a")
    collector, oracle = report(run, capsys)
    found, perfect = collector["values"], oracle["values"]
    assert (found["ghosts"], found["ghosts online"], found["removed"], found["found"]) == (1 / 4, 3 / 12, 0, None)
    assert (found["ObjectPrecision"], found["ObjectRecall"]) == ((3 * 3 + 3 * 2) / (6 * 3), 1)
    assert found["DisappearedRecall"] == 0
    assert "t-AP" not in found, "its ids do not persist"
    assert (perfect["where then"], found["where now"], perfect["where now"]) == (1, None, None)
    assert (perfect["ghosts"], perfect["removed"], perfect["updates until removed"]) == (0, 1, 0)
    assert [perfect[name] for name in ("ObjectF1", "DisappearedF1", "ChangeF1", "t-AP")] == [1, 1, 1, 1]


def test_scenes_that_do_not_change_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = painted_run(tmp_path / "run", "--anytime-every", "2", scenes="a")
    assert "painted/a: does not change; use scenes of homes-changing" in report(run, capsys, 2)
    assert "has no intermediate maps" in report(painted_run(tmp_path / "other", scenes="a"), capsys, 2)
