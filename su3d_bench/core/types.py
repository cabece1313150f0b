"""The data types passed between packages: frozen dataclasses, checked once on creation.

Coordinates are metres in the world frame, with z up, unless a name states otherwise; camera axes are OpenCV's
(x right, y down, z forward).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.arguments import check_fields
from su3d_bench.core.errors import DataError

BoolArray = NDArray[np.bool_]
UInt8Array = NDArray[np.uint8]
Int32Array = NDArray[np.int32]
Int64Array = NDArray[np.int64]
Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer[Any]]
FloatArray = NDArray[np.floating[Any]]

ImageDomain = Literal["rendered-rooms", "camera"]
MaskKind = Literal["grounded", "class-agnostic", "none"]
Interval = tuple[float, float]
UP = 1  # the vertical axis in building graphs, as in Habitat
UpAxis = Literal["x", "-x", "y", "-y", "z", "-z"]


@dataclass(frozen=True)
class Frame:
    """One posed RGB-D image.

    ``rgb`` (H, W, 3) uint8; ``depth_m`` (H, W) float32, along the optical axis, 0 where invalid;
    ``camera_to_world`` (4, 4) float64; ``intrinsics`` (3, 3) float64 in pixels.
    ``index`` is the position in the full sequence.

    >>> import numpy as np, su3d_bench as su3d
    >>> camera = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    >>> black, two_metres = np.zeros((24, 32, 3), np.uint8), np.full((24, 32), 2.0, np.float32)
    >>> su3d.Frame(0, 0.0, black, two_metres, np.eye(4), camera).depth_m.shape
    (24, 32)
    >>> su3d.Frame(7, 0.0, black, two_metres[1:], np.eye(4), camera)
    Traceback (most recent call last):
    su3d_bench.core.errors.DataError: frame 7: depth is 32x23 and colour is 32x24; both must have the same size
    """

    index: int
    timestamp_s: float
    rgb: UInt8Array
    depth_m: Float32Array
    camera_to_world: Float64Array
    intrinsics: Float64Array

    def __post_init__(self) -> None:
        where = f"frame {self.index}"
        check_fields(self, where, DataError)
        if self.rgb.ndim != 3 or self.rgb.shape[2] != 3 or self.rgb.dtype != np.uint8:
            raise DataError(f"{where}: colour is {self.rgb.shape} {self.rgb.dtype}; expected (height, width, 3) uint8")
        if self.depth_m.shape != self.rgb.shape[:2]:
            raise DataError(
                f"{where}: depth is {_size(self.depth_m)} and colour is {_size(self.rgb)}; both must have the same size"
            )
        if self.depth_m.dtype.kind != "f":
            raise DataError(f"{where}: depth is {self.depth_m.dtype.name}; expected float32 metres, 0 for no depth")
        if self.camera_to_world.shape != (4, 4) or not np.isfinite(self.camera_to_world).all():
            raise DataError(f"{where}: the pose is not a finite 4x4 matrix; drop the frame or fix the trajectory")
        if self.intrinsics.shape != (3, 3) or not np.isfinite(self.intrinsics).all():
            raise DataError(f"{where}: the intrinsics are not a finite 3x3 matrix")
        for name, kind in (("depth_m", np.float32), ("camera_to_world", np.float64), ("intrinsics", np.float64)):
            object.__setattr__(self, name, np.asarray(getattr(self, name), kind))


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


@dataclass(frozen=True)
class SceneInfo:
    """What a method knows of a scene before its first frame; never ground truth.

    ``read_surface`` reads the scan's mesh; None if there is none. Methods call ``surface()``.

    >>> import su3d_bench as su3d
    >>> su3d.SceneInfo("rooms", "living0", n_frames=25, stride=40, image_domain="rendered-rooms").seed
    0
    """

    dataset: str
    scene: str
    n_frames: int
    stride: int
    image_domain: ImageDomain
    seed: int = 0
    read_surface: Callable[[], Surface] | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_fields(self, f"scene {self.scene}", DataError)

    def surface(self) -> Surface:
        """The scan's mesh without labels: ``vertices`` (V, 3) float32 m, ``triangles`` (T, 3) int32, and ``segments``
        (V,) or None; read at every call. Raises ``DataError`` if the dataset has no mesh."""
        if self.read_surface is None:
            raise DataError(f"{self.dataset}/{self.scene}: the dataset has no mesh, which this method needs")
        return self.read_surface()


@dataclass(frozen=True)
class WorldUp:
    """The axis that points up in the world of a recording's files; ``axis`` None if unknown.

    ``is_turned``: its description states the axis, and its frames are rotated so that z points up. Otherwise frames are
    as in the files, and the axis is a guess based on ``reason``; ``remedy``: what to do if the guess is right.
    """

    axis: UpAxis | None
    is_turned: bool
    reason: str
    remedy: str = "turn the poses"

    @property
    def doubt(self) -> str | None:
        """A warning if the guess is another axis than z, because everything that uses heights assumes z; or None."""
        if self.is_turned or self.axis in (None, "z"):
            return None
        return f"z is assumed to be up, but {self.axis} seems to be ({self.reason}); {self.remedy}"


@dataclass(frozen=True)
class LabelSet:
    """Class ids and their names in a label space, usually named after its dataset; id 0 is never a class.

    >>> import su3d_bench as su3d
    >>> su3d.LabelSet("mine", (3, 7), ("chair", "table")).name_of(7)
    'table'
    """

    space: str
    ids: tuple[int, ...]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        check_fields(self, "label set", DataError)
        if len(self.ids) != len(self.names) or len(set(self.ids)) != len(self.ids):
            raise DataError(f"label set '{self.space}': ids and names must pair up, each id once")

    def name_of(self, class_id: int) -> str:
        return self.names[self.ids.index(class_id)]


@dataclass(frozen=True)
class WholeObject:
    """A complete object of a scene, including parts not seen in a recording.

    ``id``: its instance in the ground truth; ``name`` in everyday language; ``box`` (2, 3), minimum and maximum corner
    in metres; ``adjectives``: properties visible in any picture of it; ``colour``: its colour, empty if unknown.
    """

    id: int
    name: str
    box: Float64Array
    adjectives: tuple[str, ...] = ()
    colour: str = ""


@dataclass(frozen=True)
class TrueGraph:
    """An annotated scene graph: the class id of each object by instance id, with or without points, and relations as
    instance id of the subject, predicate, instance id of the object."""

    class_of_object: Mapping[int, int]
    relations: tuple[tuple[int, str, int], ...]

    def __post_init__(self) -> None:
        for relation in self.relations:
            for object_id in relation[::2]:
                if object_id not in self.class_of_object:
                    raise DataError(f"scene graph: a relation names object {object_id}, which is not in the graph")


@dataclass(frozen=True)
class Floor:
    """A storey of a building's graph, in a world whose y points up, from ``lowest_m`` to ``highest_m``."""

    lowest_m: float
    highest_m: float


@dataclass(frozen=True)
class Room:
    """A room: ``points`` (K, 3) m inside it, its heights, and the mean of these or of its points.

    ``category`` is its name, '' if it has none.
    """

    points: Float64Array
    lowest_m: float
    highest_m: float
    middle_m: float
    category: str = ""


@dataclass(frozen=True)
class Places:
    """Floors and rooms; for ground truth also ``object_boxes``: instance id -> centre and sides (2, 3) m."""

    floors: tuple[Floor, ...]
    rooms: tuple[Room, ...]
    object_boxes: Mapping[int, Float64Array] = field(default_factory=dict)


@dataclass(frozen=True)
class GroundTruth:
    """Labelled points of a scene in one ``variant`` (mesh-vertices, face-corners, ...).

    ``points`` (N, 3) float32 m; ``semantic`` (N,) int32 class ids of ``labels``, 0 if unannotated;
    ``instance`` (N,) int32 ids unique in the scene, 0 for none; ``source`` describes how it was made.
    ``evaluation_points`` (P, 3) float32 if a protocol scores points of another cloud than the labelled one.
    ``boxes`` if only the boxes of the objects are known; the points lie on these.
    ``every_semantic`` (N, K) int32 if points may have several classes: all of them in the order of the annotation,
    then 0; ``semantic`` and ``instance`` are those of the one object chosen for the point. ``semantic`` -1 marks points
    that evaluations ignore, in ground truth and predictions; it occurs only if a protocol requires it.
    ``graph`` if relations between objects are annotated, ``places`` if floors and rooms are known.

    >>> import numpy as np, su3d_bench as su3d
    >>> labels = su3d.LabelSet("mine", (3,), ("chair",))
    >>> of_points = np.array([3, 3, 0], np.int32), np.array([1, 1, 0], np.int32)
    >>> truth = su3d.GroundTruth(np.zeros((3, 3), np.float32), *of_points, labels, "mesh-vertices", "by hand")
    >>> truth.labels.name_of(truth.semantic[0])
    'chair'
    """

    points: Float32Array
    semantic: Int32Array
    instance: Int32Array
    labels: LabelSet
    variant: str
    source: str
    evaluation_points: Float32Array | None = None
    boxes: ObjectBoxes | None = None
    every_semantic: Int32Array | None = None
    graph: TrueGraph | None = None
    places: Places | None = None

    def __post_init__(self) -> None:
        check_fields(self, f"ground truth '{self.variant}'", DataError)
        n = len(self.points)
        if self.points.shape != (n, 3) or self.semantic.shape != (n,) or self.instance.shape != (n,):
            raise DataError(
                f"ground truth '{self.variant}': points {self.points.shape}, semantic {self.semantic.shape} and "
                f"instance {self.instance.shape} do not agree"
            )
        if self.every_semantic is not None and (self.every_semantic.ndim != 2 or len(self.every_semantic) != n):
            raise DataError(
                f"ground truth '{self.variant}': every_semantic {self.every_semantic.shape}; expected one row "
                f"for each of {n} points"
            )


@dataclass(frozen=True)
class SceneChange:
    """A change of a scene: frames before ``first_frame`` show ``before``, the others what is there at the end.

    ``left``: ids of objects that are no longer where they were; ``came``: of those at a new place; moved ones are both.
    """

    first_frame: int
    before: GroundTruth
    left: tuple[int, ...]
    came: tuple[int, ...]


@dataclass(frozen=True)
class InstanceMesh:
    """The annotated surface, from which the runner projects perfect masks.

    ``vertices`` (V, 3) float32 m; ``triangles`` (T, 3) int32; ``instance_of_triangle`` (T,) int32, 0 for none;
    ``class_of_instance`` maps an instance id to a class id of ``labels``. If the scene changes, frames before
    ``first_frame`` show the mesh ``earlier``.

    >>> import numpy as np, su3d_bench as su3d
    >>> labels = su3d.LabelSet("mine", (3,), ("chair",))
    >>> corners, triangle = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    >>> mesh = su3d.InstanceMesh(corners, triangle, np.array([1], np.int32), {1: 3}, labels)
    >>> mesh.labels.name_of(mesh.class_of_instance[1])
    'chair'
    """

    vertices: Float32Array
    triangles: Int32Array
    instance_of_triangle: Int32Array
    class_of_instance: Mapping[int, int]
    labels: LabelSet
    earlier: InstanceMesh | None = None
    first_frame: int = 0

    def __post_init__(self) -> None:
        check_fields(self, "instance mesh", DataError)


@dataclass(frozen=True)
class OrientedBox:
    """A box in the world: ``centre`` and ``sizes`` (3,) in m, ``rotation`` (3, 3) from its axes to the world's."""

    centre: Float64Array
    sizes: Float64Array
    rotation: Float64Array

    @property
    def corners(self) -> Float64Array:
        """The corners (8, 3); corner k is at the far side of axis i where bit i of k is set."""
        sides = np.array([[k >> axis & 1 for axis in range(3)] for k in range(8)]) - 0.5
        corners: Float64Array = (sides * self.sizes) @ self.rotation.T + self.centre
        return corners

    def distance_outside(self, points: Float64Array) -> Float64Array:
        """The distance (N,) of ``points`` (N, 3) beyond the face planes, the maximum over the axes; 0 inside."""
        along_axes = np.abs((points - self.centre) @ self.rotation)
        distance: Float64Array = np.maximum(along_axes - self.sizes / 2, 0.0).max(axis=1, initial=0.0)
        return distance


@dataclass(frozen=True)
class ObjectBoxes:
    """Objects with known boxes only: ``boxes`` and class ids of ``labels``, both by instance id."""

    boxes: Mapping[int, OrientedBox]
    class_of_instance: Mapping[int, int]
    labels: LabelSet

    def instance_at(self, points: Float64Array, slack_m: float) -> Int32Array:
        """For each of ``points`` (N, 3) the instance (N,) of the smallest box, grown by ``slack_m`` on every side,
        that contains it; 0 for none."""
        found = np.zeros(len(points), np.int32)
        left = np.arange(len(points))
        by_size = sorted(self.boxes.items(), key=lambda pair: (float(np.prod(pair[1].sizes + 2 * slack_m)), pair[0]))
        for instance, box in by_size:
            is_inside = box.distance_outside(points[left]) <= slack_m
            found[left[is_inside]] = instance
            left = left[~is_inside]
        return found


@dataclass(frozen=True)
class Detections:
    """The detections of one frame: K regions in any order.

    ``masks`` (K, H, W) bool, may overlap; ``boxes`` (K, 4) float32 x0 y0 x1 y1 in pixels, right and bottom exclusive,
    but a detector's may reach beyond the image, and those of SAM's automatic masks end at the last pixel;
    ``scores`` (K,) float32 in 0..1; ``names`` and ``captions``: one text per region;
    ``crop_features`` (K, R, D) float32, L2-normalised, crop r at ``crop_ratios[r]``;
    ``global_feature`` (D,) float32, of the whole image; ``name_features`` (K, D) float32, text features of the names,
    if the method asks for them. ``score_scale``: ``published`` if published thresholds apply to the scores (SAM's
    predicted IoU, a detector's confidence), ``own`` if they only rank regions. ``rows`` (K,): the row of each region in
    the file, or among all regions of the image, if some were excluded.

    >>> import numpy as np, su3d_bench as su3d
    >>> masks, boxes = np.ones((1, 24, 32), bool), np.array([[0, 0, 32, 24]], np.float32)
    >>> crops, whole = np.ones((1, 1, 4), np.float32), np.ones(4, np.float32)
    >>> one = su3d.Detections(0, masks, boxes, np.ones(1, np.float32), ("wall",), ("",), (1.0,), crops, whole)
    >>> len(one), one.names
    (1, ('wall',))
    """

    frame_index: int
    masks: BoolArray
    boxes: Float32Array
    scores: Float32Array
    names: tuple[str, ...]
    captions: tuple[str, ...]
    crop_ratios: tuple[float, ...]
    crop_features: Float32Array
    global_feature: Float32Array
    name_features: Float32Array | None = None
    score_scale: Literal["published", "own"] = "published"
    rows: Int64Array | None = None

    def __post_init__(self) -> None:
        check_fields(self, f"frame {self.frame_index}", DataError)
        n = len(self.names)
        shapes = (len(self.masks), len(self.boxes), len(self.scores), len(self.captions), len(self.crop_features))
        if self.rows is not None and len(self.rows) != n:
            raise DataError(f"frame {self.frame_index}: {len(self.rows)} rows for {n} names")
        if self.masks.ndim != 3 or any(length != n for length in shapes):
            raise DataError(
                f"frame {self.frame_index}: {n} names, but masks, boxes, scores, captions, features {shapes}"
            )
        if self.crop_features.shape[:2] != (n, len(self.crop_ratios)):
            raise DataError(
                f"frame {self.frame_index}: crop features {self.crop_features.shape} for {n} regions and "
                f"{len(self.crop_ratios)} ratios"
            )
        if self.name_features is not None and len(self.name_features) != n:
            raise DataError(f"frame {self.frame_index}: {len(self.name_features)} name features for {n} names")

    def __len__(self) -> int:
        return len(self.names)

    def row_of(self, k: int) -> int:
        """The row of region ``k`` in the file or image that it came from."""
        return k if self.rows is None else int(self.rows[k])

    def check_of(self, frame: Frame) -> None:
        """Raise ``DataError`` if these are the detections of another frame, or the masks have another size."""
        if self.frame_index != frame.index:
            raise DataError(f"frame {frame.index}: the detections are those of frame {self.frame_index}")
        if len(self) and self.masks.shape[1:] != frame.depth_m.shape:
            size = _size(self.masks[0])
            raise DataError(f"frame {frame.index}: masks are {size} and the image is {_size(frame.depth_m)}")


@dataclass(frozen=True)
class PerceptionNeeds:
    """What a method asks of perception.

    ``masks``: ``grounded`` (named objects), ``class-agnostic`` (every region) or ``none``; regions whose name is in
    ``background_names`` (or, with ``background_by_head``, whose head noun is: "brick walls" are a wall) or whose box
    covers more than ``max_box_fraction`` of the image are excluded before any feature is computed. A crop is the
    region's box grown by ``crop_padding_px`` on every side, then scaled by a ratio about its centre, then clipped.
    ``name_features``: also the names' text features. ``true_proposals``: masks in 3D made from the ground truth; every
    number of the method is then a ground-truth ceiling. ``automatic`` and ``grounding`` name the settings with which
    the method's original code makes class-agnostic and grounded masks, for profiles that have its models; other
    profiles ignore them.

    >>> import su3d_bench as su3d
    >>> su3d.PerceptionNeeds(masks="class-agnostic", crop_ratios=(1.0, 1.5)).frames
    True
    """

    masks: MaskKind = "grounded"
    crop_ratios: tuple[float, ...] = (1.0,)
    crop_padding_px: int = 0
    background_names: tuple[str, ...] = ()
    background_by_head: bool = False
    max_box_fraction: float = 1.0
    name_features: bool = False
    true_proposals: bool = False
    frames: bool = True
    automatic: str = "sam"
    grounding: str = "paper"

    def __post_init__(self) -> None:
        check_fields(self, "perception needs", DataError)


@dataclass(frozen=True)
class Surface:
    """The scan's mesh without labels: ``vertices`` (V, 3) float32 m, ``triangles`` (T, 3) int32.

    ``segments`` (V,) int32: the segment of each vertex if the dataset publishes an over-segmentation.
    """

    vertices: Float32Array
    triangles: Int32Array
    segments: Int32Array | None = None

    def __post_init__(self) -> None:
        check_fields(self, "surface", DataError)


@dataclass(frozen=True)
class Regions:
    """A segmenter's output: masks, boxes and scores as in ``Detections``; names if the segmenter provides them.

    ``rows`` (K,): their rows in a file, if some of its rows are not regions.
    """

    masks: BoolArray
    boxes: Float32Array
    scores: Float32Array
    names: tuple[str, ...] | None = None
    captions: tuple[str, ...] | None = None
    rows: Int64Array | None = None
