"""What a corruption is: a function of one input, and five severities in its unit.

A corruption changes one stage and nothing else, so that the cause of a change in score is known:

- ``order``: which frames are fed, in which order;
- ``poses``: the trajectory;
- ``frame``: colour, depth or intrinsics of one frame;
- ``detections``: what perception found in a frame, before the method sees it;
- ``names``: the class names that a map is searched with.

Its random draws depend on the run's seed, the scene, the corruption and the frame, not on the severity: a higher
severity is the same error made larger. A corruption that is ``per_scene`` draws once per scene: all frames share the
generator of frame 0. At severity 0 nothing is called and the input itself is used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Detections, Float64Array, Frame, Int64Array

Stage = Literal["order", "poses", "frame", "detections", "names"]
MAX_SEVERITY = 5


@dataclass(frozen=True)
class Recording:
    """The clean recording around a frame.

    ``frames``: every frame, read at each access; ``poses`` (N, 4, 4): their camera-to-world poses;
    ``index``: which of them is being changed.
    """

    frames: Sequence[Frame]
    poses: Float64Array
    index: int


# Each takes the value of the severity in the corruption's unit, and a generator of its own.
OrderFunction = Callable[[Int64Array, float, Generator], Int64Array]  # places (U,) of the updates' frames
PosesFunction = Callable[[Float64Array, float, Generator], Float64Array]  # (N, 4, 4)
FrameFunction = Callable[[Frame, float, Generator, Recording], Frame]
DetectionsFunction = Callable[[Detections, float, Generator], Detections]
NamesFunction = Callable[[tuple[str, ...], float, Generator], tuple[str, ...]]  # adds names after the given ones


@dataclass(frozen=True)
class Corruption:
    """One row of the table of corruptions.

    ``values``: severities 1 to 5 in ``unit``, getting worse; ``neutral``: the value that changes nothing;
    ``source``: where the values come from, or "ours" with the reason; ``is_whole``: values are whole numbers;
    ``per_scene``: every frame of a scene receives the same random numbers; ``uses_poses``: it needs the recording's
    poses, which are empty for others.
    """

    family: str
    name: str
    stage: Stage
    function: Callable[..., object]
    unit: str
    values: tuple[float, float, float, float, float]
    source: str
    neutral: float = 0.0
    is_whole: bool = False
    per_scene: bool = False
    uses_poses: bool = False

    @property
    def address(self) -> str:
        return f"{self.family}/{self.name}"

    def value_at(self, severity: float) -> float:
        """The value at a severity 0..5, linear between whole severities; the nearest one if values are whole."""
        value = float(np.interp(severity, range(MAX_SEVERITY + 1), (self.neutral, *self.values)))
        return float(round(value)) if self.is_whole else value

    def applied(self, severity: float) -> float:
        """The severity of the value that is used at ``severity``: another one if values are whole."""
        if not self.is_whole:
            return severity
        sign = 1 if self.values[-1] > self.neutral else -1
        known = sign * np.array((self.neutral, *self.values))
        return float(np.interp(sign * self.value_at(severity), known, range(MAX_SEVERITY + 1)))

    def value_within(self, severity: float) -> float:
        """The value at a severity; if values are whole, the last one that is not worse."""
        value = self.value_at(severity)
        if self.applied(severity) <= severity:
            return value
        return value - 1 if self.values[-1] > self.neutral else value + 1


def generator(corruption: Corruption, seed: int, scene: str, index: int = 0) -> Generator:
    """The random numbers of a corruption for one frame of a scene, the same for every severity.

    ``index`` makes no difference if the corruption is ``per_scene``.
    """
    words = "\n".join((str(seed), scene, corruption.address, str(0 if corruption.per_scene else index)))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(words.encode()).digest(), np.uint32))
