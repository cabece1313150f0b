"""What is asked of a map and what the truth answers, for the protocols whose judgement people give otherwise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, GroundTruth, Int64Array


@dataclass(frozen=True)
class AskedText:
    """A text of a kind such as ``property``, and the ids of every object that answers it.

    ``by_chance``: how often an object drawn at random answers; ``by_name``: one drawn from those of the right name.
    """

    kind: str
    text: str
    answers: tuple[int, ...]
    by_chance: float = float("nan")
    by_name: float = float("nan")


@dataclass(frozen=True)
class RetrievalTruth:
    """The objects of a scene and the texts that ask for them."""

    scene: GroundTruth
    asked: tuple[AskedText, ...]


@dataclass(frozen=True)
class AskedThing:
    """What a map is asked for that the scene has or has not; ``sampling``: the way by which absent things are drawn."""

    text: str
    sampling: str
    is_there: bool


@dataclass(frozen=True)
class PresenceTruth:
    """The objects of a scene and things that it has or has not; ``source`` says over what it is counted which things
    are frequent, and which stand together."""

    scene: GroundTruth
    asked: tuple[AskedThing, ...]
    source: str


@dataclass(frozen=True)
class RefinedNames:
    """Labels n' of a map, one an instance, and who chose them.

    ``left_out``: why the filter that goes with these labels leaves an instance out, '' where it stays; empty: all stay.
    """

    names: tuple[str, ...]
    source: str
    left_out: tuple[str, ...] = ()

    @property
    def is_kept(self) -> BoolArray:
        """Whether (K,) an instance is one of the map under labels n'."""
        return np.array([not reason for reason in self.left_out or ("",) * len(self.names)], bool)


@dataclass(frozen=True)
class AnnotationTruth:
    """The objects of a scene and how they may be called.

    ``object_ids``: those that are judged; ``is_called`` tells whether a label names the object of an id; ``refined``
    gives labels n' of a map, None where it has none.
    """

    scene: GroundTruth
    object_ids: tuple[int, ...]
    is_called: Callable[[str, int], bool]
    refined: Callable[[Instances], RefinedNames | None]


@dataclass(frozen=True)
class TrueAnswer:
    """``value``: a count, metres or yes and no; None where the objects are the answer. ``object_ids`` are named.

    ``by_chance``: how often a guess is right; ``by_name``: that of who knows what each object is called and no more.
    """

    text: str
    kind: str
    value: float | int | bool | None
    object_ids: tuple[int, ...]
    by_chance: float = float("nan")
    by_name: float = float("nan")


@dataclass(frozen=True)
class GivenAnswer:
    """What a solver said of a map: ``rows`` are the instances that it names; nothing where it ``is_settled`` not."""

    value: float | int | bool | None
    rows: Int64Array
    is_settled: bool


@dataclass(frozen=True)
class ReasoningTruth:
    """Questions with true answers, and how a map is asked; ``solver`` names who answers."""

    scene: GroundTruth
    asked: tuple[TrueAnswer, ...]
    solve: Callable[[Instances, Encoder | None], Sequence[GivenAnswer]]
    solver: str
