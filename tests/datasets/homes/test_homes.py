"""The homes as a dataset: determinism, agreement of frames, scan, mesh and truth, names, options, sensor track."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scored_room import truth_as_prediction

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import back_project
from su3d_bench.core.registry import load
from su3d_bench.core.types import Frame, GroundTruth
from su3d_bench.datasets.homes.dataset import DEFAULT_SCENES, SERIES, BuiltHome, Homes, HomesSensor, label_set
from su3d_bench.datasets.homes.model_sheet import PAPER, draw_item
from su3d_bench.datasets.procedural.items import Item, Part
from su3d_bench.datasets.procedural.materials import Material, Texture
from su3d_bench.datasets.procedural.shapes import box
from su3d_bench.datasets.procedural.truth import attribute_of_object
from su3d_bench.formats.images import decode_colour
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.metrics.scoring import combine, score_scene

SMALL = Homes.Options(width=160, height=120, n_frames=24, mesh_spacing_m=0.03)
SCENE = "test0"


@pytest.fixture(scope="module")
def homes(rooms_data: Path) -> Homes:
    return Homes(rooms_data, SMALL)


@pytest.fixture(scope="module")
def sensor(rooms_data: Path) -> HomesSensor:
    return HomesSensor(rooms_data, SMALL)


@pytest.fixture(scope="module")
def truth(homes: Homes) -> GroundTruth:
    return homes.ground_truth(SCENE, "mesh-vertices")


def content(frame: Frame) -> tuple[bytes, bytes, bytes]:
    return frame.rgb.tobytes(), frame.depth_m.tobytes(), frame.camera_to_world.tobytes()


def test_frames_are_repeatable_and_show_objects_of_the_home(homes: Homes, rooms_data: Path) -> None:
    again = Homes(rooms_data, SMALL)
    n_objects = len(homes.objects(SCENE))
    assert again.truth(SCENE) == homes.truth(SCENE)
    assert len(homes.frames(SCENE, 5)) == homes.info(SCENE, 5).n_frames == 5
    for index in (0, 13):
        frame, image = homes.frames(SCENE, 1)[index], homes.render(SCENE, index)
        assert content(frame) == content(again.frame(SCENE, index))
        assert frame.rgb.shape == (120, 160, 3) and frame.rgb.tobytes() == image.rgb.tobytes()
        assert image.instance.min() >= 1 and image.instance.max() <= n_objects  # a closed home
        assert len(np.unique(image.instance)) > 3


def test_ids_classes_and_names_are_those_of_the_objects(homes: Homes, truth: GroundTruth) -> None:
    objects = homes.objects(SCENE)
    assert [one.id for one in objects] == list(range(1, len(objects) + 1))
    assert all(label_set().name_of(one.class_id) == one.class_name for one in objects)
    class_of = np.array([0, *(one.class_id for one in objects)])
    assert truth.instance.min() >= 1 and np.array_equal(truth.semantic, class_of[truth.instance])
    rules = load_protocol("homes-semantic")
    assert [(entry.id, entry.name) for entry in rules.classes] == list(
        zip(label_set().ids, label_set().names, strict=True)
    )


def test_corners_and_attributes_belong_to_the_same_surface(homes: Homes, truth: GroundTruth) -> None:
    corners, scan = homes.ground_truth(SCENE, "face-corners"), homes.scan(SCENE)
    assert np.array_equal(corners.points, truth.points[scan.faces.reshape(-1)])
    assert np.array_equal(corners.instance, truth.instance[scan.faces.reshape(-1)])
    for aspect in homes.extra_ground_truths:
        attributes = homes.ground_truth(SCENE, aspect)
        assert np.array_equal(attributes.semantic, attribute_of_object(homes.objects(SCENE), aspect)[truth.instance])
    with pytest.raises(DataError, match="no ground truth 'boxes'"):
        homes.ground_truth(SCENE, "boxes")


def test_scan_lies_on_the_mesh_and_frames_on_the_scan(homes: Homes, truth: GroundTruth) -> None:
    import open3d as o3d

    mesh = homes.instance_mesh(SCENE)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    points = truth.points[::50].astype(np.float32)
    assert scene.compute_distance(o3d.core.Tensor(points)).numpy().max() < 5e-4  # m
    frame = homes.frame(SCENE, 7)
    seen = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, frame.depth_m > 0)
    assert np.percentile(scene.compute_distance(o3d.core.Tensor(seen.astype(np.float32))).numpy(), 99) < 1e-3


def test_truth_scores_1_in_both_groups(truth: GroundTruth) -> None:
    for name in ("homes-semantic", "homes-instance"):
        rules = load_protocol(name)
        values = combine(
            rules, {SCENE: score_scene(rules, truth, truth_as_prediction(truth, with_labels=True), None)}
        ).metrics
        assert [values[metric] for metric in rules.headline] == [1.0] * len(rules.headline)


@pytest.mark.parametrize("name", ["test24", "tuning24", "seed01", "seed1000000", "living0", "test", ""])
def test_unknown_home_is_refused_in_one_line(homes: Homes, name: str) -> None:
    for read in (homes.digest, homes.scan, lambda scene: homes.frames(scene, 1)):
        with pytest.raises(DataError, match=r"^homes: no scene '.*'; expected tuning0 to ") as error:
            read(name)
        assert "\n" not in str(error.value)


def test_names_of_all_series_are_accepted_and_only_training_homes_are_not_cached(homes: Homes) -> None:
    assert len(homes.scenes()) == len(set(homes.scenes())) == 48 and homes.scenes() == DEFAULT_SCENES
    names = [*DEFAULT_SCENES, "seed0", "seed999999", "training0", "training999999"]
    assert len({homes.digest(name) for name in names}) == len(names)
    assert [name for name in names if homes.is_for_training(name)] == ["training0", "training999999"]
    assert homes.build("training3", None).series == "training"


def test_homes_of_different_series_have_different_random_numbers() -> None:
    def first(scene: str, offset: int = 0) -> int:
        options = SMALL.model_copy(update={"seed_offset": offset})
        return int(BuiltHome(scene, options, None)._random("home").integers(1 << 62))

    drawn = [first(f"{series}{k}", offset) for series in SERIES for k in range(24) for offset in (0, 1)]
    assert len(set(drawn)) == len(drawn)


def test_digest_and_trajectory_depend_on_the_options(homes: Homes, rooms_data: Path) -> None:
    changes: list[dict[str, Any]] = [
        {"width": 80},
        {"n_frames": 23},
        {"mesh_spacing_m": 0.02},
        {"seed_offset": 1},
        {"carrier": "robot"},
    ]
    others = [Homes(rooms_data, SMALL.model_copy(update=change)) for change in changes]
    digests = {one.digest(SCENE) for one in (homes, *others, HomesSensor(rooms_data, SMALL))}
    assert len(digests) == len(changes) + 2


def test_sensor_track_is_repeatable_in_any_order_and_from_threads(sensor: HomesSensor, rooms_data: Path) -> None:
    again, indices = HomesSensor(rooms_data, SMALL), [0, 5, 12, 23]
    expected = [content(sensor.frame(SCENE, index)) for index in indices]
    backwards = [content(again.frame(SCENE, index)) for index in reversed(indices)]
    assert backwards[::-1] == expected
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(lambda index: content(again.frame(SCENE, index)), indices * 2)) == expected * 2


def test_sensor_track_differs_in_frames_and_has_the_same_truth(
    homes: Homes, sensor: HomesSensor, truth: GroundTruth
) -> None:
    assert load("dataset", "homes-sensor") is HomesSensor
    clean, recorded = homes.frame(SCENE, 12), sensor.frame(SCENE, 12)
    is_known = recorded.depth_m > 0
    assert 0.02 < 1 - is_known.mean() < 0.6  # depth is missing, but not everywhere
    error_m = np.abs(recorded.depth_m - clean.depth_m)[is_known]
    assert 0.0003 < np.median(error_m) < 0.03
    assert np.abs(recorded.rgb.astype(int) - clean.rgb).mean() > 1
    shift_m = np.linalg.norm(recorded.camera_to_world[:3, 3] - clean.camera_to_world[:3, 3])
    assert 0.0005 < shift_m < 0.1
    same = sensor.ground_truth(SCENE, "mesh-vertices")
    assert same.points.tobytes() == truth.points.tobytes()
    assert same.semantic.tobytes() == truth.semantic.tobytes() and same.instance.tobytes() == truth.instance.tobytes()


OF_HOMES = [name for name in protocol_names() if name.startswith("homes-")]
SETTINGS = ["--set", *(f"homes.{name}={value}" for name, value in SMALL.model_dump(exclude_unset=True).items())]


@pytest.fixture
def _in_data(rooms_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("_in_data")
def test_home_is_checked_shown_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", "check", f"homes/{SCENE}", "--quick", "--json", *SETTINGS]) == 0
    (checked,) = json.loads(capsys.readouterr().out)["scenes"]
    assert checked["n_frames"] == 24 and checked["n_errors"] == 0
    assert main(["datasets", "show", f"homes/{SCENE}", "--out", "home.png", "--stride", "12", *SETTINGS]) == 0
    assert Path("home.png").stat().st_size > 10_000
    capsys.readouterr()
    assert main(["datasets", "show", f"homes/{SCENE}", "--statistics", "--stride", "6", "--json", *SETTINGS]) == 0
    (row,) = json.loads(capsys.readouterr().out)["scenes"]
    assert (row["scene"], row["frames"], row["updates"]) == (f"homes/{SCENE}", 24, 4)
    assert 5 < row["instances_per_view"] < row["instances"] < 150


@pytest.mark.usefixtures("_in_data")
def test_ground_truth_of_a_home_is_scored_under_all_its_protocols(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--profile", "oracle", "--stride", "12", "--jobs", "1", "--no-pictures", "--out", "run", *SETTINGS]
    assert main(["run", f"homes/{SCENE}", "--methods", "oracle", "opensu3d", "--protocols", *OF_HOMES, *words]) == 0
    assert "mAcc novel" in capsys.readouterr().out
    results = json.loads(Path("run/metrics.json").read_text())["results"]
    found = {(one["protocol"], one["method"]): one["result"] for one in results}
    assert len(OF_HOMES) == 9 and {name for name, _ in found} == {*OF_HOMES}
    assert all(found[name, "opensu3d"] is not None for name in OF_HOMES)
    for name in ("homes-semantic", "homes-instance", "homes-panoptic"):
        assert {found[name, "oracle"]["metrics"][value] for value in load_protocol(name).headline} == {1.0}


@pytest.mark.usefixtures("_in_data")
def test_models_are_drawn_whole_in_their_own_colours() -> None:
    red = Material(Texture.PLAIN, (0.6, 0.05, 0.05), (0.6, 0.05, 0.05), gloss=0.0)
    part = Part(box(-0.5, 0.5, -0.2, 0.2, 0.0, 2.0), red)
    tile = draw_item(Item("thing", "red", "wood", "medium", (part,), (), np.array([1.0, 0.4, 2.0])))
    is_paper = (tile == PAPER).all(axis=-1)
    assert is_paper[[0, -1]].all() and is_paper[:, [0, -1]].all() and 0.2 < 1 - is_paper.mean() < 0.8
    assert (tile[~is_paper, 0] > tile[~is_paper, 2]).all()
    assert main(["datasets", "show", "homes", "--models", "beanbag", "--out", "models.png"]) == 0
    stored = decode_colour(Path("models.png").read_bytes(), "models.png")
    assert np.array_equal(stored, Homes.model_sheet(["beanbag"])[0]) and not (stored == PAPER).all()
    assert main(["datasets", "show", "rooms", "--models"]) == 2
