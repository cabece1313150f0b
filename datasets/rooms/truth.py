"""What is true of a room: its objects, how they relate, and questions with all their right answers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.rooms.classes import AFFORDANCES, CLASS_ID
from su3d_bench.datasets.rooms.plan import FLAT, Plan, box_of
from su3d_bench.numerics.boxes import (
    ABOVE_M,
    NEXT_TO_M,
    NEXT_TO_SMALL_M,
    UNDER_SHARE,
    are_side_by_side,
    is_left_of,
    is_over,
    shared_ground,
)

STRUCTURE = frozenset(("wall", "floor", "ceiling"))
OPENINGS = frozenset(("door", "window"))
WALL_REACH_M = 1.0  # what hangs on a wall is above what stands no lower than this under it
MIN_VISIBLE_VERTICES = 100  # ScanNet's smallest instance that counts
MAX_ANSWER_SHARE = 1 / 3


@dataclass(frozen=True)
class RoomObject:
    """One object; ``id`` is its number in instance images, scans and meshes. Boxes are axis-aligned, world metres.

    ``size_word`` compares with the usual size of the class; ``support`` is floor, wall, ceiling, object, or room for
    what the room itself is made of.
    """

    id: int
    class_id: int
    class_name: str
    colour: str
    material: str
    size_m: tuple[float, float, float]
    size_word: str
    centre: tuple[float, float, float]
    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    support: str


@dataclass(frozen=True)
class Relation:
    """``subject`` stands in ``relation`` to ``object``; both are object ids."""

    subject: int
    relation: str
    object: int


@dataclass(frozen=True)
class RoomTruth:
    scene: str
    kind: str
    objects: tuple[RoomObject, ...]
    relations: tuple[Relation, ...]

    def by_id(self, object_id: int) -> RoomObject:
        return self.objects[object_id - 1]

    def left_of(self, eye: tuple[float, float, float] | None = None) -> tuple[Relation, ...]:
        """Which of two neighbours stands left of the other for who looks at both from ``eye`` (the room's middle).

        Apart from ``relations``, for it is the only relation that depends on where one stands.
        """
        if eye is None:
            eye = next(room_object.centre for room_object in self.objects if room_object.class_name == "floor")
        pairs = {(link.subject, link.object) for link in self.relations if link.relation == "next to"}
        return tuple(
            Relation(a, "left of", b)
            for a, b in sorted(pairs)
            if is_left_of(self.by_id(a).centre, self.by_id(b).centre, eye)
        )


@dataclass(frozen=True)
class Query:
    """A text and the ids of every object that answers it; ``kind``: instance, affordance, property, relative."""

    text: str
    kind: str
    answers: tuple[int, ...]


def truth_of(scene: str, kind: str, plan: Plan) -> RoomTruth:
    objects = tuple(_object(plan, placed_id) for placed_id in range(1, len(plan.placed) + 1))
    return RoomTruth(scene, kind, objects, tuple(_relations(plan)))


def _triple(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _object(plan: Plan, placed_id: int) -> RoomObject:
    placed = plan.placed[placed_id - 1]
    box, item = box_of(placed), placed.item
    support = "room" if item.class_name in STRUCTURE | OPENINGS else plan.mount[placed_id]
    return RoomObject(
        placed_id, CLASS_ID[item.class_name], item.class_name, item.colour, item.material, _triple(item.size),
        item.size_word, _triple((box.low + box.high) / 2), _triple(box.low), _triple(box.high), support,
    )  # fmt: skip


def _relations(plan: Plan) -> Iterator[Relation]:
    for subject, (holder, relation) in sorted(plan.parent.items()):
        yield Relation(subject, relation, holder)
    for subject, holder in plan.rests_also_on:
        yield Relation(subject, "on", holder)
    ids = [i for i in range(1, len(plan.placed) + 1) if plan.placed[i - 1].item.class_name not in STRUCTURE]
    for a in ids:
        for b in ids:
            if a != b:
                yield from _between(plan, a, b)


def _between(plan: Plan, a: int, b: int) -> Iterator[Relation]:
    name_a, name_b = plan.placed[a - 1].item.class_name, plan.placed[b - 1].item.class_name
    box_a, box_b = plan.boxes[a].corners, plan.boxes[b].corners
    stands_b = plan.mount[b] == "floor"
    hangs_a = plan.mount[a] in ("wall", "ceiling") and name_a not in OPENINGS
    reach_m = ABOVE_M if plan.mount[a] == "ceiling" else WALL_REACH_M
    if name_a in FLAT and stands_b and name_b not in FLAT and shared_ground(box_a, box_b) > UNDER_SHARE:
        yield Relation(a, "under", b)
    elif hangs_a and stands_b and is_over(box_a, box_b, 0.0, reach_m):
        yield Relation(a, "above", b)
    if _are_neighbours(plan, a, b):
        yield Relation(a, "next to", b)


def _are_neighbours(plan: Plan, a: int, b: int) -> bool:
    names = {plan.placed[a - 1].item.class_name, plan.placed[b - 1].item.class_name}
    if names & FLAT or plan.mount[a] == "ceiling" or plan.mount[b] == "ceiling":
        return False
    if (plan.mount[a] == "object") != (plan.mount[b] == "object"):
        return False
    is_on_a_support = plan.mount[a] == "object"
    if is_on_a_support and plan.parent.get(a) != plan.parent.get(b):
        return False
    within_m = NEXT_TO_SMALL_M if is_on_a_support else NEXT_TO_M
    return are_side_by_side(plan.boxes[a].corners, plan.boxes[b].corners, within_m)


def queries(truth: RoomTruth, n_visible_vertices: Mapping[int, int] | None = None) -> tuple[Query, ...]:
    """Questions of four kinds with every right answer.

    Objects with fewer than 100 visible scan vertices are neither asked for nor answers; a question that more than a
    third of the objects answer is left out, and so are the walls, the floor and the ceiling.
    """
    shown = [
        room_object
        for room_object in truth.objects
        if room_object.class_name not in STRUCTURE
        and (n_visible_vertices is None or n_visible_vertices.get(room_object.id, 0) >= MIN_VISIBLE_VERTICES)
    ]
    answers: dict[tuple[str, str], set[int]] = {}
    for room_object in shown:
        for kind, text in _texts(room_object):
            answers.setdefault((kind, text), set()).add(room_object.id)
    counted = {room_object.id for room_object in shown}
    for link in truth.relations:
        if link.subject in counted and link.object in counted:
            subject, holder = truth.by_id(link.subject).class_name, truth.by_id(link.object).class_name
            text = f"{subject} {link.relation} {_article(holder)}"
            answers.setdefault(("relative", text), set()).add(link.subject)
    limit = max(1, int(len(shown) * MAX_ANSWER_SHARE))
    kept = [Query(text, kind, tuple(sorted(ids))) for (kind, text), ids in answers.items() if len(ids) <= limit]
    return tuple(sorted(kept, key=lambda query: (query.kind, query.text)))


def _article(name: str) -> str:
    return ("an " if name[0] in "aeiou" else "a ") + name


def _texts(room_object: RoomObject) -> Iterator[tuple[str, str]]:
    yield "instance", room_object.class_name
    for phrase in AFFORDANCES[room_object.class_name]:
        yield "affordance", phrase
    yield "property", f"{room_object.colour} {room_object.class_name}"
    yield "property", f"{room_object.material} {room_object.class_name}"
    if room_object.size_word != "medium":
        yield "property", f"{room_object.size_word} {room_object.class_name}"
