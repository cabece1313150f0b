"""What a dataset, a method and perception offer to the runner, and what it hands a method besides frames.

``Dataset`` and ``Method`` are what each must have. An ability that it may have is a protocol of its own;
``registry.load`` refuses a class with a misspelt one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from su3d_bench.core import types
from su3d_bench.core.maps import Prediction, Proposals


class DatasetAbility(Protocol):
    """What a dataset may offer besides; each is a protocol of its own."""


class MethodAbility(Protocol):
    """The same of a method."""


class RegionPerception(Protocol):
    """Perception on demand, for methods that choose themselves where in an image to look."""

    @property
    def dim(self) -> int: ...

    def mask_at(self, frame: types.Frame, points: types.Int64Array) -> tuple[types.BoolArray, float]:
        """The mask (H, W) of what lies under the pixels ``points`` (P, 2), x y, and how sure the segmenter is of it."""
        ...

    def encode_regions(self, frame: types.Frame, mask: types.BoolArray, boxes: types.Int64Array) -> types.Float32Array:
        """Features (B, dim), L2-normalised, of the crops ``boxes`` (B, 4), x0 y0 x1 y1, around the region ``mask``."""
        ...


@dataclass(frozen=True)
class SceneTools:
    """What a method that works on the whole scene may use besides its detections; never ground truth.

    ``frames`` are those of the updates, in their order, read anew at every access; ``surface`` raises ``DataError``
    where the dataset has no mesh; ``true_proposals`` is there where ``PerceptionNeeds.true_proposals`` asks for it.
    """

    frames: Sequence[types.Frame]
    regions: RegionPerception
    surface: Callable[[], types.Surface]
    true_proposals: Callable[[], Proposals] | None = None


class Dataset(Protocol):
    """Where frames and ground truth come from; one file a dataset.

    The class also has ``Options``, a strict model of its settings, ``label_space``, whose class ids its truth uses, and
    ``variants``, the forms of ground truth it can give, the fullest first; it is made as ``Cls(data_root, options)``.
    Frames are read from several threads at once. Its world has z up: pictures from above, heights and spatial words go
    by that.
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

    def info(self, scene: str, stride: int) -> types.SceneInfo: ...

    def frames(self, scene: str, stride: int) -> Sequence[types.Frame]:
        """Every ``stride``-th frame from 0, read lazily; ``len()`` and random access."""
        ...

    def ground_truth(self, scene: str, variant: str) -> types.GroundTruth:
        """The truth in the form that a protocol names; raises ``GroundTruthMissing`` where there is none."""
        ...

    def instance_mesh(self, scene: str) -> types.InstanceMesh:
        """The annotated mesh, for the oracle profile; raises ``GroundTruthMissing`` where there is none."""
        ...


class DatasetFacts(DatasetAbility, Protocol):
    """Values that the class may have; without one it is empty, or False.

    ``extra_ground_truths``: ground truths with labels of other label spaces than its own: label space -> the one of
    ``ground_truth``; ``renders_frames``: frames are computed and not read, so that none is made ahead, since the
    pipeline's timed stages would wait for the interpreter; ``reads_made_rooms``: rooms that the program makes are
    written in its layout, which are not its scenes; ``scene_names``: the regular expression of names that only its
    scenes have, by which files of predictions are known.
    """

    extra_ground_truths: Mapping[str, str]
    renders_frames: bool
    reads_made_rooms: bool
    scene_names: str


@runtime_checkable
class ListsFolders(DatasetAbility, Protocol):
    """The folders that a dataset searches."""

    def places(self) -> Sequence[Path]: ...


@runtime_checkable
class HasStatus(DatasetAbility, Protocol):
    """A word on a scene, from a quick look."""

    def status(self, scene: str) -> str: ...


@runtime_checkable
class HasGroups(DatasetAbility, Protocol):
    """Names for sets of scenes, such as official splits."""

    def groups(self) -> Mapping[str, Sequence[str]]: ...


@runtime_checkable
class ReportsProblems(DatasetAbility, Protocol):
    """Every fault of a scene's files, a line each."""

    def problems(self, scene: str) -> Sequence[str]: ...


@runtime_checkable
class HasReadingCorrections(DatasetAbility, Protocol):
    """Its files are read as a description says: whether depth shall be held against poses, and what to change in the
    description where another reading, a ``Finding`` of ``pose_convention``, agrees better."""

    def is_reading_checked(self, scene: str) -> bool: ...

    def correction_of_reading(self, scene: str, finding: Any) -> str: ...


@runtime_checkable
class ProvidesUpAxis(DatasetAbility, Protocol):
    """Its files may have any world: which axis of it points up."""

    def up(self, scene: str) -> types.WorldUp: ...


@runtime_checkable
class HasSurface(DatasetAbility, Protocol):
    """The scan's mesh without labels."""

    def surface(self, scene: str) -> types.Surface: ...


@runtime_checkable
class HasCompleteObjects(DatasetAbility, Protocol):
    """The objects of a scene as they are, of which the ground truth may hold what a recording saw alone."""

    def whole_objects(self, scene: str) -> Sequence[types.WholeObject]: ...


@runtime_checkable
class NamesCategories(Protocol):
    """The class of NYU40 that the dataset's table gives what an annotator typed; None where it is not there."""

    def nyu40_class(self, category: str) -> str | None: ...


@runtime_checkable
class IsAligned(Protocol):
    """The rigid motion (4, 4) from the frame of the truth to one whose axes are the walls."""

    def axis_alignment(self, scene: str) -> types.Float64Array: ...


@runtime_checkable
class HasQueries(DatasetAbility, Protocol):
    """Texts with ``kind`` and ``answers``, the ids of all objects that answer them."""

    def queries(self, scene: str) -> Sequence[Any]: ...


@runtime_checkable
class HasSceneQuery(DatasetAbility, Protocol):
    """The one text that a scene is searched for, known without its truth; its mesh has the vertices of the answer."""

    def asked_text(self, scene: str) -> str: ...


@runtime_checkable
class HasPreviews(DatasetAbility, Protocol):
    """A frame ``width`` pixels wide, in far less time than the whole; ``index`` is its place among all frames."""

    def sketch(self, scene: str, index: int, width: int) -> types.Frame: ...


class StageTimer(Protocol):
    def stage(self, name: str) -> Any:
        """A context manager that adds the time inside it to stage ``name`` of the current update."""
        ...


class Method(Protocol):
    """A system under test: fed frame by frame, asked for a map at the end or midway.

    The class also has ``Config``, a strict model of its settings; it is made as ``Cls(config)``.
    """

    name: str
    Config: type

    @property
    def needs(self) -> types.PerceptionNeeds: ...

    def start(self, scene: types.SceneInfo) -> None: ...

    def update(self, frame: types.Frame, detections: types.Detections, timer: StageTimer) -> None: ...

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


class MethodFacts(MethodAbility, Protocol):
    """Values that the class may have; without one it is empty, or False, ``is_system`` True.

    ``presets``: settings under a name, ``METHOD@PRESET`` is a method of its own; ``short_names``: other names of
    settings for sweeps, the setting and what a value written there comes to; ``is_system`` False: ``all`` methods are
    not meant to hold it, as the truth itself or a program that must be named; ``warms_up``: its first frames wait for
    compilers or imports, so that a scratch of its kind, without tools, is fed a made-up frame before the clock runs;
    ``needs_surface``: it cannot do without the scan's mesh, as it is set; ``has_own_perception``: it finds masks
    itself, so that the caveat of the run's perception is not its.
    """

    about: MethodAbout
    presets: Mapping[str, Mapping[str, Any]]
    short_names: Mapping[str, tuple[str, Callable[[Any], Any]]]
    is_system: bool
    warms_up: bool
    needs_surface: bool
    has_own_perception: bool


class MethodFigures(MethodAbility, Protocol):
    """Properties that an object may have: the points, instances and bytes of memory of its map after an update, what
    the last update left out by the name of its column in ``updates.csv``, numbers on the last ``finish`` that stand
    beside its time, digests by name of files outside the configuration that move its numbers, and what must be said
    beside these."""

    @property
    def n_points(self) -> int: ...

    @property
    def n_instances(self) -> int: ...

    @property
    def map_bytes(self) -> int: ...

    @property
    def losses(self) -> Mapping[str, int]: ...

    @property
    def finish_costs(self) -> Mapping[str, float | int]: ...

    @property
    def inputs(self) -> Mapping[str, str]: ...

    @property
    def caveat(self) -> str | None: ...


@runtime_checkable
class UsesSceneTools(MethodAbility, Protocol):
    """Works on the whole scene; called before ``start``."""

    def receive_tools(self, tools: SceneTools) -> None: ...


@runtime_checkable
class UsesGroundTruth(MethodAbility, Method, Protocol):
    """Is told the ground truth, and is a ceiling."""

    def receive_ground_truth(self, truth: types.GroundTruth) -> None: ...


@runtime_checkable
class Closable(MethodAbility, Protocol):
    """Gives back what it holds, called when the prediction is written or could not be."""

    def close(self) -> None: ...


INTERFACES = {"dataset": Dataset, "method": Method}
ABILITIES: dict[str, Sequence[type]] = {
    "dataset": DatasetAbility.__subclasses__(),
    "method": MethodAbility.__subclasses__(),
}


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

    def encode_images(self, images: Sequence[types.UInt8Array]) -> types.Float32Array:
        """Features (N, dim) of RGB crops (h, w, 3) at their native size."""
        ...

    def encode_texts(self, texts: Sequence[str]) -> types.Float32Array:
        """Features (N, dim) of texts."""
        ...


@runtime_checkable
class TrainedOnRelativeTexts(Protocol):
    """An encoder that was trained on texts of the form of the relative queries; ``relative_remark`` says so."""

    @property
    def relative_remark(self) -> str: ...


@runtime_checkable
class HasTrainingVocabulary(Protocol):
    """An encoder that was trained on a vocabulary that is known."""

    name: str

    def unseen_words(self, text: str) -> tuple[str, ...]:
        """The words of a text that stood in none that it was trained on."""
        ...


class Segmenter(Protocol):
    name: str
    digest: str

    def segment(self, frame: types.Frame) -> types.Regions: ...
