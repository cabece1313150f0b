"""Scenes written as files: wherever the maker is killed there is no half scene, and the next one finishes the work."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from scanned_stage import N_FRAMES, Stage, files_below, write_scene

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.writing import plan_scenes, write_frames

ROOM = "living7"
ADDRESS = {"replica": ROOM, "scannet": "scene9007_00"}
TRUTH = {"replica": "mesh-vertices", "scannet": "nyu40-vertices"}


def reader(name: str, root: Path) -> Any:
    dataset_class = registry.load("dataset", LAYOUTS[name].reader)
    return dataset_class(root, dataset_class.Options())


def scenes(name: str, root: Path) -> list[str]:
    """The scenes with frames that the adapter finds; nothing where it says that there is none."""
    try:
        dataset = reader(name, root)
        return [scene for scene in dataset.scenes() if dataset.info(scene, 1).n_frames]
    except DataError as error:
        if ": no s" not in str(error):  # no scene, no scan
            raise
        return []


def check_is_whole(name: str, root: Path) -> None:
    dataset = reader(name, root)
    assert scenes(name, root) == [ADDRESS[name]]
    assert len([frame.depth_m for frame in dataset.frames(ADDRESS[name], 1)]) == N_FRAMES
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
def test_frames_of_a_killed_make_are_taken_over_and_those_of_another_are_not(name: str, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_scene(LAYOUTS[name], Stage(dies_at=3), ROOM, tmp_path / "one")
    assert scenes(name, tmp_path / "one") == []
    next((tmp_path / "one").rglob(".*.partial")).joinpath(".half.0123456789ab.unfinished").write_bytes(b"half")
    again = Stage()
    write_scene(LAYOUTS[name], again, ROOM, tmp_path / "one")
    assert set(again.rendered) - {0} == {3, 4}  # the first is asked for the size of the images
    check_is_whole(name, tmp_path / "one")
    assert not list((tmp_path / "one").rglob(".*"))
    with pytest.raises(KeyboardInterrupt):
        write_scene(LAYOUTS[name], Stage(dies_at=3), ROOM, tmp_path / "two")
    other = Stage(kind="other")
    write_scene(LAYOUTS[name], other, ROOM, tmp_path / "two")
    assert set(other.rendered) == set(range(N_FRAMES))


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_whole_scene_is_left_alone_and_lost_ground_truth_is_made_again_without_the_frames(
    name: str, tmp_path: Path, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    before = {path: (tmp_path / path).stat().st_mtime_ns for path in files_below(tmp_path)}
    write_scene(layout, Stage(dies_at=0), ROOM, tmp_path)
    assert {path: (tmp_path / path).stat().st_mtime_ns for path in files_below(tmp_path)} == before
    for path in layout.target(ROOM, "", tmp_path).truth:
        path.unlink()
        again = Stage()
        write_scene(layout, again, ROOM, tmp_path)
        assert set(again.rendered) <= {0}
        assert content(tmp_path) == undisturbed[name]


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_scene_of_another_making_is_never_overwritten(name: str, tmp_path: Path) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    with pytest.raises(StoreError, match=ADDRESS[name]):
        write_scene(layout, Stage(kind="other"), ROOM, tmp_path)
    (layout.scenes_folder(tmp_path) / "rooms.json").unlink()
    with pytest.raises(StoreError, match=ADDRESS[name]):
        write_scene(layout, Stage(), ROOM, tmp_path)


def test_what_scenes_share_is_refused_where_it_is_another(tmp_path: Path) -> None:
    (tmp_path / "scannetv2-labels.combined.tsv").write_text("id\traw_category\n1\twall\n")
    with pytest.raises(StoreError, match=r"combined\.tsv: is another label table"):
        write_scene(LAYOUTS["scannet"], Stage(), ROOM, tmp_path)
    write_scene(LAYOUTS["replica"], Stage(), ROOM, tmp_path)
    with pytest.raises(StoreError, match=r"cam_params\.json: is another camera .*20x12"):
        write_scene(LAYOUTS["replica"], Stage(width=20), "living8", tmp_path)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_full_disk_is_one_line_and_leaves_nothing_half(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    layout = LAYOUTS[name]
    stage: Any = Stage()
    target = plan_scenes(layout, stage, [ROOM], tmp_path)[0]
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match="disk is full"):
        write_frames(layout, stage, target, range(N_FRAMES))
    assert not [path for path in files_below(tmp_path) if path.endswith(".unfinished")]
