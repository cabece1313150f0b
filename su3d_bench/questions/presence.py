"""Things that a scene has and things that it has not, which is what POPE asks: the absent ones drawn at random, the
most frequent ones, and those that stand most often with something that is there.

Source: utils.py of POPE (RUCAIBox/POPE at 3df3ba1), whose three ways 3D-POPE of 3D-GRAND takes to scans. A negative
follows each thing that is there, so that saying yes to everything is right half of the time. POPE counts what is
frequent and what stands together over its images; here it is counted over the built-in rooms (``rooms.toml``), so that
what a scene is asked does not depend on which other scenes are at hand.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.questions.presence import SAMPLINGS
from su3d_bench.metrics.questions.score import AskedThing
from su3d_bench.questions.scene_map import SceneMap, is_called, is_room_surface, plain_name

RANDOM, POPULAR, ADVERSARIAL = SAMPLINGS
# Labels of what nobody sorted: no thing to ask for.
_NO_NAMES = frozenset((
    "object", "objects", "other", "undefined", "background", "unannotated", "void",
    "unknown", "unknown/remove", "partial",  # HM3DSem's
))  # fmt: skip
Rooms = Sequence[Sequence[str]]


def presence_questions(
    scene: str, truth: GroundTruth, objects: SceneMap, n_things: int, rooms: Rooms
) -> tuple[AskedThing, ...]:
    """At most ``n_things`` things that a scene has, each with one that it has not, under every sampling.

    Asked for is what a frame shows plainly; absent is what is called like nothing that is there, seen or not. ``rooms``
    list what stands in each of some rooms.
    """
    seen = {thing.name for thing in objects.objects if thing.is_asked}
    there = _by_digest(scene, (name for name in seen if _is_name(name)))[:n_things]
    absent = absent_names(truth, objects)
    answer = []
    for sampling in SAMPLINGS:
        for name, other in drawn(scene, sampling, there, absent, rooms):
            answer.append(AskedThing(name, sampling, is_there=True))
            if other is not None:
                answer.append(AskedThing(other, sampling, is_there=False))
    return tuple(answer)


def absent_names(truth: GroundTruth, objects: SceneMap) -> tuple[str, ...]:
    """The classes of the truth's label set that no object of the scene, however small, may be called."""
    ids = np.unique(truth.semantic)
    there = {plain_name(truth.labels.name_of(int(class_id))) for class_id in ids[ids > 0]}
    there |= {thing.name for thing in objects.objects}
    names = dict.fromkeys(plain_name(name) for name in truth.labels.names)
    return tuple(name for name in names if _is_name(name) and not any(_may_be(name, known) for known in there))


def _is_name(name: str) -> bool:
    return bool(name) and name not in _NO_NAMES and not name.startswith("other ") and not is_room_surface(name)


@lru_cache(maxsize=65_536)
def _may_be(one: str, other: str) -> bool:
    return is_called(one, other) or is_called(other, one)


def drawn(
    scene: str, sampling: str, there: Sequence[str], absent: Sequence[str], rooms: Rooms
) -> Iterator[tuple[str, str | None]]:
    """Each thing that is ``there`` with the next ``absent`` one, none twice; None where there is none left.

    At random: by a digest of scene and name. Popular: the next in falling number of rooms that have it. Adversarial:
    the next in falling number of rooms that have both. Equal numbers in the order of first appearance, as POPE has it;
    where nothing is left of these, at random.

    >>> rooms = [["bed", "lamp", "pillow"], ["bed", "pillow"], ["sink", "lamp"], ["lamp"]]
    >>> [list(drawn("a/b", way, ["bed"], ["pillow", "lamp", "sink"], rooms)) for way in ("popular", "adversarial")]
    [[('bed', 'lamp')], [('bed', 'pillow')]]
    """
    left = dict.fromkeys(_by_digest(scene, absent))
    listed = _names_of(rooms)
    listed_as = {} if sampling == RANDOM else {name: _listed(name, listed) for name in (*there, *absent)}
    often = _often(rooms) if sampling == POPULAR else []
    for name in there:
        order = _often_with(listed_as[name], rooms) if sampling == ADVERSARIAL else often
        ranked = (known for one in order for known in absent if known in left and listed_as[known] == one)
        chosen = next(ranked, None) or next(iter(left), None)
        if chosen is not None:
            del left[chosen]
        yield name, chosen


def _by_digest(scene: str, names: Iterable[str]) -> list[str]:
    return sorted(names, key=lambda name: hashlib.sha256(f"{scene}\0{name}".encode()).digest())


def _names_of(rooms: Rooms) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for room in rooms for name in room))


def _listed(name: str, listed: Sequence[str]) -> str | None:
    """What rooms have a thing under: its own name, or else the first that means the same."""
    return name if name in listed else next((one for one in listed if _may_be(name, one)), None)


def _often(rooms: Rooms) -> list[str]:
    """What stands in rooms, in falling number of these."""
    return [name for name, _ in Counter(name for room in rooms for name in room).most_common()]


def _often_with(name: str | None, rooms: Rooms) -> list[str]:
    """What stands in rooms that have ``name``, in falling number of these."""
    return [] if name is None else [one for one in _often([room for room in rooms if name in room]) if one != name]


@cache
def counted_rooms() -> tuple[tuple[str, ...], ...]:
    """What stands in each of the built-in rooms over which it is counted, by the names of classes."""
    table = parse_toml(file_text(Path(__file__).with_name("rooms.toml")))
    return tuple(tuple(names) for names in table["rooms"].values())
