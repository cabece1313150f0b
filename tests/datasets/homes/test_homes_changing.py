"""Homes that change: what is where before and after, out of whose view, and the ground truth of both stages."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.registry import load
from su3d_bench.core.types import Int32Array
from su3d_bench.datasets.homes.changing import BuiltChangingHome, HomesChanging
from su3d_bench.datasets.homes.dataset import BuiltHome
from su3d_bench.datasets.procedural.items import box_of
from su3d_bench.datasets.procedural.rendering.render import Renderer

SCENE, N_FRAMES = "test2", 1600


@pytest.fixture(scope="module", params=[1, 2])
def homes(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> HomesChanging:
    options = {"width": 160, "height": 120, "n_frames": N_FRAMES, "mesh_spacing_m": 0.06, "visits": request.param}
    return HomesChanging(tmp_path_factory.mktemp("data"), HomesChanging.Options(**options))


@pytest.fixture
def built(homes: HomesChanging, monkeypatch: pytest.MonkeyPatch) -> BuiltChangingHome:
    """The home in the dark, which is made in seconds."""
    monkeypatch.setattr(BuiltHome, "make_mesh", lambda stage: stage.unlit)
    return homes.built(SCENE)


def seen(home: BuiltChangingHome, index: int) -> Int32Array:
    renderer, pixels = Renderer(home.at(index).unlit, 160, 120), np.arange(160 * 120)
    return np.unique(renderer.depth_and_instance(home.trajectory[index], pixels)[1])


def test_changed_objects_are_moved_taken_away_or_added(built: BuiltChangingHome) -> None:
    before, after = ({placed.id: placed for placed in plan.placed} for plan in built.change[:2])
    assert sorted(after) == list(range(1, len(after) + 1)), "the ids at the end have no gap"
    left, came = map(set, built.change[2:])
    assert left - came and came - left and left & came, "all three kinds"
    assert set(before) - set(after) == left - came and set(after) - set(before) == came - left
    for key in before.keys() & after.keys():
        assert before[key].item is after[key].item
        moved_m = np.linalg.norm(before[key].position - after[key].position)
        assert moved_m >= 0.5 if key in left else moved_m == 0
    boxes = [(key, box_of(placed)) for plan in (before, after) for key, placed in plan.items() if key in left | came]
    assert not any(
        a.overlaps(b) and (a.low + 0.05 < b.high - 0.05).all() and i != j for i, a in boxes for j, b in boxes
    )


def test_change_happens_out_of_view_or_between_visits(built: BuiltChangingHome, homes: HomesChanging) -> None:
    at, (_, _, left, came) = built.first_frame, built.change
    assert at == N_FRAMES // 2
    if homes.options.visits == 2:
        one, other = built.trajectory[:at, :3, 3], built.trajectory[at:, :3, 3]
        nearest = np.linalg.norm(other[:, None, :2] - one[None, :, :2], axis=2).min(axis=1)
        assert nearest.max() < 0.3 and not np.allclose(one, other, atol=0.05), "the same way, walked differently"
    else:
        before = Renderer(built.before.unlit, 160, 120).depth_and_instance(built.trajectory[at], np.arange(160 * 120))
        assert not np.isin(came, seen(built, at)).any() and not np.isin(left, before[1]).any()
    later = set.union(*(set(seen(built, k).tolist()) for k in range(at, N_FRAMES, 20)))
    assert set(came) <= later and not (set(left) - set(came)) & later


def test_frames_and_ground_truth_show_the_stage(built: BuiltChangingHome, homes: HomesChanging) -> None:
    assert load("dataset", "homes-changing") is HomesChanging
    change, last = homes.change(SCENE), homes.ground_truth(SCENE, "mesh-vertices")
    assert (change.first_frame, change.left, change.came) == (built.first_frame, *built.change[2:])
    vanished, appeared = set(change.left) - set(change.came), set(change.came) - set(change.left)
    assert vanished <= set(change.before.instance) and not vanished & set(last.instance)
    assert appeared <= set(last.instance) and not appeared & set(change.before.instance)
    class_of = {int(key): int(one) for key, one in zip(last.instance, last.semantic, strict=True)}
    for key, one in {*zip(change.before.instance.tolist(), change.before.semantic.tolist(), strict=True)}:
        assert class_of.get(key, one) == one, "an object keeps its class"
    for index in (0, N_FRAMES - 1):
        pose, stage = built.trajectory[index], built.before if index == 0 else built
        assert np.array_equal(homes.frames(SCENE, 1)[index].depth_m, stage.renderer.render(pose).depth_m)
    mesh = homes.instance_mesh(SCENE)
    assert mesh.earlier is not None and mesh.first_frame == built.first_frame
    assert vanished <= set(mesh.earlier.instance_of_triangle) and not vanished & set(mesh.instance_of_triangle)
