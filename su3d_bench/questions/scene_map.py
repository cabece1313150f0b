"""A map without points and features, as used for reasoning, the objects that a noun refers to, and a ground-truth map.

A noun refers to objects by name, by synonyms, or by adjectives of the caption; the nearest name by a text encoder is
the last resort, and is noted in the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from su3d_bench.core.english import last_word, words
from su3d_bench.core.errors import PredictionError, nearest, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array, WholeObject
from su3d_bench.metrics.questions.score import RefinedNames, labels_n
from su3d_bench.numerics import relations as geometry
from su3d_bench.numerics.relations import RELATIONS, SURFACES, Relation, Relations
from su3d_bench.perception.embedded.lexicon import GROUPS, KIND_OF, SYNONYMS, vocabulary
from su3d_bench.questions.appearance import WITHOUT_COLOUR, Appearance, Sight, appearance_of, instance_rows
from su3d_bench.questions.model import word_table

MAX_NAME, MAX_CAPTION = 80, 400  # characters; a hostile map may have texts of any length


@dataclass(frozen=True, eq=False)
class MapObject:
    """One instance; ``centroid`` (3,) and ``box`` (2, 3), lowest and highest corner, in metres, z up.

    For ground truth: ``is_query_target``, whether it is visible enough for questions; ``is_whole``, whether its box is
    that of the complete object and not only of its recorded part; ``is_cut``, whether it ends at the border of the
    images; ``looks``, only for a recording.
    """

    id: int
    name: str
    caption: str
    centroid: Float64Array
    box: Float64Array
    row: int = -1
    is_query_target: bool = True
    is_whole: bool = True
    is_cut: bool = False
    looks: Appearance | None = None

    @property
    def shown(self) -> str:
        """Name and id as answers write them."""
        return f"{self.name or 'object'} #{self.id}"

    @property
    def size(self) -> Float64Array:
        sides: Float64Array = self.box[1] - self.box[0]
        return sides


def is_room_surface(name: str) -> bool:
    """Whether an object with this name is a part of the room itself."""
    return last_word(name) in SURFACES


@dataclass(frozen=True)
class SceneMap:
    """M' of the paper: the map without points and feature vectors; ``row`` of an object is its row in the map."""

    objects: tuple[MapObject, ...]

    def __len__(self) -> int:
        return len(self.objects)

    def by_id(self, object_id: int) -> MapObject:
        return self.objects[self._row_of[object_id]]

    @cached_property
    def relations(self) -> Relations:
        """The spatial relations between the objects, by their rows here."""
        boxes = np.array([thing.box for thing in self.objects], np.float64).reshape(-1, 2, 3)
        return Relations(boxes, [last_word(thing.name) for thing in self.objects])

    @cached_property
    def _row_of(self) -> dict[int, int]:
        return {thing.id: row for row, thing in enumerate(self.objects)}

    def holds(self, relation: Relation, subject: MapObject, other: MapObject) -> bool:
        """Whether one object of the map is in ``relation`` to another."""
        return bool(self.relations.of(relation)[self._row_of[subject.id], self._row_of[other.id]])

    def is_doubtful(self, relation: Relation, subject: MapObject, other: MapObject) -> bool:
        """Whether a slightly different threshold, another reading or a completely seen object might change it."""
        return bool(self.doubtful[relation][self._row_of[subject.id], self._row_of[other.id]])

    @cached_property
    def doubtful(self) -> dict[Relation, BoolArray]:
        """The doubtful pairs (K, K) of each relation by their rows here."""
        is_cut = np.array([thing.is_cut for thing in self.objects], bool)
        beside_cut = (is_cut[:, None] | is_cut[None]) & self.relations.near
        return {relation: self.relations.doubtful(relation) | beside_cut for relation in RELATIONS}

    def is_between(self, thing: MapObject, first: MapObject, second: MapObject) -> bool:
        """Whether an object is between two others; objects on or in one of them, or under it, are not."""
        return geometry.is_between(thing.box, first.box, second.box) and not self.is_of(thing, first, second)

    def may_be_between(self, thing: MapObject, first: MapObject, second: MapObject) -> bool:
        """Whether an object could be called between two others."""
        return geometry.may_be_between(thing.box, first.box, second.box) and not self.is_of(thing, first, second)

    def is_of(self, thing: MapObject, *ends: MapObject) -> bool:
        """Whether an object is one of ``ends``, or on or in one, or the reverse."""
        pairs = [pair for end in ends for pair in ((thing, end), (end, thing))]
        return thing in ends or any(self.holds("on", *pair) or self.holds("in", *pair) for pair in pairs)

    def is_fact(self, relation: Relation, subject: MapObject, other: MapObject) -> bool:
        """Whether the relation holds, is natural, and does not repeat another one ("under" for "on")."""
        return bool(self.relations.facts(relation)[self._row_of[subject.id], self._row_of[other.id]])

    def is_located_by(self, name: str, other: str) -> bool:
        """Whether a ``name`` is said to be next to an ``other``, which is the larger of the two, and not the reverse.

        Source: Talmy 1983, How language structures space: a reference object is larger and easier to see.
        """
        faces = [(self.objects[row].name, face) for row, face in enumerate(self.relations.faces.tolist())]
        own, others = (max(face for called, face in faces if called == one) for one in (name, other))
        return (own, name) < (others, other)

    def are_in_one_place(self, *things: MapObject) -> bool:
        """Whether objects are on one support, all on the floor, or all hang."""
        rows = [self._row_of[thing.id] for thing in things]
        return all(self.relations.one_place[a, b] for a in rows for b in rows if a != b)

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(thing.id for thing in self.objects)

    @property
    def middle(self) -> Float64Array:
        """The centre of the box around all objects."""
        if not self.objects:
            return np.zeros(3)
        low = np.min([thing.box[0] for thing in self.objects], axis=0)
        high = np.max([thing.box[1] for thing in self.objects], axis=0)
        centre: Float64Array = (low + high) / 2
        return centre


def map_of(instances: Instances, refined: RefinedNames | None = None) -> SceneMap:
    """The map of ``instances``; names are n' if ``refined`` has them, otherwise the method's own label, otherwise n.

    Instances excluded by the filter of labels n', or without a finite box, are excluded; without ids, instances are
    numbered from 0.
    """
    k = len(instances)
    names = labels_n(instances) if refined is None else refined.names
    ids = instances.ids if len(instances.ids) else np.arange(k)
    boxes, centroids = instances.boxes.astype(np.float64), instances.centroids.astype(np.float64)
    if boxes.shape != (k, 2, 3) or centroids.shape != (k, 3) or len(ids) != k:
        raise PredictionError(f"this map has boxes {boxes.shape} and centroids {centroids.shape} for {k} instances")
    if len(set(ids.tolist())) != k:
        raise PredictionError("the map has duplicate instance ids")
    is_sound = np.isfinite(boxes).all(axis=(1, 2)) & np.isfinite(centroids).all(axis=1)
    is_sound &= True if refined is None else refined.is_kept
    return SceneMap(
        tuple(
            MapObject(
                int(ids[row]),
                printable(names[row], MAX_NAME),
                printable(instances.captions[row], MAX_CAPTION),
                centroids[row],
                boxes[row],
                int(row),
            )
            for row in np.flatnonzero(is_sound)
        )
    )


Words = tuple[str, ...]
# A name and its cosine similarity by the encoder.
NearestName = Callable[[str, Sequence[str]], tuple[str, float]]

ANYTHING = frozenset({"object", "thing", "item", "anything", "something", "everything", "one"})
GATHERED = frozenset({"row", "pile", "stack", "heap"})  # of objects of one name
MAX_ADJECTIVES = 3
# Ours: with the embedded encoder, synonyms reach 0.84 ("carpeting") to 0.93 ("armchair"), words for other objects at
# most 0.72 ("wastebasket" for a basket).
MIN_SIMILARITY = 0.8
COLOUR_SPELLINGS = {"gray": "grey", "wood": "wooden"}


@dataclass(frozen=True)
class NounMatch:
    """The objects that a noun refers to, in the map's order, and notes on how they were found."""

    objects: tuple[MapObject, ...]
    notes: tuple[str, ...] = ()


@cache
def _class_of_words() -> dict[Words, str]:
    """Known name -> class."""
    class_of = {words(name): name for name in vocabulary()}
    for name, others in SYNONYMS.items():
        for other in (name, *others):
            class_of.setdefault(words(other), name)
    return class_of


def noun_objects(noun: str, scene: SceneMap, nearest: NearestName | None = None) -> NounMatch:
    """The objects that ``noun`` refers to; it must not contain relation words."""
    noun_words = words(noun)
    if not noun_words:
        return NounMatch(())
    if len(noun_words) == 1 and noun_words[0] in ANYTHING:
        return NounMatch(tuple(thing for thing in scene.objects if not is_room_surface(thing.name)))
    for n_adjectives in range(min(MAX_ADJECTIVES, len(noun_words) - 1) + 1):
        adjectives, rest = noun_words[:n_adjectives], noun_words[n_adjectives:]
        named = _named(rest, scene.objects)
        described = tuple(thing for thing in named if _has(thing, adjectives))
        if described:
            return NounMatch(described)
    if noun_words[0] in GATHERED and noun_words[1:2] == ("of",):
        # a map may have the single objects, or one object for all
        return noun_objects(" ".join(noun_words[2:]), scene, nearest)
    if noun_words in _class_of_words():
        return NounMatch(())  # a known word for an object that is not in the map
    return _by_encoder(noun, scene, nearest)


def name_suggestion(noun: str, scene: SceneMap) -> str:
    """A clause ``; did you mean 'x'?`` for an unknown noun with a spelling similar to an object of the map."""
    noun_words = words(noun)
    if not noun_words or {noun_words, noun_words[-1:]} & (_class_of_words().keys() | groups().keys()):
        return ""
    names = {thing.name for thing in scene.objects if thing.name}
    own = {_class_of_words().get(words(name)) for name in names}
    names |= {other for name in own if name is not None for other in SYNONYMS.get(name, ())}
    return nearest(noun, sorted(names)) or nearest(noun_words[-1], sorted(names))


@cache
def groups() -> dict[Words, tuple[str, ...]]:
    """Words for several classes -> the classes."""
    return {words(name): classes for name, classes in GROUPS.items()}


def _named(noun_words: Words, objects: Iterable[MapObject]) -> list[MapObject]:
    group = groups().get(noun_words)
    class_of = _class_of_words()
    if group is not None:
        return [
            thing for thing in objects if class_of.get(words(thing.name)) in group or words(thing.name) == noun_words
        ]
    kind = class_of.get(noun_words)
    return [thing for thing in objects if _means(words(thing.name), noun_words, kind)]


def _means(name: Words, noun_words: Words, kind: str | None) -> bool:
    """Whether ``noun_words`` (of class ``kind``) refers to an object named ``name``: a coffee table is a table."""
    if name == noun_words:
        return True
    own = _class_of_words().get(name)
    if own is not None:
        # A name with its own class: a paper towel is not a towel, but a coffee table is a table.
        return kind is not None and kind in (own, KIND_OF.get(own))
    is_kind_of = len(name) > len(noun_words) and name[len(name) - len(noun_words) :] == noun_words
    return is_kind_of or (kind is not None and _class_of_words().get(name[-1:]) == kind)


def _has(thing: MapObject, adjectives: Words) -> bool:
    known = {*words(thing.name), *words(thing.caption)}
    return all(COLOUR_SPELLINGS.get(word, word) in known or word in known for word in adjectives)


def _by_encoder(noun: str, scene: SceneMap, nearest: NearestName | None) -> NounMatch:
    names = sorted({thing.name for thing in scene.objects if thing.name and not is_room_surface(thing.name)})
    if nearest is None or not names:
        return NounMatch(())
    name, similarity = nearest(noun, names)
    if similarity < MIN_SIMILARITY:
        return NounMatch(())
    things = tuple(thing for thing in scene.objects if thing.name == name)
    note = f"the map has no '{noun}'; used '{name}', the nearest name by the text encoder (cosine {similarity:.2f})"
    return NounMatch(things, (note,))


def nearest_by(encoder: Encoder) -> NearestName:
    """The nearest name by the text features of ``encoder``."""

    def nearest(noun: str, names: Sequence[str]) -> tuple[str, float]:
        features = encoder.encode_texts([noun, *names]).astype(np.float64)
        similarity = np.einsum("nd,d->n", features[1:], features[0])
        best = int(np.argmax(similarity))
        return names[best], float(similarity[best])

    return nearest


STRAY_PERCENT = 1.0  # ours: share of an object's vertices at either end of an axis, in a scan often a neighbour's


def known_objects(
    truth: GroundTruth,
    min_vertices: int,
    whole: Sequence[WholeObject] | None = None,
    seen: Mapping[int, Sight] | None = None,
) -> SceneMap:
    """The objects of a scene without the room's own surfaces, by ascending id.

    Ground-truth instances with at least ``min_vertices`` vertices, with the class of most of their vertices. ``whole``
    has all objects of the scene in full. If ``seen`` has what frames show, colours are in the captions, and objects
    that are not clearly visible must not be asked about; nor must a cabinet if there are base cabinets too.
    """
    rows_of = dict(instance_rows(truth, min_vertices))
    objects = [_of_vertices(truth, instance, rows) for instance, rows in rows_of.items()] if whole is None else whole
    names = {known.name for known in objects if known is not None}
    things = []
    for known in objects:
        if known is None or is_room_surface(known.name):
            continue
        sight = None if seen is None else seen.get(known.id)
        is_query_target = known.id in rows_of and (seen is None or (sight is not None and sight.is_plain))
        is_query_target &= known.name not in word_table("unclear")["names"] and not any(
            name.endswith(f" {known.name}") for name in names
        )
        is_cut = whole is None and sight is not None and sight.is_cut
        looks = None
        if whole is None and seen is not None:
            looks = appearance_of(known.name, _without_strays(truth, rows_of[known.id]), sight, is_cut=is_cut)
        things.append(
            MapObject(
                known.id,
                known.name,
                " ".join((*_colour(known, sight), *known.adjectives)),
                known.box.mean(axis=0),
                known.box,
                is_query_target=is_query_target,
                is_whole=whole is not None,
                is_cut=is_cut,
                looks=looks,
            )
        )
    return SceneMap(tuple(things))


def _colour(known: WholeObject, sight: Sight | None) -> tuple[str, ...]:
    """The colour that frames show, if it is the object's true colour, or if that is unknown and it is certain."""
    if sight is None or not sight.colour or last_word(known.name) in WITHOUT_COLOUR:
        return ()
    return (sight.colour,) if known.colour == sight.colour or (not known.colour and sight.is_certain_colour) else ()


def _of_vertices(truth: GroundTruth, instance: int, rows: Int64Array) -> WholeObject | None:
    class_id = int(np.bincount(truth.semantic[rows].clip(min=0)).argmax())
    if class_id == 0:
        return None
    return WholeObject(instance, plain_name(truth.labels.name_of(class_id)), _box_of(truth, rows))


def _box_of(truth: GroundTruth, rows: Int64Array) -> Float64Array:
    box: Float64Array = np.percentile(
        truth.points[rows].astype(np.float64), [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0
    )
    return box


def _without_strays(truth: GroundTruth, rows: Int64Array) -> Float64Array:
    """The points of an object within its robust box."""
    points, (low, high) = truth.points[rows].astype(np.float64), _box_of(truth, rows)
    kept: Float64Array = points[((points >= low) & (points <= high)).all(axis=1)]
    return kept


def plain_name(name: str) -> str:
    """A class name in plain English.

    >>> plain_name("indoor-plant")
    'indoor plant'
    """
    return " ".join(name.replace("-", " ").replace("_", " ").split())


def is_called(label: str, class_name: str) -> bool:
    """Whether a label is correct for an object of a class, by the lexicon's synonyms and by hyponyms.

    A more specific name is correct ("office chair" for a chair), and so is a more general one ("chair" for an office
    chair), but not a word for many classes ("furniture").

    >>> is_called("couch", "sofa"), is_called("paper towel", "towel"), is_called("furniture", "sofa")
    (True, False, False)
    """
    label_words, class_words = words(label), words(class_name)
    if not label_words or not class_words:
        return False
    if label_words == class_words:
        return True
    if " ".join(label_words) in GROUPS:
        return False
    return bool(noun_objects(class_name, _only(label)).objects) or bool(noun_objects(label, _only(class_name)).objects)


def _only(name: str) -> SceneMap:
    nowhere = np.zeros(3)
    return SceneMap((MapObject(1, name, "", nowhere, np.zeros((2, 3))),))
