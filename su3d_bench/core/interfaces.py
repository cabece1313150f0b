"""What a dataset, a method and perception offer to the runner, and what it hands a method besides frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Frame,
    GroundTruth,
    InstanceMesh,
    Int64Array,
    PerceptionNeeds,
    Prediction,
    Proposals,
    Regions,
    SceneInfo,
    Surface,
    UInt8Array,
)


class RegionPerception(Protocol):
    """Perception on demand, for methods that choose themselves where in an image to look."""

    dim: int

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """The mask (H, W) of what lies under the pixels ``points`` (P, 2), x y, and how sure the segmenter is of it."""
        ...

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """Features (B, dim), L2-normalised, of the crops ``boxes`` (B, 4), x0 y0 x1 y1, around the region ``mask``."""
        ...


@dataclass(frozen=True)
class SceneTools:
    """What a method that works on the whole scene may use besides its detections; never ground truth.

    ``frames`` are those of the updates, in their order, read anew at every access; ``surface`` raises ``DataError``
    where the dataset has no mesh; ``true_proposals`` is there where ``PerceptionNeeds.true_proposals`` asks for it.
    """

    frames: Sequence[Frame]
    regions: RegionPerception
    surface: Callable[[], Surface]
    true_proposals: Callable[[], Proposals] | None = None


class Dataset(Protocol):
    """Where frames and ground truth come from; one file a dataset.

    The class also has ``Options``, a strict model of its settings, ``label_space``, whose class ids its truth uses, and
    ``variants``, the forms of ground truth it can give, the fullest first; it is made as ``Cls(data_root, options)``.
    Frames are read from several threads at once.

    It may have: ``places()``, the folders that it searches; ``status(scene)``, a word on a scene from a quick look;
    ``groups()``, names for sets of scenes such as ``val``; ``problems(scene)``, every fault of its files, a line each;
    ``surface(scene)``, the scan's mesh without labels; ``queries(scene)``, texts with ``kind`` and ``answers``, the
    ids of all objects that answer them; ``renders_frames = True``, where frames are computed and not read: they are
    not made ahead then, since the pipeline's timed stages would wait for the interpreter.
    """

    name: str

    def scenes(self) -> Sequence[str]:
        """Scene names, the default ones first."""
        ...

    def files(self, scene: str) -> Sequence[Path]:
        """What the scene is read from, for checks and digests; empty where the scene is made on demand."""
        ...

    def digest(self, scene: str) -> str:
        """A content key: equal only where frames and ground truth are equal."""
        ...

    def info(self, scene: str, stride: int) -> SceneInfo: ...

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th frame from 0, read lazily; ``len()`` and random access."""
        ...

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        """The truth in the form that a protocol names; raises ``GroundTruthMissing`` where there is none."""
        ...

    def instance_mesh(self, scene: str) -> InstanceMesh:
        """The annotated mesh, for the oracle profile; raises ``GroundTruthMissing`` where there is none."""
        ...


class StageTimer(Protocol):
    def stage(self, name: str) -> Any:
        """A context manager that adds the time inside it to stage ``name`` of the current update."""
        ...


class Method(Protocol):
    """A system under test: fed frame by frame, asked for a map at the end or midway.

    It may have ``receive_tools(tools: SceneTools)``, called before ``start``; ``receive_device(device: str)``, called
    before that with ``cpu`` or ``cuda:0``, where it may compute with torch; ``n_points`` and ``n_instances``, the size
    of its map after an update; ``close()``, called when the prediction is written; ``caveat``, what must be said
    beside its numbers; ``about``, a ``MethodAbout``; ``inputs``, digests of files outside the configuration that move
    its numbers, by name; ``finish_costs``, numbers on the last ``finish`` that stand beside its time;
    ``has_own_perception``, so that the caveat of the run's perception is not its.
    """

    name: str
    Config: type

    @property
    def needs(self) -> PerceptionNeeds: ...

    def start(self, scene: SceneInfo) -> None: ...

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None: ...

    def finish(self) -> Prediction: ...


@dataclass(frozen=True)
class MethodAbout:
    """What a list of methods says of one: where it comes from and how far it has been shown to equal its original.

    ``paper``: authors, title, venue; ``source``: the original's repository, with the commit that was read; ``licence``
    of that repository; ``needs``: proposals, weights, extras, one entry each; ``status``: what has been shown, and no
    more.
    """

    paper: str
    source: str
    licence: str
    needs: tuple[str, ...]
    status: str


@runtime_checkable
class Encoder(Protocol):
    """Two towers into one space of ``dim`` dimensions; all outputs L2-normalised float32.

    It may have ``device``, where it runs, ``cpu`` or a device of torch: its features are compared there too.
    """

    name: str
    dim: int

    @property
    def digest(self) -> str:
        """A key that moves with the weights and with everything else that moves a feature."""
        ...

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        """Features (N, dim) of RGB crops (h, w, 3) at their native size."""
        ...

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        """Features (N, dim) of texts."""
        ...


class Segmenter(Protocol):
    name: str
    digest: str

    def segment(self, frame: Frame) -> Regions: ...
