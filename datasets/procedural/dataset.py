"""Generated scenes as a dataset: frames rendered on access, scan, ground truth; what ``rooms`` and ``homes`` share."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.core.files.atomic import Scratch, StoredRows
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
from su3d_bench.datasets.procedural.items import Placed
from su3d_bench.datasets.procedural.rendering.mesh import Patches, SceneMesh, gather_patches, unlit_mesh
from su3d_bench.datasets.procedural.rendering.render import RenderedFrame, Renderer, camera_intrinsics
from su3d_bench.datasets.procedural.scan import SceneScan, kept_arrays, kept_scan, scan_scene
from su3d_bench.datasets.procedural.truth import Described, SceneObject, SceneTruth, attribute_of_object, truth_of

FRAMES_PER_SECOND = 30.0
SCENES_IN_MEMORY = 2
MAX_KEPT_FRAMES = 64  # of a scene, in a temporary file: 2 MB each at 640 x 480


class SceneOptions(BaseModel):
    """Image size, length of the trajectory, density of the scan."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: int = Field(default=640, ge=16, le=4096)
    height: int = Field(default=480, ge=16, le=4096)
    n_frames: int = Field(default=1600, ge=1, le=100_000)
    mesh_spacing_m: float = Field(default=0.015, ge=0.004, le=0.2)

    def of_trajectory(self) -> tuple[object, ...]:
        """The options that mesh and trajectory depend on."""
        return (self.n_frames,)


def generator(*words: object) -> np.random.Generator:
    """A random stream determined by the words, identical on every machine."""
    digest = hashlib.sha256("/".join(str(word) for word in words).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))


class Plan(Protocol):
    """A furnished scene: its kind, every object with ids from 1, and how each is held.

    ``mount``: floor, wall, ceiling, object, or room for parts of the room itself, by id.
    """

    @property
    def kind(self) -> str: ...

    @property
    def placed(self) -> Sequence[Placed]: ...

    @property
    def mount(self) -> Mapping[int, str]: ...


class BuiltScene(ABC):
    """A furnished scene; expensive parts are computed on first use and cached in ``folder`` if there is one."""

    classes: Mapping[str, Described]
    merged_m: float = 1e-4  # size of the cells in which vertices of the scan are merged
    scan_stride: int = 1  # every how many frames are checked for what they see

    def __init__(self, scene: str, options: Any, folder: Path | None) -> None:
        self.scene, self.options, self.folder = scene, options, folder
        self._coarser: Renderer | None = None

    @property
    @abstractmethod
    def plan(self) -> Plan: ...

    @property
    def kind(self) -> str:
        return self.plan.kind

    @property
    def placed(self) -> Sequence[Placed]:
        return self.plan.placed

    @property
    def mount(self) -> Mapping[int, str]:
        return self.plan.mount

    @abstractmethod
    def make_mesh(self) -> SceneMesh: ...

    @abstractmethod
    def make_trajectory(self) -> Float64Array:
        """Camera-to-world poses (n_frames, 4, 4), OpenCV axes, z up, metres."""

    def make_renderer(self, width: int, height: int, like: Renderer | None = None) -> Renderer:
        return Renderer(self.mesh, width, height, like)

    def at(self, index: int) -> BuiltScene:
        """The scene as frame ``index`` shows it."""
        return self

    @cached_property
    def truth(self) -> SceneTruth:
        return truth_of(self.scene, self.kind, self.placed, self.mount, self.classes)

    @cached_property
    def patches(self) -> Patches:
        return gather_patches(self.placed)

    @cached_property
    def unlit(self) -> SceneMesh:
        return unlit_mesh(self.patches)

    @cached_property
    def mesh(self) -> SceneMesh:
        names = SceneMesh.__dataclass_fields__
        return SceneMesh(**kept_arrays(self._kept_in("mesh"), names, lambda: vars(self.make_mesh())))

    @cached_property
    def renderer(self) -> Renderer:
        return self.make_renderer(self.options.width, self.options.height)

    def coarser(self, width: int) -> Renderer:
        """A renderer sharing the same tree, cached until another width is requested."""
        renderer = self._coarser  # threads may request different widths
        if renderer is None or renderer.width != width:
            height = max(1, round(self.options.height * width / self.options.width))
            renderer = self._coarser = self.make_renderer(width, height, self.renderer)
        return renderer

    @cached_property
    def trajectory(self) -> Float64Array:
        kept = kept_arrays(self._kept_in("walk"), ("poses",), lambda: {"poses": self.make_trajectory()})
        poses: Float64Array = kept["poses"]
        return poses

    @property
    def scan(self) -> SceneScan:
        """The surface seen on the trajectory, recomputed."""
        poses = self.trajectory[:: self.scan_stride]
        return scan_scene(self.patches, self.mesh, poses, self.options.mesh_spacing_m, self.merged_m)

    def _kept_in(self, what: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{self.scene}.{what}.npz"


class GeneratedScenes(ABC):
    """Rendered scenes; ``root`` contains their cached data."""

    name: str
    headline_protocol: str
    label_space: str
    renders_frames = True
    variants: tuple[str, ...] = ("mesh-vertices", "face-corners")
    extra_ground_truths = openscan.EXTRA_GROUND_TRUTHS
    image_domain: ImageDomain = "rendered-rooms"
    Options: type[SceneOptions] = SceneOptions
    cached_as: ClassVar[str]  # the folder of cached data, shared by datasets with the same scenes
    version: ClassVar[int]  # increase it whenever a scene of the same name changes
    sources: ClassVar[tuple[str, ...]]  # what affects a scene: part of the key of cached data
    default_scenes: ClassVar[tuple[str, ...]]

    def __init__(self, root: Path, options: Any = None) -> None:
        self.root = root
        self.options: Any = options or self.Options()
        self._built: OrderedDict[str, BuiltScene] = OrderedDict()
        self._kept = KeptFrames("")

    @staticmethod
    @abstractmethod
    def label_set() -> LabelSet: ...

    @abstractmethod
    def check_name(self, scene: str) -> None:
        """Raise ``DataError`` if there is no such scene."""

    @abstractmethod
    def build(self, scene: str, folder: Path | None) -> BuiltScene: ...

    def is_for_training(self, scene: str) -> bool:
        """Whether the scene is one of thousands used only to train the embedded encoder; these are not cached."""
        return False

    @property
    def intrinsics(self) -> Float64Array:
        return camera_intrinsics(self.options.width, self.options.height)

    def scenes(self) -> Sequence[str]:
        return self.default_scenes

    def files(self, scene: str) -> Sequence[Path]:
        self.check_name(scene)
        return ()

    def digest(self, scene: str) -> str:
        self.check_name(scene)
        words = f"{self.name}/{self.version}/{scene}/{self.options.model_dump_json()}"
        return hashlib.sha256(words.encode()).hexdigest()

    def info(self, scene: str, stride: int) -> SceneInfo:
        self.check_name(scene)
        n_frames = len(range(0, self.options.n_frames, stride))
        return SceneInfo(self.name, scene, n_frames, stride, self.image_domain)

    def truth(self, scene: str) -> SceneTruth:
        return self.built(scene).truth

    def objects(self, scene: str) -> tuple[SceneObject, ...]:
        return self.built(scene).truth.objects

    def whole_objects(self, scene: str) -> tuple[WholeObject, ...]:
        """Every object, complete, visible or not."""
        return tuple(known.whole() for known in self.objects(scene))

    def trajectory(self, scene: str) -> Float64Array:
        """Camera-to-world poses (n_frames, 4, 4), OpenCV axes, z up, metres."""
        return self.built(scene).trajectory

    def poses(self, scene: str) -> Float64Array:
        """The poses (N, 4, 4) of the frames."""
        return self.trajectory(scene)

    def render(self, scene: str, view: int | Float64Array) -> RenderedFrame:
        """The noise-free images at a frame of the trajectory or at any camera-to-world pose."""
        built = self.built(scene)
        if isinstance(view, int | np.integer):
            return built.at(int(view)).renderer.render(built.trajectory[view])
        return built.renderer.render(np.asarray(view, np.float64))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th frame, rendered on first access."""
        self.check_name(scene)
        if self._kept.scene != scene:
            self._kept = KeptFrames(scene)
        return RenderedFrames(self, self._kept, range(0, self.options.n_frames, stride))

    @abstractmethod
    def frame(self, scene: str, index: int) -> Frame:
        """The frame with this index, as the camera records it."""

    def sketch(self, scene: str, index: int, width: int) -> Frame:
        """A noise-free frame ``index`` with fewer pixels: colours and depths where the subsampled rays hit."""
        if width >= self.options.width:
            return self.frame(scene, index)
        built = self.built(scene)
        renderer, pose = built.at(index).coarser(width), built.trajectory[index]
        image = renderer.render(pose)
        intrinsics = camera_intrinsics(width, renderer.height)
        return Frame(index, index / FRAMES_PER_SECOND, image.rgb, image.depth_m, pose, intrinsics)

    def scan(self, scene: str) -> SceneScan:
        """The ground-truth surface; computed once, then read from the cache."""
        path = self.root / self.cached_as / self._scan_key(scene) / f"{scene}.npz"
        return kept_scan(path, self.name, lambda: self.built(scene).scan)

    def _scan_key(self, scene: str) -> str:
        """What a scan depends on: not on image size or noise."""
        from su3d_bench.core.digests import package_digest

        self.check_name(scene)
        words = package_digest(*self.sources), *self.options.of_trajectory(), self.options.mesh_spacing_m
        return hashlib.sha256("/".join(str(word) for word in words).encode()).hexdigest()[:16]

    def _cache_folder(self, scene: str) -> Path | None:
        """Cache folder of mesh and trajectory; None for training scenes and without a data root."""
        from su3d_bench.core.digests import NUMERIC_PACKAGES, digest_json, package_digest, package_versions

        self.check_name(scene)
        if self.is_for_training(scene) or not self.root.is_dir():
            return None
        packages = package_versions(NUMERIC_PACKAGES)  # another Open3D version may differ in the last bit
        words = package_digest(*self.sources), *self.options.of_trajectory(), sorted(packages.items())
        return self.root / self.cached_as / digest_json(words)[:16]

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        """Labelled scan vertices (``mesh-vertices``) or the corners of every face in face order (``face-corners``).

        For the name of an OpenScan aspect: the vertices, with attributes as classes.
        """
        made = f"{self.name} generator {self.version}"
        if variant in self.extra_ground_truths:
            scan = self.scan(scene)
            owner = scan.object_of_vertex()
            attributes = attribute_of_object(self.objects(scene), variant)[owner]
            source = f"{made}: attributes of the objects seen on the trajectory"
            return GroundTruth(scan.vertices, attributes, owner, openscan.label_set(variant), variant, source)
        if variant not in self.variants:
            known = " and ".join(self.variants)
            raise GroundTruthMissing(f"{self.name}/{scene}: no ground truth '{variant}'; available: {known}")
        scan = self.scan(scene)
        if variant == "mesh-vertices":
            points, owner = scan.vertices, scan.object_of_vertex()
        else:
            points, owner = scan.vertices[scan.faces.reshape(-1)], np.repeat(scan.object_id, 4)
        source = f"{made}: surface seen on the trajectory, {variant}"
        return GroundTruth(points, self._class_of_object(scene)[owner], owner, self.label_set(), variant, source)

    def _class_of_object(self, scene: str) -> Int32Array:
        return np.array([0, *[known.class_id for known in self.objects(scene)]], np.int32)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        """The complete rendered mesh, including hidden sides."""
        mesh = self.built(scene).mesh
        classes = {known.id: known.class_id for known in self.objects(scene)}
        return InstanceMesh(mesh.vertices, mesh.triangles, mesh.instance_of_triangle, classes, self.label_set())

    def surface(self, scene: str) -> Surface:
        """The scan without labels; each quad (0, 1, 2, 3) becomes the triangles (0, 1, 2) and (0, 2, 3).

        Its vertices are those of ``mesh-vertices``, in their order. No edge leads from one object to another.
        """
        scan = self.scan(scene)
        return Surface(scan.vertices, scan.faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))

    def built(self, scene: str) -> BuiltScene:
        """The furnished scene; the last two are kept."""
        if scene not in self._built:
            self._built[scene] = self.build(scene, self._cache_folder(scene))
            while len(self._built) > SCENES_IN_MEMORY:
                self._built.popitem(last=False)
        self._built.move_to_end(scene)
        return self._built[scene]


class KeptFrames:
    """The first frames of a scene that were rendered, in a temporary file, so that the next method need not wait."""

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self._scratch = Scratch(most_in_memory_bytes=1)
        self._lock = Lock()
        self._images: dict[int, tuple[StoredRows, StoredRows, Frame]] = {}

    def frame(self, index: int, render: Callable[[str, int], Frame]) -> Frame:
        """Frame ``index``, by ``render`` unless it is kept; kept images are read-only."""
        with self._lock:
            if index in self._images:
                rgb, depth_m, small = self._images[index]
                return replace(small, rgb=rgb.rows(0, rgb.shape[0]), depth_m=depth_m.rows(0, depth_m.shape[0]))
        frame = render(self.scene, index)
        with self._lock:
            if index not in self._images and len(self._images) < MAX_KEPT_FRAMES:
                small = replace(frame, rgb=frame.rgb[:1, :1].copy(), depth_m=frame.depth_m[:1, :1].copy())
                self._images[index] = self._scratch.put(frame.rgb), self._scratch.put(frame.depth_m), small
        return frame


class RenderedFrames(Sequence[Frame]):
    """Frames of one scene, each rendered on first access."""

    def __init__(self, dataset: GeneratedScenes, kept: KeptFrames, indices: range) -> None:
        self._dataset, self._kept, self._indices = dataset, kept, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> Frame:  # type: ignore[override]
        return self._kept.frame(self._indices[position], self._dataset.frame)
