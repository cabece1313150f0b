"""Sessions: the maps of a run bit for bit, also saved and continued; snapshots, queries, refusals."""

from __future__ import annotations

import copy
import json
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import pytest

import su3d_bench as su3d
from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, StoreError
from su3d_bench.core.types import Frame, SceneInfo
from su3d_bench.store.predictions import prediction_arrays

MORE_HOMES = ("homes/seed1", "homes/test0", "homes/seed2")
SCENES = ("rooms/bathroom7", "homes/seed0", *(pytest.param(one, marks=pytest.mark.proof) for one in MORE_HOMES))
N_FRAMES = 8
IN_MEMORY = 'conceptfusion@feature_storage="memory"'
# Presets whose state or code differs from the method's.
METHODS = (
    "opensu3d",
    "opensu3d@density=all",
    "conceptfusion",
    "conceptfusion@half-products",
    "conceptfusion-sam",
    "conceptgraphs",
    "conceptgraphs-detector",
    "sam3d",
    "sam3d@incremental",
    "sam3d@ensemble",
)


@dataclass(frozen=True)
class Walk:
    """A scene, its frames, and the run of all methods over them."""

    info: SceneInfo
    frames: Sequence[Frame]
    run: Any
    address: str


@pytest.fixture(scope="module", params=SCENES)
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, rooms_data: Path) -> Iterator[Walk]:
    folder = tmp_path_factory.mktemp("sessions")
    kind, _, name = str(request.param).partition("/")
    small = {"n_frames": N_FRAMES, "width": 128, "height": 96, "mesh_spacing_m": 0.05}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("SU3D_DATA", str(rooms_data))
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        run = su3d.run(
            request.param,
            METHODS,
            protocols="rooms-instance" if kind == "rooms" else "homes-instance",
            settings={f"{kind}.{key}": value for key, value in small.items()},
            stride=1,
            seed=5,
            pictures=False,
            jobs=1,
            out="run",
        )
        dataset_class = registry.load("dataset", kind)
        dataset = dataset_class(rooms_data, dataset_class.Options(**small))
        info = dataset.info(name, 1)
        info = replace(info, seed=5, read_surface=partial(dataset.surface, name))
        yield Walk(info, list(dataset.frames(name, 1)), run, request.param)


def assert_same(found: Any, expected: Any) -> None:
    left, right = prediction_arrays(found), prediction_arrays(expected)
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert value.dtype == right[name].dtype and value.shape == right[name].shape, name
        assert value.tobytes() == right[name].tobytes(), name


@pytest.mark.parametrize("method", METHODS)
def test_session_equals_run_also_saved_and_continued_midway(walk: Walk, method: str, tmp_path: Path) -> None:
    expected = walk.run.prediction(walk.address, method)
    with su3d.session(method, walk.info) as s:
        for frame in walk.frames[: N_FRAMES // 2]:
            s.push(frame)
        s.save(tmp_path / "half")
        for frame in walk.frames[N_FRAMES // 2 :]:
            s.push(frame)
        assert s.as_of.geometry == walk.frames[-1].index
        assert_same(s.snapshot().prediction, expected)
    with su3d.session(load=tmp_path / "half") as s:
        assert (s.n_updates, s.as_of.geometry) == (N_FRAMES // 2, walk.frames[N_FRAMES // 2 - 1].index)
        for frame in walk.frames[N_FRAMES // 2 :]:
            s.push(frame)
        assert_same(s.snapshot().prediction, expected)


@pytest.mark.parametrize(
    "method", ["opensu3d", "conceptgraphs-detector", "sam3d@incremental", "conceptfusion", IN_MEMORY]
)
def test_snapshot_while_updates_go_on_is_the_map_of_its_frame(walk: Walk, method: str) -> None:
    with su3d.session(method, walk.info) as s:
        for frame in walk.frames[:3]:
            s.push(frame)
        handles = [s.snapshot(wait=False)]
        expected = [copy.deepcopy(s.snapshot())]
        for frame in walk.frames[3:6]:
            s.push(frame)
            handles.append(s.snapshot(wait=False))
            expected.append(copy.deepcopy(s.snapshot()))
        s.push(walk.frames[6])
        for handle, blocking in zip(handles, expected, strict=True):
            assert (handle.reason_for_blocking is None) == (method != "conceptfusion")
            assert handle.result().as_of == blocking.as_of
            assert_same(handle.result().prediction, blocking.prediction)
        late = s.snapshot(wait=False)
    with pytest.raises(StoreError, match="closed before"):
        late.result()


def test_query_ranks_as_the_command_does(walk: Walk, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["query", "text", walk.address, "a lamp", "--run", "run", "--method", "opensu3d", "--top", "4", "--json"]
    assert main(words) == 0
    expected = json.loads(capsys.readouterr().out)["ranking"]
    with su3d.session("opensu3d", walk.info) as s:
        for frame in walk.frames:
            s.push(frame)
        found = json.loads(json.dumps([asdict(one) for one in s.query("a lamp", top=4)]))
    assert found == expected and len(found) == 4


class Plain:
    """A user-defined method without optional abilities, which fails on frame 13."""

    name = "plain"

    class Config(pydantic.BaseModel):
        model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    def __init__(self, config: Config) -> None:
        self.config = config

    @property
    def needs(self) -> su3d.PerceptionNeeds:
        return su3d.PerceptionNeeds(masks="none")

    def start(self, scene: SceneInfo) -> None:
        self.n = 0

    def update(self, frame: Frame, detections: su3d.Detections, timer: su3d.Timer) -> None:
        self.n += 1 // (13 - frame.index)

    def finish(self) -> su3d.Instances:
        return su3d.Instances.of(np.zeros((1, 3), np.float32), [[0]])


# ---- without a scene: refusals, settings, damage

SCENE = SceneInfo("mine", "desk", 3, 1, "rendered-rooms")
CAMERA = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


def desk(index: int = 0, depth_m: float = 2.0) -> Frame:
    """A box in front of a wall."""
    depth = np.full((48, 64), depth_m, np.float32)
    depth[12:36, 20:44] -= 0.5
    rgb = np.full((48, 64, 3), 90, np.uint8)
    rgb[12:36, 20:44] = 200, 40, 40
    return Frame(index, 0.0, rgb, depth, np.eye(4), CAMERA)


def found_on(frame: Frame, ratios: tuple[float, ...] = (1.0,), n_dimensions: int = 4) -> su3d.Detections:
    """The box."""
    masks = np.zeros((1, 48, 64), np.bool_)
    masks[0, 12:36, 20:44] = True
    return su3d.Detections(
        frame.index, masks, np.array([[20, 12, 44, 36]], np.float32), np.ones(1, np.float32), ("box",), ("a box",),
        ratios, np.ones((1, len(ratios), n_dimensions), np.float32), np.ones(n_dimensions, np.float32),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "walk" not in request.fixturenames:
        monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))


def test_own_detections_replace_perception() -> None:
    with su3d.session("sam3d", SCENE, settings={"min_group_points": 0, "merge_min_points": 0}) as s:
        s.push(desk(), found_on(desk()))
        instances = s.snapshot().prediction
        assert isinstance(instances, su3d.Instances)
        assert (instances.names, s.as_of.features) == (("box",), 0)
        with pytest.raises(PredictionError, match="4 dimensions"):
            s.query("a box")


def test_as_of_tells_geometry_from_features() -> None:
    frame = desk(4)
    nothing = replace(
        found_on(frame), masks=np.zeros((0, 48, 64), np.bool_), boxes=np.zeros((0, 4), np.float32), names=(),
        captions=(), scores=np.zeros(0, np.float32), crop_features=np.zeros((0, 1, 4), np.float32),
    )  # fmt: skip
    with su3d.session("sam3d", SCENE) as s:
        s.push(desk(2), found_on(desk(2)))
        s.push(frame, nothing)
        assert (s.as_of.geometry, s.as_of.features) == (4, 2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"method": "openmask3d"}, "openmask3d works on the whole scene; use su3d.run"),
        ({"method": "oracle"}, "oracle uses the ground truth"),
        ({"method": "opensu4d"}, "did you mean 'opensu3d'"),
        ({"profile": "oracle"}, "needs ground truth"),
        ({"settings": {"top_n": 3}}, "unknown key 'top_n'; did you mean 'top_m'"),
        ({"settings": {"perception.segmentor.x": 3}}, "unknown key 'segmentor'"),
        ({"scene_info": None}, "scene_info is missing"),
    ],
)
def test_a_request_that_cannot_work_is_refused_in_one_line(words: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        su3d.session(**{"scene_info": SCENE} | words)
    assert "\n" not in str(caught.value)


def test_frames_and_detections_are_checked_before_the_map_changes() -> None:
    frame = desk()
    with su3d.session("conceptgraphs-detector", SCENE) as s:
        before = s.snapshot()
        for bad, detections, message in (
            (replace(frame, depth_m=np.zeros((48, 64), np.float32)), None, "depth is empty"),
            (replace(frame, depth_m=np.full((48, 64), -1, np.float32)), None, "depth is negative"),
            (frame, found_on(desk(1)), "the detections are those of frame 1"),
            (frame, found_on(frame, (0.8, 1.0)), "expected (1.0,)"),
            (frame, found_on(frame), "no name_features"),
        ):
            with pytest.raises(DataError, match=re.escape(message)):
                s.push(bad, detections)
        assert s.snapshot() is before
    with pytest.raises(ConfigError, match="it is closed; start another"):
        s.push(frame)


def test_abilities_that_a_method_lacks_are_refused(tmp_path: Path) -> None:
    with su3d.session(Plain, SCENE) as s:
        s.push(desk())
        with pytest.raises(ConfigError, match="plain: its state cannot be saved"):
            s.save(tmp_path / "saved")
        with pytest.raises(ConfigError, match="plain: cannot be revised"):
            s.revise({0: np.eye(4)})
        assert not (tmp_path / "saved").exists()
        assert s.snapshot(wait=False).reason_for_blocking == "plain cannot compute a map in another process"


def test_a_failed_update_ends_the_session() -> None:
    with su3d.session(Plain, SCENE) as s:
        with pytest.raises(ZeroDivisionError):
            s.push(desk(13))
        with pytest.raises(ConfigError, match=r"frame 13 failed: .*ZeroDivisionError.*; start another"):
            s.snapshot()


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A session of two frames."""
    with su3d.session("opensu3d", SCENE, settings={"top_m": 3}) as s:
        for index in (0, 1):
            s.push(desk(index))
        s.save(tmp_path / "saved")
    return tmp_path / "saved"


def refused(message: str, **words: Any) -> None:
    with pytest.raises((StoreError, ConfigError), match=message) as caught:
        su3d.session(**words)
    assert "\n" not in str(caught.value)


def test_a_folder_of_another_method_or_settings_or_version_is_refused(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused("saved with another method opensu3d, here sam3d", method="sam3d", load=saved)
    refused("another method.opensu3d.top_m 3, here 5", method="opensu3d", load=saved)
    refused("another method.opensu3d.top_m 3, here 4", settings={"top_m": 4}, load=saved)
    narrower = {"perception.segmenter.max_width": 320}
    refused("another perception.segmenter.max_width 640, here 320", settings=narrower, load=saved)
    with su3d.session("opensu3d", settings={"top_m": 3}, load=saved) as s:
        assert s.n_updates == 2
    monkeypatch.setattr("su3d_bench.online.saved.__version__", "0.0.9")
    refused("saved with another version .*, here 0.0.9; start a new session", load=saved)


def test_a_user_defined_method_is_not_loaded_from_a_folder(saved: Path, tmp_path: Path) -> None:
    file = tmp_path / "hostile.py"
    file.write_text("raise SystemExit('imported')")
    record = json.loads((saved / "session.json").read_text())
    (saved / "session.json").write_text(json.dumps(record | {"target": f"{file}:Method"}))
    refused("the saved method is not built in; pass method=", load=saved)


def test_saving_replaces_the_state_and_spares_other_files(saved: Path) -> None:
    with su3d.session(load=saved) as s:
        s.push(desk(2))
        s.save(saved)
        assert sorted(child.name for child in saved.iterdir()) == ["session.json", "state-2"]
        (saved / "notes.txt").touch()
        with pytest.raises(StoreError, match="contains other files"):
            s.save(saved)
    (saved / "notes.txt").unlink()
    with su3d.session(load=saved) as s:
        assert s.n_updates == 3


@pytest.mark.parametrize("method", ["opensu3d", "conceptfusion", "conceptgraphs", "sam3d"])
def test_every_damage_of_a_saved_session_is_one_line(method: str, tmp_path: Path) -> None:
    with su3d.session(method, SCENE) as s:
        s.push(desk())
        s.save(tmp_path / "whole")
    files = sorted(file.relative_to(tmp_path / "whole") for file in (tmp_path / "whole").rglob("*.*"))
    assert len(files) >= 3
    generator = np.random.default_rng(0)
    for n, file in enumerate(files * 4):
        damaged = tmp_path / f"copy-{n}"
        shutil.copytree(tmp_path / "whole", damaged)
        content = bytearray((damaged / file).read_bytes())
        if n < len(files):
            content = content[: len(content) // 2]
        elif n < 2 * len(files):
            content.clear()
        else:
            content[int(generator.integers(len(content)))] ^= 0x80
        (damaged / file).write_bytes(content)
        refused(".", load=damaged)
    (tmp_path / "copy-0" / "state-1" / "arrays.npz").unlink()
    refused("its files are not those of session.json|damaged|JSON|invalid", load=tmp_path / "copy-0")
    refused("is not a saved session", load=tmp_path / "absent")


@pytest.mark.parametrize("method", ["opensu3d", "conceptfusion", "conceptgraphs", "sam3d"])
def test_states_with_matching_digests_are_checked_too(method: str, tmp_path: Path) -> None:
    """Every array shortened, of another type, with NaN or numbers out of range; the record is made to match."""
    with su3d.session(method, SCENE) as s:
        s.push(desk())
        s.save(tmp_path / "whole")
    arrays = dict(np.load(tmp_path / "whole/state-1/arrays.npz"))
    assert {"f8"} <= arrays.keys()
    for name, array in arrays.items():
        worst = np.append(array[:-1], np.nan) if array.dtype.kind == "f" else array + (1 << 29)
        for n, changed in enumerate((array[:-1], array.astype(np.float16), worst)):
            forged = tmp_path / f"{name}-{n}"
            shutil.copytree(tmp_path / "whole", forged)
            file = forged / "state-1" / "arrays.npz"
            np.savez(file, **arrays | {name: changed})
            matched(forged)
            refused(".", load=forged)
    for n, text in enumerate(("[]", "{}", '"map"', '{"map": []}', '{"os": []}', '{"array": ["f8", [99999999999]]}')):
        forged = tmp_path / f"values-{n}"
        shutil.copytree(tmp_path / "whole", forged)
        (forged / "state-1" / "values.json").write_text(text)
        matched(forged)
        refused(".", load=forged)


def matched(folder: Path) -> None:
    """Write sizes and digests of the files into the record."""
    record = json.loads((folder / "session.json").read_text())
    files = {file.name: [file.stat().st_size, digest_file(file)] for file in (folder / "state-1").iterdir()}
    (folder / "session.json").write_text(json.dumps(record | {"files": files}))


def test_revising_poses_moves_the_frames_of_a_tree() -> None:
    settings = {"voxel_m": 0.0625, "min_group_points": 0, "merge_min_points": 0}
    moved = np.eye(4)
    moved[0, 3] = 0.25
    with su3d.session("sam3d", SCENE, settings=settings) as s, su3d.session("sam3d", SCENE, settings=settings) as other:
        for index in range(3):
            s.push(desk(index), found_on(desk(index)))
            other.push(replace(desk(index), camera_to_world=moved), found_on(desk(index)))
        before = s.snapshot().prediction.points
        s.revise(dict.fromkeys(range(3), moved))
        found, expected = s.snapshot().prediction, other.snapshot().prediction
        assert isinstance(found, su3d.Instances) and isinstance(expected, su3d.Instances)
        np.testing.assert_allclose(found.points, expected.points, atol=1e-6)
        assert found.indices.tolist() == expected.indices.tolist()
        assert np.abs(found.points - before).max() > 0.2
        for poses, message in (({9: moved}, "no points of frame 9"), ({0: np.eye(3)}, "not a finite 4x4 matrix")):
            with pytest.raises((ConfigError, DataError), match=message):
                s.revise(poses)
        np.testing.assert_array_equal(s.snapshot().prediction.points, found.points)
    with su3d.session("sam3d@incremental", SCENE) as s, pytest.raises(ConfigError, match="does not keep frames apart"):
        s.revise({0: moved})
