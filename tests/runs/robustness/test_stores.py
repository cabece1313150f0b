from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import fsspec
import pytest
from replica_scene import CHAIR, TABLE, write_original, write_render
from test_clusters import PAINTED, assert_equal_runs, deterministic_files, run

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, StoreError
from su3d_bench.runs import frame_loop as scene_feeding
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.remote_store import RemoteFolder
from su3d_bench.runs.scenes import data_root

URL = "memory://bucket/runs/one"
TWO = ("--scenes", f"{PAINTED}/[ad]", "--jobs", "1")


pytestmark = pytest.mark.usefixtures("painted_place")


@pytest.fixture
def store() -> Any:
    """An empty store in the memory of this process."""
    driver = fsspec.filesystem("memory")
    driver.store.clear()
    driver.pseudo_dirs[:] = [""]
    return driver


def mirrored(url: str, to: Path) -> Path:
    """A copy of all files in the store."""
    folder = RemoteFolder(url)
    folder.fetch(folder.files(), to)
    return to


def test_run_in_a_store_equals_a_run_in_a_folder(store: Any, tmp_path: Path) -> None:
    assert run(*TWO, out="local") == 0
    assert run(*TWO, out=URL) == 0
    assert_equal_runs("local", mirrored(URL, tmp_path / "came"))
    (mirror,) = (tmp_path / "cache" / "runs").iterdir()
    small = {name for name in deterministic_files(mirror) if not name.endswith("prediction.npz")}
    assert small == {name for name in deterministic_files(Path("local")) if not name.endswith("prediction.npz")}
    assert main(["report", "tables", str(mirror)]) == 0


def test_run_in_a_store_resumes_without_the_local_mirror(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(*TWO, out=URL) == 0
    before = mirrored(URL, tmp_path / "before")
    shutil.rmtree(tmp_path / "cache")
    monkeypatch.setattr(scene_feeding, "write_prediction", None)
    monkeypatch.setattr(scene_run, "pack_scores", None)
    assert run(*TWO, out=URL) == 0
    assert_equal_runs(before, mirrored(URL, tmp_path / "after"))


def test_partially_sent_or_truncated_job_is_run_again(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(*TWO, out="local") == 0

    def stop_at_the_seal(self: RemoteFolder, folder: Path, names: list[str]) -> None:
        send(self, folder, [name for name in names if not name.endswith("d/collector/done.json")])
        if any("painted.d" in name for name in names):
            raise KeyboardInterrupt

    send = RemoteFolder.send
    with monkeypatch.context() as patch:
        patch.setattr(RemoteFolder, "send", stop_at_the_seal)
        assert run(*TWO, out=URL) == 130
    assert "scenes/painted.d/collector/prediction.npz" in RemoteFolder(URL).files()
    cut = "/bucket/runs/one/scenes/painted.a/collector/prediction.npz"
    store.pipe_file(cut, store.cat_file(cut)[:-100])
    assert run(*TWO, out=URL) == 0
    assert_equal_runs("local", mirrored(URL, tmp_path / "came"))


def test_run_in_a_store_is_extended_and_replaced_from_any_machine(
    store: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*TWO, out="local") == 0
    assert run("--scenes", f"{PAINTED}/a", "--jobs", "1", out=URL) == 0
    before = mirrored(URL, tmp_path / "before")
    for mirror in (tmp_path / "cache" / "runs").iterdir():
        shutil.rmtree(mirror)  # as on a machine that has never seen the run
    capsys.readouterr()
    assert run("--scenes", f"{PAINTED}/d", "--jobs", "1", out=URL) == 2
    assert "(scene painted/a is not requested now, scene painted/d is new); --extend adds" in capsys.readouterr().err
    assert_equal_files(before, mirrored(URL, tmp_path / "refused"))
    assert main(["run", f"{PAINTED}/d", "--extend", "--jobs", "1", "--quiet", "--out", URL]) == 0
    assert_equal_runs("local", mirrored(URL, tmp_path / "extended"))
    assert run("--scenes", f"{PAINTED}/d", "--jobs", "1", "--replace", out=URL) == 0
    left = mirrored(URL, tmp_path / "replaced")
    assert [path.name for path in (left / "scenes").iterdir()] == ["painted.d"]


def assert_equal_files(one: Path, other: Path) -> None:
    first, second = (
        {path.relative_to(at): path.read_bytes() for path in at.rglob("*") if path.is_file()} for at in (one, other)
    )
    assert first == second


def test_scenes_in_a_remote_data_root_are_fetched_per_job(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    for scene in ("room0", "room1"):
        write_render(data, scene)
        faces = [[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]]
        write_original(data, faces, [1, 1, 2, 2], [(1, CHAIR), (2, TABLE)], folder=f"replica_v1/room_{scene[-1]}")
    RemoteFolder("memory://lake/data").send(
        data, [p.relative_to(data).as_posix() for p in data.rglob("*") if p.is_file()]
    )
    words = ["run", "--scenes", "replica/*", "--methods", "oracle", "--no-pictures", "--jobs", "1", "--quiet"]
    monkeypatch.setenv("SU3D_DATA", str(data))
    assert main([*words, "--out", "local"]) == 0
    shutil.rmtree(data)
    fetched: list[set[str]] = []
    fetch = RemoteFolder.fetch

    def noting(self: RemoteFolder, sizes: dict[str, int], into: Path) -> None:
        fetched.append(set(sizes))
        fetch(self, sizes, into)

    monkeypatch.setenv("SU3D_DATA", "memory://lake/data")
    monkeypatch.setattr(RemoteFolder, "fetch", noting)
    with pytest.raises(ConfigError, match="only su3d-bench run and ablate can read a store"):
        data_root()
    assert main([*words, "--out", "far"]) == 0
    assert Path("far/metrics.json").read_bytes() == Path("local/metrics.json").read_bytes()
    first, second = fetched
    assert first & second == {"Replica/cam_params.json"}
    assert {"Replica/room0/traj.txt", "replica_v1/room_0/habitat/mesh_semantic.ply"} <= first


@pytest.mark.parametrize("name", ["scenes/../../evil", "scenes/a\\b", "scenes/a\x1b[2J", "scenes//x"])
def test_name_that_leads_out_of_the_store_is_rejected(
    name: str, store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(store), "find", lambda *_, **__: {f"/bucket/runs/one/{name}": {"size": 1}})
    with pytest.raises(StoreError, match="which is not a valid file name; remove it"):
        RemoteFolder(URL).files()
