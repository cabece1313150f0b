"""Recordings whose poses and depth contradict each other are reported before a run starts its work."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.config import Setting, Settings, write_toml
from su3d_bench.core.geometry import turn_to_z
from su3d_bench.core.types import Float64Array
from su3d_bench.runs import poses
from su3d_bench.runs.plan import make_plan

MAKE = "datasets make rooms --layout replica --scenes bathroom0 office0 --jobs 1 --quiet"
SMALL = ["--set", "n_frames=40", "--set", "width=96", "--set", "height=72", "--set", "mesh_spacing_m=0.1"]
RUN = "run --scenes replica/bathroom0 --stride 20 --jobs 1 --protocols rooms-semantic --no-pictures --quiet --out out"
CONTRADICTED = "replica/bathroom0: poses and depth contradict each other: "


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small rooms in Replica's layout."""
    root = tmp_path_factory.mktemp("whole")
    assert main([*MAKE.split(), *SMALL, "--out", str(root)]) == 0
    return root


@pytest.fixture
def root(whole: Path, data_to_spoil: Callable[[Path], Path]) -> Path:
    """A copy of the rooms that a test may damage."""
    return data_to_spoil(whole)


def damage(root: Path, change: Callable[[Float64Array], Float64Array], scene: str = "bathroom0") -> None:
    path = root / "Replica" / scene / "traj.txt"
    np.savetxt(path, change(np.loadtxt(path).reshape(-1, 4, 4)).reshape(-1, 16))


def inverted(matrices: Float64Array) -> Float64Array:
    return np.asarray(np.linalg.inv(matrices), np.float64)


def test_inverse_poses_stop_a_run_early_and_the_correct_convention_is_named(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(root, inverted)
    assert main(RUN.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"su3d-bench: {CONTRADICTED}") and "% with the inverse poses" in line
    assert line.endswith("; --accept-poses runs it anyway")
    assert not Path("out").exists()


def test_accepted_poses_give_a_warning_in_table_log_and_record_also_on_resume(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(root, inverted)
    assert main([*RUN.split(), "--accept-poses"]) == 0
    table = capsys.readouterr().out
    assert f"- opensu3d: {CONTRADICTED.removeprefix('replica/bathroom0: ')}" in table and "(replica/bathroom0)" in table
    assert CONTRADICTED in next(Path("out").glob("scenes/*/opensu3d/log.txt")).read_text()
    assert any(line.startswith(CONTRADICTED) for line in json.loads(Path("out/run.json").read_text())["warnings"])
    metrics = Path("out/metrics.json").read_bytes()
    monkeypatch.setattr(poses, "judge_scene", lambda *words: pytest.fail("looked at the poses again"))
    assert main(RUN.split()) == 0
    assert capsys.readouterr().out == table and Path("out/metrics.json").read_bytes() == metrics


def test_pose_error_counts_affected_scenes_and_generated_rooms_are_not_checked(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for scene in ("bathroom0", "office0"):
        damage(root, inverted, scene)
    words = [word.replace("replica/bathroom0", "replica/*") for word in RUN.split()]
    assert main(words) == 2
    assert "(and 1 more of 2 scenes); --accept-poses" in capsys.readouterr().err
    monkeypatch.setattr(poses, "judge_scene", lambda *words: pytest.fail("looked at a made room"))
    plan = make_plan(Settings((Setting(("scenes",), ("rooms/living0",), ""),)))
    assert poses.judged(plan.jobs)[0].doubts == ()


def test_failing_pose_check_is_a_warning(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poses, "judge_scene", lambda *words: 1 / 0)
    plan = make_plan(Settings((Setting(("scenes",), ("replica/bathroom0",), ""),)))
    (line,) = poses.judged(plan.jobs)[0].doubts or ()
    assert line.startswith("replica/bathroom0: poses and depth could not be checked: ") and "ZeroDivisionError" in line


def test_up_axis_other_than_z_gives_a_warning(root: Path) -> None:
    """For a dataset whose files may use any world frame."""
    folder = root / "rgbd" / "bath"
    folder.mkdir(parents=True)
    shutil.copytree(root / "Replica" / "bathroom0" / "results", folder / "results")
    poses_in = np.loadtxt(root / "Replica" / "bathroom0" / "traj.txt").reshape(-1, 4, 4)
    poses_in[:, :3] = turn_to_z("-y").T @ poses_in[:, :3]
    np.savetxt(folder / "kitti.txt", poses_in[:, :3].reshape(-1, 12))
    camera = json.loads((root / "Replica" / "cam_params.json").read_text())["camera"]
    table = {"colour": "results/frame{index}.jpg", "depth": "results/depth{index}.png", "trajectory": "kitti.txt",
             "trajectory_format": "kitti", "depth_unit_m": 1 / camera["scale"],
             "intrinsics": [float(camera[key]) for key in ("fx", "fy", "cx", "cy")]}  # fmt: skip
    (folder / "rgbd.toml").write_text(write_toml([((key,), value, "") for key, value in table.items()]))
    words = "run --scenes rgbd/bath --stride 20 --jobs 1 --no-pictures --quiet --out up"
    assert main(words.split()) == 0
    (line,) = json.loads(Path("up/run.json").read_text())["warnings"]
    assert (
        line.startswith("rgbd/bath: z is assumed to be up, but -y seems to be (")
        and 'set up = "-y" in rgbd.toml' in line
    )
