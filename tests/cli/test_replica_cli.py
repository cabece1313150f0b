"""The commands ``su3d-bench datasets``: lists, generated scenes, and one-line errors."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.datasets.replica.dataset import Replica

SMALL = ["--set", "n_frames=3", "--set", "rooms.width=64", "--set", "height=48", "--set", "mesh_spacing_m=0.15"]
MAKE = ["datasets", "make", "rooms", "--scenes", "bathroom0", *SMALL, "--jobs", "1"]


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))


def fault(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one-line error of an invalid request."""
    assert main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    return printed.err


def test_list_shows_datasets_folders_scenes_and_how_to_get_missing_ones(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["datasets", "list"]) == 0
    text = capsys.readouterr().out
    assert "rooms/living0    1600 frames" in text
    assert main(["datasets", "list", "replica"]) == 0
    text = capsys.readouterr().out
    assert f"looked for in: {tmp_path / 'data' / 'Replica'}" in text
    assert (
        "with su3d-bench datasets fetch replica frames, set SU3D_DATA to their folder, or create a room in this" in text
    )


def test_list_shows_the_state_of_each_scene(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for scene, traj in (("room0", "1 0\n2 0\n"), ("room1", None)):
        (tmp_path / "data" / "Replica" / scene / "results").mkdir(parents=True)
        if traj is not None:
            (tmp_path / "data" / "Replica" / scene / "traj.txt").write_text(traj)
    (tmp_path / "data/replica_v1/room_0/habitat").mkdir(parents=True)
    (tmp_path / "data/Replica/cam_params.json").touch()
    assert main(["datasets", "list", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["datasets"]}
    assert [row["scene"] for row in rows["replica"]["scenes"]] == ["replica/room0", "replica/room1"]
    assert rows["replica"]["scenes"][0]["status"].startswith("2 frames, no ground truth; ")
    assert rows["replica"]["scenes"][0]["status"].endswith("mesh_semantic.ply is missing")
    assert rows["replica"]["scenes"][1]["status"] == "traj.txt is missing"
    assert rows["rooms"]["error"] is None


def test_generated_room_is_a_replica_scene_and_repeating_the_command_does_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = [*MAKE, "--layout", "replica", "--out", "made"]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert printed.out.split() == ["bathroom0", "generated", "replica/bathroom0"]
    assert "su3d-bench run --data made --scenes 'replica/*'" in printed.err
    assert len(Replica(tmp_path / "made").frames("bathroom0", 1)) == 3
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == [
        {"scene": "bathroom0", "status": "already present", "address": "replica/bathroom0"}
    ]


def test_native_layout_writes_the_scan_to_the_data_root(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main([*MAKE, "--out", "native"]) == 0
    assert capsys.readouterr().out.split() == ["bathroom0", "generated", "rooms/bathroom0"]
    assert len(list((tmp_path / "native").rglob("bathroom0.npz"))) == 1


@pytest.mark.proof
def test_one_and_two_workers_generate_identical_files(tmp_path: Path) -> None:
    words = [*MAKE[:-1], "2", "--layout", "replica", "--out", "made2", "--quiet"]
    done = subprocess.run([sys.executable, "-m", "su3d_bench", *words], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert main([*MAKE, "--layout", "replica", "--out", "made1"]) == 0
    one, two = ({path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
                for root in (tmp_path / "made1", tmp_path / "made2"))  # fmt: skip
    assert one == two


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["datasets", "make", "rooms", "--layout", "replica"],
            "datasets make --layout replica: name the folder with --out",
        ),
        (
            ["datasets", "make", "replica"],
            "datasets make replica: scenes of this dataset cannot be generated; known: homes, rooms",
        ),
        (["datasets", "make", "rooms", "--scenes", "livng0"], "no scene matches 'rooms/livng0'; did you mean"),
        (["datasets", "make", "rooms", "--scenes", "replica/*"], "no scene 'replica/*'; expected 'rooms/...'"),
        (["datasets", "make", "rooms", "--set", "width=3"], "--set rooms.width: rooms.width = 3: input"),
        ([*MAKE, "--layout", "replica", "--out", "file/below"], "a file is in the place of a folder"),
    ],
)  # fmt: skip
def test_invalid_request_is_a_one_line_error(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    assert message in fault(words, capsys)
