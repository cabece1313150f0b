"""Apply corruptions to the inputs of one scene: its frames, its detections and the class names.

A corrupted method is written ``METHOD~FAMILY/NAME/SEVERITY``, with ``+`` between two corruptions:
``opensu3d~depth/holes/4+pose/jitter-rotation/2``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.registry import MARK
from su3d_bench.core.types import BoolArray, Detections, Float32Array, Float64Array, Frame, Int64Array, PerceptionNeeds
from su3d_bench.corruptions import calibration, depth, image, light, masks, names, poses, time
from su3d_bench.corruptions.model import MAX_SEVERITY, Corruption, Recording, Stage, generator

# A new corruption is a function and a row in the file of its family.
FAMILIES = (calibration, depth, poses, time, light, image, masks, names)
CORRUPTIONS: dict[str, Corruption] = {row.address: row for family in FAMILIES for row in family.ROWS}


@dataclass(frozen=True)
class Condition:
    """A corruption at a severity in 0..5, whole or between two whole ones."""

    corruption: Corruption
    severity: float

    @property
    def value(self) -> float:
        return self.corruption.value_at(self.severity)

    @property
    def address(self) -> str:
        return f"{self.corruption.address}/{self.severity:g}"


def parse_conditions(text: str) -> tuple[Condition, ...]:
    """The conditions of ``depth/holes/4`` or ``depth/holes/4+pose/drift/2``; raises ``ConfigError``."""
    conditions = tuple(_condition(part) for part in text.split("+")) if text else ()
    names = [condition.corruption.address for condition in conditions]
    if len(set(names)) < len(names) or len(names) > 2:
        raise ConfigError(f"corruption '{text}': expected one corruption, or two different ones joined by '+'")
    return conditions


def _condition(text: str) -> Condition:
    address, severity = (text, "") if text in CORRUPTIONS else text.rpartition("/")[::2]
    if address not in CORRUPTIONS:
        raise ConfigError(f"unknown corruption '{address or text}'{suggest(address or text, CORRUPTIONS)}")
    if not re.fullmatch(r"\d(\.\d{1,6})?", severity) or float(severity) > MAX_SEVERITY:
        raise ConfigError(f"corruption '{text}': expected {address}/SEVERITY with a severity from 0 to {MAX_SEVERITY}")
    return Condition(CORRUPTIONS[address], float(severity))


@dataclass(frozen=True)
class Cell:
    """A ``method`` under ``conditions``, none if clean."""

    method: str
    conditions: tuple[Condition, ...]

    @property
    def suffix(self) -> str:
        """What follows the method where it is requested."""
        return f"{MARK}{'+'.join(one.address for one in self.conditions)}" if self.conditions else ""

    @property
    def name(self) -> str:
        """Its name in a run, if ``method`` is the method's."""
        return self.method + self.suffix.replace("/", "-")

    @property
    def corruption(self) -> str:
        """The corruptions, without severities."""
        return "+".join(one.corruption.address for one in self.conditions)

    @property
    def family(self) -> str:
        return "+".join(one.corruption.family for one in self.conditions)


def cell_of(name: str) -> Cell | None:
    """The cell with that name in a run; None if the name has no corruption."""
    method, _, text = name.rpartition(MARK)
    known = {address.replace("/", "-"): address for address in CORRUPTIONS}
    parts = [part.rpartition("-") for part in text.split("+")]
    if not method or any(address not in known for address, _, _ in parts):
        return None
    with suppress(ConfigError):  # no severity, as in a method of that name from elsewhere
        cell = Cell(method, parse_conditions("+".join(f"{known[part]}/{severity}" for part, _, severity in parts)))
        return cell if cell.name == name else None
    return None


@dataclass(frozen=True)
class SceneCorruption:
    """The ``conditions`` of one scene, whose clean ``frames`` are read at each access.

    ``read_poses`` returns their poses (N, 4, 4); it is called only if needed, because it may read every frame.
    ``clean_cameras``: pose and intrinsics of the frames so far, before they were changed.
    """

    conditions: tuple[Condition, ...]
    scene: str
    seed: int
    frames: Sequence[Frame]
    read_poses: Callable[[], Float64Array]
    clean_cameras: dict[int, tuple[Float64Array, Float64Array]] = field(default_factory=dict)

    @cached_property
    def poses(self) -> Float64Array:
        """The poses that the method gets."""
        poses = self.read_poses()
        for condition in self.at("poses"):
            poses = self.call(condition, 0, poses)
        return poses

    def at(self, stage: Stage) -> list[Condition]:
        """The conditions of a stage that change something."""
        return [one for one in self.conditions if one.corruption.stage == stage and one.severity > 0]

    def call(self, condition: Condition, index: int, value: Any, *more: Any) -> Any:
        """What a corruption makes of ``value``; its random numbers are those of frame ``index``."""
        corruption = condition.corruption
        rng = generator(corruption, self.seed, self.scene, index)
        return corruption.function(value, condition.value, rng, *more)

    def frame(self, frame: Frame) -> Frame:
        """The frame as the method gets it."""
        self.clean_cameras[frame.index] = frame.camera_to_world, frame.intrinsics
        for condition in self.at("frame"):
            poses = self.read_poses() if condition.corruption.uses_poses else np.zeros((0, 4, 4))
            frame = self.call(condition, frame.index, frame, Recording(self.frames, poses, frame.index))
        if self.at("poses"):
            frame = replace(frame, camera_to_world=self.poses[frame.index])
        return frame

    def order(self, n: int) -> Int64Array:
        """Which of ``n`` frames are fed, in order."""
        places = np.arange(n)
        for condition in self.at("order"):
            places = self.call(condition, 0, places)
        return places

    def names(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The names to search for, and after these the distractors."""
        for condition in self.at("names"):
            names = self.call(condition, 0, names)
        return names


class CorruptedFrames(Sequence[Frame]):
    """``frames`` in the order and form in which the method gets them."""

    def __init__(self, frames: Sequence[Frame], corruption: SceneCorruption) -> None:
        self._frames, self._corruption = frames, corruption
        self._places = corruption.order(len(frames))

    @property
    def clean(self) -> Iterator[Frame]:
        """The frames in this order as they were before."""
        return (self._frames[int(place)] for place in self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        return self._corruption.frame(self._frames[int(self._places[index])])


class CorruptedPerception:
    """Perception of corrupted frames at their true poses, whose detections are then corrupted.

    Perfect masks are those of the true camera.
    """

    def __init__(self, perception: Any, corruption: SceneCorruption) -> None:
        self._perception, self._corruption = perception, corruption

    def __getattr__(self, name: str) -> Any:
        return getattr(self._perception, name)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        """The detections of a frame."""
        found: Detections = self._perception.detect(self._seen(frame), needs, timer)
        for condition in self._corruption.at("detections"):
            found = self._corruption.call(condition, frame.index, found)
        return found

    def regions(self) -> Any:
        """Perception on demand, for methods that choose their own image regions."""
        return CorruptedRegions(self._perception.regions(), self._seen)

    def _seen(self, frame: Frame) -> Frame:
        pose, intrinsics = self._corruption.clean_cameras[frame.index]
        if self._perception.profile != "oracle":
            intrinsics = frame.intrinsics
        return replace(frame, camera_to_world=pose, intrinsics=intrinsics)


class CorruptedRegions:
    """Perception on demand of frames at their true poses.

    The last frame is remembered, because perception recognises a frame that it has seen by identity.
    """

    def __init__(self, inner: Any, seen: Callable[[Frame], Frame]) -> None:
        self.inner = inner
        self._seen = seen
        self._last: tuple[Frame, Frame] | None = None

    def seen(self, frame: Frame) -> Frame:
        """What perception sees of ``frame``."""
        if self._last is None or self._last[0] is not frame:
            self._last = frame, self._seen(frame)
        return self._last[1]

    @property
    def dim(self) -> int:
        return int(self.inner.dim)

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        found: tuple[BoolArray, float] = self.inner.mask_at(self.seen(frame), points)
        return found

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        return np.asarray(self.inner.encode_regions(self.seen(frame), mask, boxes))
