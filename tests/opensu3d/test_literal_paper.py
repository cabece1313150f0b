"""The reference pipeline compared with a literal program of the paper's text, on random problems and on rooms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from literal_paper import NONE, Array, PaperProgram, Thing
from literal_problems import Problem, random_problem
from scipy.spatial import cKDTree

from su3d_bench.cli.main import main
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, SceneInfo
from su3d_bench.opensu3d.config import SCHEMES, OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D

ROOMS = ("living0", "bedroom0", "kitchen0", "office0")
OF_ONE_TEST = 60
SCENE = SceneInfo("made", "random", 5, 7, "rendered-rooms")


SAME_POINT_M = 1e-5  # maps are stored in float32


def differences(found: Instances, program: PaperProgram) -> list[str]:
    """One line per difference between a method's map and the paper's; empty if they are equal.

    Two maps are one where they hold the same points, and the same sets of them with the same views, name, caption,
    feature, box, centroid and score. Which numbers the ids are is free, but each is one instance's.
    """
    things, of_none = program.things(), np.flatnonzero(program.scene.ids == NONE)
    kept = np.concatenate([of_none, *(thing.rows for thing in things)]).astype(int)
    row_of = matched(found.points, program.scene.points[kept])
    if row_of is None:
        return [f"map: {len(found.points)} points, the paper has {len(kept)}, or others"]
    if len(found) != len(things):
        return [f"instances: {len(found)}, the paper has {len(things)}"]
    place = np.full(len(program.scene.ids), NONE)
    place[kept] = row_of
    k_of = {found.mask(k).tobytes(): k for k in range(len(found))}
    masks = [np.sort(place[thing.rows]).astype(found.indices.dtype).tobytes() for thing in things]
    if {*k_of} != {*masks}:
        return ["instances: others than the paper's"]
    pairs = [(k_of[mask], thing) for mask, thing in zip(masks, things, strict=True)]
    lines = [f"instance {k}: {line}" for k, thing in pairs for line in unlike(found, k, thing)]
    if len({*found.ids.tolist()}) != len(found):
        lines.append(f"ids: {found.ids.tolist()} name an instance each")
    return lines


def matched(points: Array, others: Array) -> Array | None:
    """The row of ``points`` that equals each of ``others``, or None if the points differ."""
    if len(points) != len(others):
        return None
    if not len(points):
        return np.zeros(0, int)
    distance, rows = cKDTree(points).query(others)
    is_one = (distance < SAME_POINT_M).all() and len(np.unique(rows)) == len(rows)
    return np.asarray(rows) if is_one else None


def unlike(found: Instances, k: int, thing: Thing) -> Iterator[str]:
    """The differences of instance ``k`` from ``thing``, except for its points."""
    views = [tuple(view) for view in found.views[found.view_indptr[k] : found.view_indptr[k + 1]].tolist()]
    assert found.features is not None
    if views != thing.views:
        yield f"views {views}, the paper has {thing.views}"
    if (found.names[k], found.captions[k]) != (thing.name, thing.caption):
        yield f"'{found.names[k]}', '{found.captions[k]}', the paper has '{thing.name}', '{thing.caption}'"
    values: dict[str, Array | float] = {
        "feature": thing.feature,
        "box": thing.box,
        "centroid": thing.centroid,
        "score": 1.0,
    }
    for what, of_paper in values.items():
        ours = getattr(found, "boxes" if what == "box" else f"{what}s")[k]
        if not np.allclose(ours, of_paper, rtol=1e-5, atol=1e-5):
            yield f"{what} {ours}, the paper has {of_paper}"


def both(problem: Problem) -> tuple[OpenSU3D, PaperProgram]:
    method, program = OpenSU3D(problem.settings), PaperProgram(problem.settings)
    method.start(SCENE)
    return method, program


@pytest.mark.parametrize("first", [0, *(pytest.param(n, marks=pytest.mark.proof) for n in (60, 120, 180, 240))])
def test_pipeline_matches_the_papers_text_on_random_problems(first: int) -> None:
    for seed in range(first, first + OF_ONE_TEST):
        problem = random_problem(seed)
        method, program = both(problem)
        for frame, detections in problem.images:
            method.update(frame, detections, Timer())
            program.add_image(frame, detections)
            where = f"problem {seed}, image {frame.index}"
            assert (where, method.n_points, method.n_instances) == (where, len(program.scene.ids), len(program.tracks))
        assert (seed, differences(method.finish(), program)) == (seed, [])
        method.close()


FAULTS: dict[str, Callable[[Instances], Instances]] = {
    "map": lambda found: replace(found, points=found.points + np.float32(1e-3)),
    "instances": lambda found: replace(found, indices=found.indices[::-1].copy()),
    "views": lambda found: replace(found, views=found.views + np.int32(1)),
    "name": lambda found: replace(found, names=("another",) * len(found)),
    "caption": lambda found: replace(found, captions=("another",) * len(found)),
    "feature": lambda found: replace(found, features=np.asarray(found.features) + np.float32(1e-3)),
    "box": lambda found: replace(found, boxes=found.boxes + np.float32(1e-3)),
    "centroid": lambda found: replace(found, centroids=found.centroids + np.float32(1e-3)),
    "score": lambda found: replace(found, scores=found.scores / 2),
    "ids": lambda found: replace(found, ids=found.ids * 0),
}


def test_map_that_differs_from_the_papers_is_detected() -> None:
    problem = random_problem(0)
    method, program = both(problem)
    for frame, detections in problem.images:
        method.update(frame, detections, Timer())
        program.add_image(frame, detections)
    found = method.finish()
    assert len(found) > 1
    assert differences(found, program) == []
    assert [name for name, fault in FAULTS.items() if not differences(fault(found), program)] == []


# The values of section III-A, and our readings of what the paper leaves open.
OF_THE_PAPER = {
    "crop_ratios": (0.8, 1.0, 1.2), "multi_scale": "direct", "multi_view": "direct", "top_m": 5, "border_px": 20.0,
    "border_reference_width": 1200, "border_shape": "disc", "border_pixel_rule": "background",
    "background_pixel_rule": "keep",
    "depth_min": 0.0, "depth_max": 10.0, "eps": 0.02, "frame_voxel": 0.02, "overlap_threshold": 0.3,
    "overlap_rule": "smaller-segment", "density": "scene", "dbscan_eps": 0.1, "dbscan_min_points": 20,
    "split_fraction": 0.8, "instance_score": "ones",
}  # fmt: skip


def test_defaults_are_those_of_the_paper() -> None:
    effective = OpenSU3DConfig().effective()
    assert {name: effective[name] for name in OF_THE_PAPER} == OF_THE_PAPER


class SideBySide(OpenSU3D):
    """OpenSU3D next to ``PaperProgram``, frame by frame; it fails if its map differs from that of the paper's text."""

    name = "side-by-side"
    warms_up = False

    def start(self, scene: SceneInfo) -> None:
        super().start(scene)
        self._program = PaperProgram(self.config)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        super().update(frame, detections, timer)
        self._program.add_image(frame, detections)
        assert (self.n_points, self.n_instances) == (len(self._program.scene.points), len(self._program.tracks))

    def finish(self) -> Instances:
        found = super().finish()
        lines = differences(found, self._program)
        assert not lines, "; ".join(lines)
        return found


def run_side_by_side(out: Path, profile: str, *words: str) -> None:
    """A run with each fusion scheme, which fails if its map is not the paper's."""
    methods = [f"{__file__}:SideBySide@{scheme}" for scheme in SCHEMES]
    options = ["--protocols", "rooms-instance", "--profile", profile, "--jobs", "1", "--no-pictures", "--quiet"]
    assert main(["run", "--methods", *methods, *options, "--out", str(out), *words]) == 0
    assert len(list(out.glob("scenes/*/side-by-side@*/prediction.npz"))) == len(methods)


@pytest.mark.proof
@pytest.mark.parametrize("profile", ["oracle", "embedded"])
def test_room_map_matches_the_papers_text(
    profile: str, tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    size = ["rooms.width=160", "rooms.height=120", "rooms.mesh_spacing_m=0.1"]
    run_side_by_side(tmp_path / "run", profile, "--scenes", "rooms/living0", "--limit", "6", "--set", *size)


@pytest.mark.proof
@pytest.mark.parametrize("profile", ["oracle", "embedded"])
@pytest.mark.parametrize("room", ROOMS)
def test_complete_room_map_matches_the_papers_text(
    room: str, profile: str, tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    run_side_by_side(tmp_path / "run", profile, "--scenes", f"rooms/{room}")
