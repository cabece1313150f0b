"""Homes that change while nobody looks: objects that are moved, taken away or added, in one visit or between two."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Literal, cast

import numpy as np
from pydantic import Field

from su3d_bench.core.types import Float64Array, GroundTruth, InstanceMesh, Int64Array, SceneChange
from su3d_bench.datasets.homes.dataset import BuiltHome, HomeOptions, Homes
from su3d_bench.datasets.homes.plan import HomePlan, first
from su3d_bench.datasets.procedural.dataset import BuiltScene
from su3d_bench.datasets.procedural.items import Placed
from su3d_bench.datasets.procedural.rendering.render import Renderer
from su3d_bench.datasets.procedural.scan import SceneScan, kept_scan, scan_scene

LEAST_M, MOST_M = 0.1, 1.0  # height and longest side of what a person carries: lower things leave no measurable gap
MOVED_M = 0.5  # least distance between the old and the new place
N_PER_KIND = 4  # objects of a home that are moved, vanish, and appear
SAMPLED = 8  # every how many frames are checked for what they show
WIDTH, HEIGHT, LEAST_PX = 160, 120, 7  # of these checks: the 100 pixels of a mask of the oracle profile at 640 x 480
N_SEEN = 5  # checks that show an object or its place, before the change and after it: more than a second
Ids = tuple[int, ...]


class ChangingOptions(HomeOptions):
    """As for homes; ``visits``: 1, the change happens out of view in the middle of the walk; 2, between two walks.

    ``n_frames`` are those of all visits.
    """

    n_frames: int = Field(default=3200, ge=32, le=100_000)
    visits: Literal[1, 2] = 2

    def of_trajectory(self) -> tuple[object, ...]:
        return *super().of_trajectory(), self.visits


class BuiltChangingHome(BuiltHome):
    """A home as it is at the end; ``before``: as it was until the change."""

    @cached_property
    def everything(self) -> tuple[BuiltHome, Mapping[int, int]]:
        """The home with movable objects at their old and new places, in which the camera moves; new id by old id."""
        plan = self.furnished()
        return self._stage(plan, "everything"), add_places(plan, self._random("changes"))

    def _stage(self, plan: HomePlan, name: str) -> BuiltHome:
        """The home with another plan, whose data are cached in a folder ``name``."""
        home = BuiltHome(self.scene, self.options, self.folder and self.folder / name)
        home.plan = plan
        return home

    def make_trajectory(self) -> Float64Array:
        home, n, at = self.everything[0], self.options.n_frames, self.first_frame
        if self.options.visits == 1:
            return home.walk("walk", n)
        return np.concatenate([home.walk("walk", at), home.walk("second walk", n - at)])

    @property
    def first_frame(self) -> int:
        """The first frame after the change, in the middle."""
        return int(self.options.n_frames) // 2 // SAMPLED * SAMPLED

    @cached_property
    def change(self) -> tuple[HomePlan, HomePlan, Ids, Ids]:
        """The plans before and after the change, the ids of what is no longer where it was, and of what is new there.

        An object has the same id in both plans; those that vanish have the last ones, so that the others have no gap.
        """
        (home, new_of), is_one_visit = self.everything, self.options.visits == 1
        renderer, pixels = Renderer(home.unlit, WIDTH, HEIGHT), np.arange(WIDTH * HEIGHT)
        ids = (renderer.depth_and_instance(pose, pixels)[1] for pose in self.trajectory[::SAMPLED])
        n_px = np.stack([np.bincount(each, minlength=len(home.placed) + 1) for each in ids])
        moved, vanished, appeared = choose(n_px, self.first_frame // SAMPLED, new_of, is_one_visit)
        absent = {*new_of.values(), *vanished}
        order = [placed.id for placed in home.placed if placed.id not in absent]
        number = {old: k for k, old in enumerate([*order, *vanished], 1)}
        before = _numbered(home.plan, {old: k for old, k in number.items() if old not in appeared}, {})
        after = _numbered(home.plan, {old: number[old] for old in order}, {old: new_of[old] for old in moved})
        left, came = ([number[old] for old in (*moved, *others)] for others in (vanished, appeared))
        return before, after, tuple(left), tuple(came)

    @cached_property
    def plan(self) -> HomePlan:
        return self.change[1]

    @cached_property
    def before(self) -> BuiltHome:
        home = self._stage(self.change[0], "before")
        home.trajectory = self.trajectory[: self.first_frame]
        return home

    def at(self, index: int) -> BuiltScene:
        return self.before if index < self.first_frame else self

    @property
    def scan(self) -> SceneScan:
        poses, step = self.trajectory[self.first_frame :: self.scan_stride], self.options.mesh_spacing_m
        earlier = self.before.mesh, self.before.trajectory[:: self.scan_stride]
        return scan_scene(self.patches, self.mesh, poses, step, self.merged_m, earlier)


class HomesChanging(Homes):
    """Homes in which objects move, vanish or appear; ground truth is the home as it is at the end."""

    name = "homes-changing"
    cached_as = "homes-changing"
    Options = ChangingOptions
    options: ChangingOptions

    def build(self, scene: str, folder: Path | None) -> BuiltChangingHome:
        return BuiltChangingHome(scene, self.options, folder)

    def change(self, scene: str) -> SceneChange:
        """The change, with the surface seen before it."""
        path = self.root / self.cached_as / self._scan_key(scene) / f"{scene}.before.npz"
        built, last = self.built(scene), self.ground_truth(scene, "mesh-vertices")
        scan = kept_scan(path, self.name, lambda: built.before.scan)
        ids, row = np.unique(scan.object_of_vertex(), return_inverse=True)
        classes = np.array([_classes(built.before)[key] for key in ids.tolist()], np.int32)
        before = GroundTruth(scan.vertices, classes[row], ids[row], last.labels, last.variant, last.source)
        return SceneChange(built.first_frame, before, *built.change[2:])

    def instance_mesh(self, scene: str) -> InstanceMesh:
        """The mesh at the end, with the one before the change."""
        built, last = self.built(scene), super().instance_mesh(scene)
        mesh, classes = built.before.mesh, _classes(built.before)
        earlier = InstanceMesh(mesh.vertices, mesh.triangles, mesh.instance_of_triangle, classes, last.labels)
        return replace(last, earlier=earlier, first_frame=built.first_frame)

    def built(self, scene: str) -> BuiltChangingHome:
        return cast(BuiltChangingHome, super().built(scene))


def _classes(home: BuiltHome) -> dict[int, int]:
    return {placed.id: home.classes[placed.item.class_name].id for placed in home.placed}


def add_places(plan: HomePlan, rng: np.random.Generator) -> dict[int, int]:
    """Add to a furnished home a copy of each object that can be carried, at another free place: its id by the old id.

    Objects that hold others, hang, lie in others or give light stay where they are.
    """
    plan.rng = rng
    holders = {holder for holder, _ in plan.parent.values()}
    movable = [placed for placed in plan.placed if placed.id not in holders and _can_be_carried(plan, placed)]
    ids = {placed.id for placed in movable}
    others = [placed for placed in plan.placed[plan.n_structure :] if placed.id not in ids]
    spots = [(other, spot) for other in others for spot in other.item.spots if spot.role in ("top", "board")]
    new_of = {}
    for placed in (movable[k] for k in rng.permutation(len(movable))):
        n = len(plan.placed)
        if plan.mount[placed.id] == "object":
            some = (spots[k] for k in rng.permutation(len(spots))[:N_PER_KIND])
            new = first(plan.on_spot(placed.item, holder, spot, "any", 25.0) for holder, spot in some)
        else:
            new = plan.somewhere(placed.item, plan.layout.zones[int(rng.integers(len(plan.layout.zones)))])
        if new is not None and np.linalg.norm(new.position - placed.position) >= MOVED_M:
            new_of[placed.id] = new.id
        else:
            plan.back_to(n)
    return new_of


def _can_be_carried(plan: HomePlan, placed: Placed) -> bool:
    item, mount = placed.item, plan.mount[placed.id]
    is_free = mount == "floor" or (mount == "object" and plan.parent[placed.id][1] == "on")
    return is_free and not item.lights and item.size[2] >= LEAST_M and item.size.max() <= MOST_M


def choose(n_px: Int64Array, at: int, new_of: Mapping[int, int], is_out_of_view: bool) -> list[list[int]]:
    """The objects that are moved, vanish and appear at check ``at``; ``n_px`` (checks, ids): their pixels in a check.

    All are seen before at their old place, which is seen again. ``is_out_of_view``: no place is seen around the change.
    """
    before, after = ((part >= LEAST_PX).sum(axis=0) >= N_SEEN for part in (n_px[:at], n_px[at:]))
    n_near = n_px[at - 1 : at + 1].sum(axis=0) * is_out_of_view
    left = [old for old in new_of if before[old] and after[old] and not n_near[old]]
    moved = [old for old in left if after[new_of[old]] and not n_near[new_of[old]]][:N_PER_KIND]
    others = [old for old in left if old not in moved][: 2 * N_PER_KIND]
    return [moved, others[::2], others[1::2]]


def _numbered(plan: HomePlan, number: Mapping[int, int], place_of: Mapping[int, int]) -> HomePlan:
    """The plan with only the objects of ``number``, new id by old id; some at the place of another of ``plan``."""
    made = copy.copy(plan)
    made.placed = [replace(plan.placed[place_of.get(old, old) - 1], id=new) for old, new in number.items()]
    made.mount = {new: plan.mount[old] for old, new in number.items()}
    return made
