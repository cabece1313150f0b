"""Scenes written as files: wherever the maker is killed there is no half scene, and the next one finishes the work."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from scanned_stage import N_FRAMES, Stage, files_below, write_scene

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.writing import finish_scene, plan_scenes, write_frames

ROOM = "living7"
SCANNET = ("scannet", "scannet-python", "scannet-cpp")
ADDRESS = dict.fromkeys(SCANNET, "scene9007_00") | {"replica": ROOM, "tum": ROOM, "scannetpp": "0000000007"}
ADDRESS["arkitscenes"] = "00000007"
ADDRESS["hm3dsem"] = "00000-living00007"
TRUTH = {"replica": "mesh-vertices"} | dict.fromkeys(SCANNET, "nyu40-vertices") | {"scannetpp": "scannetpp"}
TRUTH |= {"arkitscenes": "query-vertices", "hm3dsem": "hovsg-objects"}


def reader(name: str, root: Path) -> Any:
    dataset_class = registry.load("dataset", LAYOUTS[name].reader)
    return dataset_class(root, dataset_class.Options())


def scenes(name: str, root: Path) -> list[str]:
    """The scenes with frames that the adapter finds; nothing where it says that there is none."""
    try:
        dataset = reader(name, root)
        return [scene for scene in dataset.scenes() if dataset.info(scene, 1).n_frames]
    except DataError as error:
        if ": no s" not in str(error):  # no scene, no scan, no sequence
            raise
        return []


def check_is_whole(name: str, root: Path) -> None:
    dataset = reader(name, root)
    assert scenes(name, root) == [ADDRESS[name]]
    assert len([frame.depth_m for frame in dataset.frames(ADDRESS[name], 1)]) == N_FRAMES
    if name in TRUTH:
        assert len(dataset.ground_truth(ADDRESS[name], TRUTH[name]).points) == 8


def content(root: Path) -> dict[str, bytes]:
    return {name: (root / name).read_bytes() for name in files_below(root)}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    folder = tmp_path_factory.mktemp("undisturbed")
    for name, layout in LAYOUTS.items():
        write_scene(layout, Stage(), ROOM, folder / name)
        check_is_whole(name, folder / name)
    return {name: content(folder / name) for name in LAYOUTS}


def dies_at(n: int, replace: Callable[..., None]) -> Callable[..., None]:
    """``os.replace`` for ``n`` calls, then the end."""
    left = [n]

    def dying(source: Path, target: Path) -> None:
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        replace(source, target)

    return dying


@pytest.mark.parametrize("name", LAYOUTS)
def test_wherever_a_make_is_killed_no_half_scene_is_seen_and_the_next_one_ends_with_the_same_bytes(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    for n in range(100):
        root = tmp_path / str(n)
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", dies_at(n, os.replace))
            try:
                write_scene(LAYOUTS[name], Stage(), ROOM, root)
                break
            except KeyboardInterrupt:
                pass
        if scenes(name, root):
            check_is_whole(name, root)
        write_scene(LAYOUTS[name], Stage(), ROOM, root)
        assert content(root) == undisturbed[name], n
        assert not list(root.rglob(".*")), n
    assert n > N_FRAMES


@pytest.mark.parametrize("name", LAYOUTS)
def test_frames_of_a_killed_make_are_taken_over(name: str, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_scene(LAYOUTS[name], Stage(dies_at=3), ROOM, tmp_path)
    assert scenes(name, tmp_path) == []
    next(tmp_path.rglob(".*.partial")).joinpath(".half.0123456789ab.unfinished").write_bytes(b"half")
    again = Stage()
    write_scene(LAYOUTS[name], again, ROOM, tmp_path)
    assert set(again.rendered) - {0} == {3, 4}  # the first is asked for the size of the images
    check_is_whole(name, tmp_path)
    assert not list(tmp_path.rglob(".*"))


def test_a_recording_that_was_joined_is_not_made_again_when_its_pieces_are_half_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    def half_removed(folder: Path, **_: Any) -> None:
        next(folder.iterdir()).unlink()
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", half_removed)
    with pytest.raises(KeyboardInterrupt):
        write_scene(LAYOUTS["scannet"], Stage(), ROOM, tmp_path)
    monkeypatch.undo()
    again = Stage()
    write_scene(LAYOUTS["scannet"], again, ROOM, tmp_path)
    assert set(again.rendered) <= {0}
    assert content(tmp_path) == undisturbed["scannet"]


KILLED = """
import os, signal, sys
from pathlib import Path
from scanned_stage import Stage, StageFrames, write_scene
from su3d_bench.datasets.layouts import LAYOUTS

class Killed(StageFrames):
    def __getitem__(self, index):
        if index == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__getitem__(index)

stage = Stage()
stage.frames = lambda scene, stride: Killed(stage, scene)
write_scene(LAYOUTS[sys.argv[1]], stage, "living7", Path(sys.argv[2]))
"""


def test_a_killed_process_leaves_its_frames_and_no_scene(
    tmp_path: Path, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    command = [sys.executable, "-c", KILLED, "scannet", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    assert subprocess.run(command, env=environment, capture_output=True).returncode == -signal.SIGKILL
    assert scenes("scannet", tmp_path) == []
    again = Stage()
    write_scene(LAYOUTS["scannet"], again, ROOM, tmp_path)
    assert set(again.rendered) - {0} == {3, 4}
    assert content(tmp_path) == undisturbed["scannet"]


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_whole_scene_is_left_alone(name: str, tmp_path: Path) -> None:
    write_scene(LAYOUTS[name], Stage(), ROOM, tmp_path)
    before = {path: (tmp_path / path).stat().st_mtime_ns for path in files_below(tmp_path)}
    write_scene(LAYOUTS[name], Stage(dies_at=0), ROOM, tmp_path)
    assert {path: (tmp_path / path).stat().st_mtime_ns for path in files_below(tmp_path)} == before


@pytest.mark.parametrize("name", LAYOUTS)
def test_files_of_the_truth_that_were_lost_are_made_again_without_the_frames(
    name: str, tmp_path: Path, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    for path in layout.target(ROOM, "", tmp_path).truth:
        path.unlink()
        again = Stage()
        write_scene(layout, again, ROOM, tmp_path)
        assert set(again.rendered) <= {0}
        assert content(tmp_path) == undisturbed[name]


@pytest.mark.parametrize("name", ["scannet", "scannet-cpp"])
def test_a_recording_that_was_lost_is_made_again(
    name: str, tmp_path: Path, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    target = layout.target(ROOM, "", tmp_path)
    (target.folder / target.frames).unlink()
    write_scene(layout, Stage(), ROOM, tmp_path)
    assert content(tmp_path) == undisturbed[name]


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_scene_of_another_making_is_never_overwritten(name: str, tmp_path: Path) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    with pytest.raises(StoreError, match=f"{ADDRESS[name]}: holds another '{ADDRESS[name]}', made elsewhere or with"):
        write_scene(layout, Stage(kind="other"), ROOM, tmp_path)
    (layout.scenes_folder(tmp_path) / "rooms.json").unlink()
    with pytest.raises(StoreError, match=f"holds another '{ADDRESS[name]}'"):
        write_scene(layout, Stage(), ROOM, tmp_path)


@pytest.mark.parametrize(("first", "second"), [("scannet", "scannet-python"), ("scannet-cpp", "scannet")])
def test_one_room_in_two_layouts_does_not_share_a_folder(first: str, second: str, tmp_path: Path) -> None:
    write_scene(LAYOUTS[first], Stage(), ROOM, tmp_path)
    with pytest.raises(StoreError, match="holds another 'scene9007_00'"):
        write_scene(LAYOUTS[second], Stage(), ROOM, tmp_path)


def test_two_rooms_share_a_folder_and_its_marker(tmp_path: Path) -> None:
    for room in (ROOM, "office0"):
        write_scene(LAYOUTS["scannet"], Stage(), room, tmp_path)
    assert scenes("scannet", tmp_path) == ["scene9007_00", "scene9300_00"]
    marker = json.loads((tmp_path / "scans/rooms.json").read_text())
    assert marker["rooms"] == {"scene9007_00": ROOM, "scene9300_00": "office0"}


def test_rooms_are_not_mixed_with_scans_of_the_release(tmp_path: Path) -> None:
    (tmp_path / "scannetv2-labels.combined.tsv").write_text("id\traw_category\n1\twall\n")
    with pytest.raises(StoreError, match=r"combined\.tsv: is another label table than that of the rooms, and all"):
        write_scene(LAYOUTS["scannet"], Stage(), ROOM, tmp_path)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_full_disk_is_one_line(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    layout = LAYOUTS[name]
    target = plan_scenes(layout, Stage(), [ROOM], tmp_path)[0]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StoreError, match=r"^cannot write .*partial.*: the disk is full; free some space"):
            write_frames(layout, Stage(), target, range(N_FRAMES))
    write_frames(layout, Stage(), target, range(N_FRAMES))
    layout.write_truth(Stage(), target)
    if name == "scannet":
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(StoreError, match=r"^cannot write .*scene9007_00\.sens: "):
            finish_scene(layout, Stage(), target)
    assert not [path for path in files_below(tmp_path) if path.endswith(".unfinished")]
