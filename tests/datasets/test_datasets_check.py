"""``datasets check``: a complete scene has no findings, each fault is named, and the digest is that of results."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import box_room
import numpy as np
import painted
import pytest
from box_room import write_box_room, write_poses
from painted import Painted
from painted_runs import see_painted

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError, printable, printable_json
from su3d_bench.core.types import Frame
from su3d_bench.datasets.checks import SAMPLED_FRAMES, Inspection, inspect
from su3d_bench.datasets.frame_checks import Finding, check_frames, facts_of
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms

N_FRAMES = 8


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("whole")
    write_box_room(root, N_FRAMES)
    return root


@pytest.fixture
def root(whole: Path, tmp_path: Path) -> Path:
    """A copy of the complete scene, to damage."""
    shutil.copytree(whole, tmp_path / "data")
    return tmp_path / "data"


def look(root: Path, **options: Any) -> Inspection:
    return inspect(Replica(root), "room0", **options)


def texts(found: Inspection, severity: str = "error") -> list[str]:
    return [f"{one.where}: {one.text}" for one in found.findings if one.severity == severity]


def checks(found: Inspection) -> set[str]:
    return {one.check for one in found.findings}


def test_complete_scene_has_no_findings(whole: Path) -> None:
    found = look(whole, n_threads=2)
    assert found.findings == ()
    assert (found.scene, found.n_frames, found.n_read, found.size) == ("replica/room0", N_FRAMES, N_FRAMES, (48, 36))
    assert found.n_files == 2 + 2 * N_FRAMES + 2
    assert found.depth is not None and found.meeting is not None
    assert 0.3 < found.depth.near_m < found.depth.median_m < found.depth.far_m < 5
    assert found.depth.valid_share == 1
    assert found.meeting.share > 0.99
    rows = {row.variant: row for row in found.truth}
    assert (rows["mesh-vertices"].n_objects, rows["mesh-vertices"].n_classes) == (6, 3)
    assert rows["conceptgraphs"].reason is not None


def test_every_damaged_file_is_named(root: Path) -> None:
    results = root / "Replica/room0/results"
    (results / "frame000001.jpg").write_bytes((results / "frame000001.jpg").read_bytes()[:200])
    (results / "depth000004.png").write_bytes(b"no image")
    (results / "depth000006.png").write_bytes(b"")
    printed = " ".join(texts(look(root)))
    assert all(name in printed for name in ("frame000001.jpg", "depth000004.png", "depth000006.png"))
    assert len(texts(look(root))) == 3
    assert look(root).n_read == N_FRAMES - 3


def test_wrong_depth_scale_is_an_error_with_a_suggested_factor(root: Path) -> None:
    path = root / "Replica/cam_params.json"
    table = json.loads(path.read_text())
    table["camera"]["scale"] = 1000.0
    path.write_text(json.dumps(table))
    found = look(root)
    (printed,) = [one.text for one in found.findings if one.check == "frame-of-reference"]
    assert "with depth times 0.1526" in printed
    table["camera"]["scale"] = 6.5535
    path.write_text(json.dumps(table))
    assert "depth-scale" in checks(look(root))


def test_cameras_outside_the_mesh_are_an_error(root: Path) -> None:
    moved = [box_room.pose(index) for index in range(N_FRAMES)]
    for matrix in moved:
        matrix[:3, 3] += (50.0, 0.0, 0.0)
    write_poses(root / "Replica/room0", moved)
    printed = [one.text for one in look(root).findings if one.check == "frame-of-reference"]
    assert printed[0].startswith(
        "8 of 8 cameras lie outside the ground truth's box by more than 1 m, first frame 0 at (51.5"
    )
    assert "only 0.0%" in printed[1] and "the clouds do not overlap" in printed[1]


def test_generated_rooms_have_no_findings(tmp_path: Path) -> None:
    options = RoomOptions(width=64, height=48, n_frames=SAMPLED_FRAMES + 5, mesh_spacing_m=0.1)
    found = inspect(Rooms(tmp_path, options), "living0")
    assert found.findings == ()
    assert (found.n_frames, found.n_read, found.n_files) == (SAMPLED_FRAMES + 5, SAMPLED_FRAMES, 0)
    assert found.meeting is not None and found.meeting.share > 0.8


@pytest.mark.parametrize(
    ("fault", "severity", "text"),
    [
        ("missing-frame", "error", "frame 2 is missing; copy it again"),
        ("nan-pose", "error", "the pose is not a finite 4x4 matrix"),
        ("unknown-class", "error", "class id 777 is unknown"),
        ("crash", "error", "ZeroDivisionError: a mistake in a plug-in"),
    ],
)
def test_faults_of_any_dataset_are_found(tmp_path: Path, fault: str, severity: str, text: str) -> None:
    found = inspect(Painted(tmp_path, Painted.Options(fault=fault)), "b")
    assert any(text in one for one in texts(found, severity)), found.findings
    assert found.count("error") == 1


class Faulty(Painted):
    """Reports two faults itself, one with a terminal escape in it."""

    def problems(self, scene: str) -> Sequence[str]:
        return (f"painted/{scene}: a\x1b[31mb.jpg is missing\n; copy it again", "painted/x: y.png: not readable")

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        raise DataError(f"painted/{scene}: y.png: not an image")


def test_faults_reported_by_a_dataset_appear_once_and_escaped(tmp_path: Path) -> None:
    found = inspect(Faulty(tmp_path, Painted.Options()), "a")
    assert [one.text for one in found.findings] == [
        r"a\x1b[31mb.jpg is missing ; copy it again",
        "painted/x: y.png: not readable",
    ]


def frame(**changes: Any) -> Frame:
    rng = np.random.default_rng(changes.get("index", 0))
    usual: dict[str, Any] = {
        "index": 0,
        "timestamp_s": 0.0,
        "rgb": rng.integers(50, 200, (24, 32, 3)).astype(np.uint8),
        "depth_m": rng.uniform(1, 3, (24, 32)).astype(np.float32),
        "camera_to_world": np.eye(4),
        "intrinsics": painted.INTRINSICS,
    }
    moved = np.eye(4)
    moved[0, 3] = 0.1 * changes.get("index", 0)
    return Frame(**(usual | {"camera_to_world": moved} | changes))


def found_in(*frames: Frame) -> list[tuple[str, str, str]]:
    found: list[Finding] = list(check_frames([facts_of(one) for one in frames]))
    return [(one.severity, one.check, one.where) for one in found]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"camera_to_world": 2 * np.eye(4)}, ("error", "pose", "frame 1")),
        ({"camera_to_world": np.diag([1.0, 1, -1, 1])}, ("error", "pose", "frame 1")),
        ({"depth_m": np.eye(24, 32, dtype=np.float32)}, ("warning", "depth", "frame 1")),
        ({"intrinsics": np.diag([0.0, 30, 1])}, ("error", "intrinsics", "frame 1")),
        ({"camera_to_world": np.array([[1.0, 0, 0, 500], *np.eye(4)[1:]])}, ("warning", "motion", "")),
    ],
)
def test_frame_fault_is_located(changes: dict[str, Any], expected: tuple[str, str, str]) -> None:
    assert expected in found_in(frame(), frame(index=1, **changes), frame(index=2))


def test_static_camera_and_repeated_images_are_warnings() -> None:
    still = [frame(index=index, camera_to_world=np.eye(4)) for index in range(3)]
    assert found_in(*still) == [("warning", "motion", "")]
    same = frame()
    repeated = [frame(index=index, rgb=same.rgb, depth_m=same.depth_m) for index in range(3)]
    assert found_in(*repeated) == [("warning", "motion", "")]


def test_command_limits_its_list_and_ends_with_1(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(root))
    write_box_room(root, 14, "room1", with_truth=False)
    for path in (root / "Replica/room1/results").glob("depth*.png"):
        path.write_bytes(b"x")
    assert main(["datasets", "check", "replica/room0", "replica/room1", "--jobs", "2"]) == 1
    text = capsys.readouterr().out
    assert text.count("error         ") == 10
    assert "and 4 more of this kind; --json lists all" in text
    assert text.endswith("2 scenes, 1 with errors\n")
    assert main(["datasets", "check", "replica/room1", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["scenes"][0]["n_errors"] == 14


def test_digest_equals_the_one_recorded_by_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:

    see_painted(monkeypatch)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    file = Path(painted.__file__)
    scene, options = f"{file}:Painted/a", ["--set", "painted.n_frames=3"]
    assert main(["datasets", "check", scene, *options, "--json"]) == 0
    digest = json.loads(capsys.readouterr().out)["scenes"][0]["digest"]
    words = ["--methods", f"{file}:Collector", "--no-pictures", "--jobs", "1", "--out", str(tmp_path / "run")]
    assert main(["run", "--scenes", scene, *options, "--protocols", "rooms-semantic", *words]) == 0
    assert digest in (tmp_path / "run" / "run.json").read_text()
    assert digest in (tmp_path / "run/scenes/painted.a/collector/done.json").read_text()


def test_control_characters_from_files_do_not_reach_the_terminal() -> None:
    assert printable("a\x1b]0;title\x07\n b\u202e\x00c") == r"a\x1b]0;title\x07 b\u202e\x00c"
    assert printable("é \U0001f600 日本") == "é \U0001f600 日本"
    assert len(printable("x" * 9_999)) == 500
    assert printable_json({"a\x1b": [Path("b\x07"), 3, None, ("c\r",)]}) == {r"a\x1b": [r"b\x07", 3, None, ["c"]]}
