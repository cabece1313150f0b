"""Built-in procedural indoor scenes: generated on demand from a name, rendered by ray casting, fully annotated."""

from __future__ import annotations

import hashlib
import re
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import DataError, GroundTruthMissing, nearest
from su3d_bench.core.types import (
    Float64Array,
    Frame,
    GroundTruth,
    ImageDomain,
    InstanceMesh,
    Int32Array,
    LabelSet,
    SceneInfo,
    Surface,
    WholeObject,
)
from su3d_bench.datasets import openscan
from su3d_bench.datasets.rooms.classes import CLASS_ID
from su3d_bench.datasets.rooms.plan import Plan
from su3d_bench.datasets.rooms.recipes import KINDS, furnish
from su3d_bench.datasets.rooms.rendering.mesh import Patches, RoomMesh, build_mesh, gather_patches
from su3d_bench.datasets.rooms.rendering.render import LEVELS, RenderedFrame, Renderer, add_noise, camera_intrinsics
from su3d_bench.datasets.rooms.scan import RoomScan, kept_arrays, kept_scan, scan_room
from su3d_bench.datasets.rooms.trajectory import walk
from su3d_bench.datasets.rooms.truth import RoomObject, RoomTruth, attribute_of_object, truth_of

SOURCES = ("datasets/rooms", "numerics")  # what affects a room: part of the key of cached data
GENERATOR_VERSION = 3  # increase it whenever a scene of the same name changes
DEFAULT_SCENES = ("living0", "bedroom0", "kitchen0", "office0", "bathroom0", "studio0", "living1", "office1")
TRAINING_FROM = 10_000  # numbers from here on are reserved for training the embedded encoder; no benchmark uses them
FRAMES_PER_SECOND = 30.0
N_STRUCTURE = 6  # floor, ceiling and four walls have the ids 1..6
ROOMS_IN_MEMORY = 2


class RoomOptions(BaseModel):
    """Image size, length of the trajectory, sensor noise (0 none, 1 mild, 2 strong), density of the scan."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: int = Field(default=640, ge=16, le=4096)
    height: int = Field(default=480, ge=16, le=4096)
    n_frames: int = Field(default=1600, ge=1, le=100_000)
    noise: int = Field(default=0, ge=0, lt=len(LEVELS))
    mesh_spacing_m: float = Field(default=0.015, ge=0.004, le=0.2)
    seed_offset: int = Field(default=0, ge=0)


@cache
def label_set() -> LabelSet:
    """The classes of the rooms, which are Replica's."""
    return LabelSet("replica", tuple(CLASS_ID.values()), tuple(CLASS_ID))


def scene_name_parts(scene: str) -> tuple[str, int]:
    """Kind and number of a scene name; raises ``DataError`` if it is not a scene."""
    match = re.fullmatch(r"([a-z]+)(0|[1-9]\d{0,5})", scene)
    if match is None or match[1] not in KINDS:
        hint = nearest(scene, DEFAULT_SCENES) or f"; kinds: {', '.join(KINDS)}"
        raise DataError(f"rooms: no scene '{scene}'; a scene is a kind and a number such as office3{hint}")
    return match[1], int(match[2])


def _generator(*words: object) -> np.random.Generator:
    """A random stream determined by the words, identical on every machine."""
    digest = hashlib.sha256("/".join(str(word) for word in words).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))


@dataclass
class BuiltRoom:
    """A furnished room; expensive parts are computed on first use and cached in ``folder`` if there is one."""

    scene: str
    options: RoomOptions
    folder: Path | None
    _coarser: Renderer | None = field(default=None, init=False)

    @cached_property
    def plan(self) -> Plan:
        return furnish(scene_name_parts(self.scene)[0], _generator("room", self.scene, self.options.seed_offset))

    @cached_property
    def truth(self) -> RoomTruth:
        return truth_of(self.scene, scene_name_parts(self.scene)[0], self.plan)

    @cached_property
    def patches(self) -> Patches:
        return gather_patches(self.plan.placed)

    @cached_property
    def mesh(self) -> RoomMesh:
        exposure = float(_generator("exposure", self.scene, self.options.seed_offset).uniform(0.58, 0.72))
        arrays = kept_arrays(
            self._kept_in("mesh"),
            RoomMesh.__dataclass_fields__,
            lambda: vars(build_mesh(self.patches, self.plan.lights, exposure)),
        )
        return RoomMesh(**arrays)

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.mesh, self.options.width, self.options.height)

    def coarser(self, width: int) -> Renderer:
        """A renderer sharing the same tree, cached until another width is requested."""
        if self._coarser is None or self._coarser.width != width:
            height = max(1, round(self.options.height * width / self.options.width))
            self._coarser = Renderer(self.mesh, width, height, self.renderer)
        return self._coarser

    @cached_property
    def trajectory(self) -> Float64Array:
        poses: Float64Array = kept_arrays(self._kept_in("walk"), ("poses",), lambda: {"poses": self._walk()})["poses"]
        return poses

    @property
    def scan(self) -> RoomScan:
        """The surface seen on the trajectory, recomputed."""
        return scan_room(self.patches, self.mesh, self.trajectory, self.options.mesh_spacing_m)

    def _kept_in(self, what: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{self.scene}.{what}.npz"

    def _walk(self) -> Float64Array:
        plan = self.plan
        size = plan.width, plan.depth, plan.height
        rng = _generator("walk", self.scene, self.options.seed_offset)
        return walk(self.mesh, list(plan.boxes.values()), size, N_STRUCTURE, self.options.n_frames, rng)


class Rooms:
    """Furnished rooms, generated from their names; ``root`` contains their cached data."""

    name = "rooms"
    headline_protocol = "rooms-semantic"  # the paper's mAcc and F-mIoU on Replica, whose classes the rooms have
    label_space = "replica"
    renders_frames = True
    variants: tuple[str, ...] = ("mesh-vertices", "face-corners")
    extra_ground_truths = openscan.EXTRA_GROUND_TRUTHS
    image_domain: ImageDomain = "rendered-rooms"
    Options = RoomOptions

    def __init__(self, root: Path, options: RoomOptions | None = None) -> None:
        self.root = root
        self.options = options or RoomOptions()
        self._rooms: OrderedDict[str, BuiltRoom] = OrderedDict()

    @property
    def intrinsics(self) -> Float64Array:
        return camera_intrinsics(self.options.width, self.options.height)

    def scenes(self) -> Sequence[str]:
        return DEFAULT_SCENES

    def files(self, scene: str) -> Sequence[Path]:
        scene_name_parts(scene)
        return ()

    def digest(self, scene: str) -> str:
        scene_name_parts(scene)
        words = f"rooms/{GENERATOR_VERSION}/{scene}/{self.options.model_dump_json()}"
        return hashlib.sha256(words.encode()).hexdigest()

    def info(self, scene: str, stride: int) -> SceneInfo:
        scene_name_parts(scene)
        n_frames = len(range(0, self.options.n_frames, stride))
        return SceneInfo(self.name, scene, n_frames, stride, self.image_domain)

    def truth(self, scene: str) -> RoomTruth:
        return self._room(scene).truth

    def objects(self, scene: str) -> tuple[RoomObject, ...]:
        return self._room(scene).truth.objects

    def whole_objects(self, scene: str) -> tuple[WholeObject, ...]:
        """Every object, complete, visible or not."""
        return tuple(known.whole() for known in self.objects(scene))

    def trajectory(self, scene: str) -> Float64Array:
        """Camera-to-world poses (n_frames, 4, 4), OpenCV axes, z up, metres."""
        return self._room(scene).trajectory

    def render(self, scene: str, view: int | Float64Array) -> RenderedFrame:
        """The noise-free images at a frame of the trajectory or at any camera-to-world pose."""
        room = self._room(scene)
        pose = room.trajectory[view] if isinstance(view, int | np.integer) else np.asarray(view, np.float64)
        return room.renderer.render(pose)

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th frame, rendered on access."""
        scene_name_parts(scene)
        return RoomFrames(self, scene, range(0, self.options.n_frames, stride))

    def frame(self, scene: str, index: int) -> Frame:
        image = self.render(scene, index)
        rng = _generator("noise", scene, self.options.seed_offset, index)
        rgb, depth_m = add_noise(image.rgb, image.depth_m, self.options.noise, rng)
        return Frame(index, index / FRAMES_PER_SECOND, rgb, depth_m, self.trajectory(scene)[index], self.intrinsics)

    def sketch(self, scene: str, index: int, width: int) -> Frame:
        """A noise-free frame ``index`` with fewer pixels: colours and depths where the subsampled rays hit."""
        if width >= self.options.width:
            return self.frame(scene, index)
        room = self._room(scene)
        renderer, pose = room.coarser(width), room.trajectory[index]
        image = renderer.render(pose)
        intrinsics = camera_intrinsics(width, renderer.height)
        return Frame(index, index / FRAMES_PER_SECOND, image.rgb, image.depth_m, pose, intrinsics)

    def scan(self, scene: str) -> RoomScan:
        """The ground-truth surface; computed once, then read from the cache."""
        path = self.root / "rooms" / self._scan_key(scene) / f"{scene}.npz"
        return kept_scan(path, lambda: self._room(scene).scan)

    def _scan_key(self, scene: str) -> str:
        """What a scan depends on: not on image size or noise."""
        from su3d_bench.core.digests import package_digest

        scene_name_parts(scene)
        options = self.options
        words = package_digest(*SOURCES), options.n_frames, options.mesh_spacing_m, options.seed_offset
        return hashlib.sha256("/".join(str(word) for word in words).encode()).hexdigest()[:16]

    def _baked_folder(self, scene: str) -> Path | None:
        """Cache folder of mesh and trajectory; None for the thousands of training scenes and without a data root."""
        from su3d_bench.core.digests import NUMERIC_PACKAGES, digest_json, package_digest, package_versions

        _, number = scene_name_parts(scene)
        if number >= TRAINING_FROM or not self.root.is_dir():
            return None
        packages = package_versions(NUMERIC_PACKAGES)  # another Open3D version may differ in the last bit
        words = package_digest(*SOURCES), self.options.n_frames, self.options.seed_offset, sorted(packages.items())
        return self.root / "rooms" / digest_json(words)[:16]

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        """Labelled scan vertices (``mesh-vertices``) or the corners of every face in face order (``face-corners``).

        For the name of an OpenScan aspect: the vertices, with attributes as classes.
        """
        if variant in self.extra_ground_truths:
            return self._attribute_truth(scene, variant)
        if variant not in self.variants:
            raise GroundTruthMissing(
                f"rooms/{scene}: no ground truth '{variant}'; available: {' and '.join(self.variants)}"
            )
        scan = self.scan(scene)
        if variant == "mesh-vertices":
            points, owner = scan.vertices, scan.object_of_vertex()
        else:
            points, owner = scan.vertices[scan.faces.reshape(-1)], np.repeat(scan.object_id, 4)
        source = f"rooms generator {GENERATOR_VERSION}: surface seen on the trajectory, {variant}"
        return GroundTruth(points, self._class_of_object(scene)[owner], owner, label_set(), variant, source)

    def _attribute_truth(self, scene: str, variant: str) -> GroundTruth:
        scan = self.scan(scene)
        owner = scan.object_of_vertex()
        attributes = attribute_of_object(self.objects(scene), variant)[owner]
        source = f"rooms generator {GENERATOR_VERSION}: attributes of the objects seen on the trajectory"
        return GroundTruth(scan.vertices, attributes, owner, openscan.label_set(variant), variant, source)

    def _class_of_object(self, scene: str) -> Int32Array:
        return np.array([0, *[room_object.class_id for room_object in self.objects(scene)]], np.int32)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        """The complete rendered mesh, including hidden sides."""
        mesh = self._room(scene).mesh
        classes = {room_object.id: room_object.class_id for room_object in self.objects(scene)}
        return InstanceMesh(mesh.vertices, mesh.triangles, mesh.instance_of_triangle, classes, label_set())

    def surface(self, scene: str) -> Surface:
        """The scan without labels; each quad (0, 1, 2, 3) becomes the triangles (0, 1, 2) and (0, 2, 3).

        Its vertices are those of ``mesh-vertices``, in their order. No edge leads from one object to another.
        """
        scan = self.scan(scene)
        return Surface(scan.vertices, scan.faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))

    def _room(self, scene: str) -> BuiltRoom:
        if scene not in self._rooms:
            self._rooms[scene] = BuiltRoom(scene, self.options, self._baked_folder(scene))
            while len(self._rooms) > ROOMS_IN_MEMORY:
                self._rooms.popitem(last=False)
        self._rooms.move_to_end(scene)
        return self._rooms[scene]


class RoomFrames(Sequence[Frame]):
    """Frames of one room, each rendered on access."""

    def __init__(self, rooms: Rooms, scene: str, indices: range) -> None:
        self._rooms, self._scene, self._indices = rooms, scene, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> Frame:  # type: ignore[override]
        return self._rooms.frame(self._scene, self._indices[position])
