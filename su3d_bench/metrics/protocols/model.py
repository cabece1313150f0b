"""Everything that moves a number of an evaluation."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.core.errors import suggest

# Each list stands here alone: what goes by a kind or a metric has keys of this type, and mypy finds a misspelt one.
Kind = Literal[
    "semantic", "top-k", "instance", "panoptic", "boxes", "queries", "categories", "grounding", "object-chains",
    "relations", "objects", "places", "retrieval", "presence", "annotation", "reasoning",
]  # fmt: skip
MetricName = Literal[
    "conceptgraphs", "scannet", "scannetpp", "hovsg", "ovo", "votenet", "query-ap", "opensun3d", "openlex3d-topn",
    "openlex3d-ranking", "panopticapi", "semantic-kitti", "scanrefer", "beacon3d", "referit3d", "replicassg",
    "hovsg-objects", "hovsg-places", "retrieval", "pope", "annotation", "reasoning",
]  # fmt: skip
ValuesOfMetric = Mapping[MetricName, tuple[str, ...]]
BOX_AXES = Literal["truth", "world", "aligned"]
CURVE_FIELDS = ("min_region_size", "thresholds", "confidence")
# The fields that not every kind has.
OWN_FIELDS = (
    "classes", "class_agnostic", "void", "stuff", "unnamed", "labels", "vocabulary", *CURVE_FIELDS, "top_k",
    "questions", "per_kind", "synonyms", "merging", "answers", "box_axes", "presence", "predicates", "relations",
)  # fmt: skip


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ClassEntry(_Strict):
    """A class of the label set: its id in the label space, its name, the group it is averaged in."""

    id: Annotated[int, Field(ge=0)]
    name: str
    group: str | None = None


class TransferRules(_Strict):
    """How a prediction on other points than the truth's reaches the scored points.

    ``candidates``: ``object-points`` (only points that belong to an instance, as ConceptGraphs concatenates its object
    clouds), ``map-points`` (all points of the map; the nearest being background means no instance) or ``each-mask`` (a
    point is in every mask that has a point nearer than the cap). ``neighbours``: above 1 a point takes the class that
    most of so many nearest object points have, or with ``votes`` of ``masks`` that of the object that most of them
    belong to, the first of equals; objects that overlap vote each.
    ``cap_m``: farther neighbours do not count, no cap when absent; a point without a neighbour is predicted as nothing.
    Where ``evaluation_voxel_m`` is above 0, each mask is first reduced to one point a voxel; under kind ``categories``
    the whole cloud is, to the mean of the points. With a single neighbour, and where masks are voted for, predictions
    on the scored points themselves are taken as they are.
    """

    candidates: Literal["object-points", "map-points", "each-mask"]
    neighbours: Annotated[int, Field(ge=1, le=100)] = 1
    votes: Literal["classes", "masks"] = "classes"
    cap_m: Annotated[float, Field(gt=0)] | None = None
    evaluation_voxel_m: Annotated[float, Field(ge=0)] = 0.0


class MergeRules(_Strict):
    """When a mask is faulty: over-merged or under-merged.

    ``over_merged_share``: of the object vertices that it covers, at least this share belongs to other objects than the
    one that it covers most. ``under_merged_share``: of the vertices of that object that all instances which stand for
    it cover, one after another, it covers less than this share; so one thing twice is under-merged too.
    """

    over_merged_share: Annotated[float, Field(gt=0, le=1)]
    under_merged_share: Annotated[float, Field(ge=0, le=1)]


class AnswerRules(_Strict):
    """How far a distance may be off: ``distance_m`` or ``distance_share`` of the true one, whichever is more."""

    distance_m: Annotated[float, Field(ge=0)]
    distance_share: Annotated[float, Field(ge=0)]


class PresenceRules(_Strict):
    """When a text is said to have something in the map, and over which rooms it is counted what stands in rooms.

    The relevancy of an instance to a text is, of all ``canonical`` phrases, the least share that the text has in the
    softmax of its cosine and that of the phrase, both times ``sharpness``; something is there where that of an instance
    is above ``relevancy``. ``counted_over``: the rooms by which absent things are frequent ones, or ones that stand
    with what is there.
    """

    canonical: Annotated[tuple[str, ...], Field(min_length=1)]
    sharpness: Annotated[float, Field(gt=0)]
    relevancy: Annotated[float, Field(gt=0, lt=1)]
    counted_over: Literal["rooms"]


SECTIONS: dict[str, type[BaseModel]] = {
    "transfer": TransferRules, "merging": MergeRules, "answers": AnswerRules, "presence": PresenceRules
}  # fmt: skip


class ProtocolRules(_Strict):
    """One evaluation, complete: the same rules and the same prediction give the same number.

    ``kind``: ``semantic`` (a class a point), ``top-k`` (the likeliest classes of a point, which may have several
    labels), ``instance`` (masks with a class), ``panoptic`` (every point in a segment of a thing or of ``stuff``),
    ``queries`` (masks ranked for each text), ``boxes`` (with a class), ``categories`` (how near a point's label comes
    to those of its object), ``grounding`` (the box of the first mask of each text), ``object-chains`` (one object by
    each of its texts), ``relations`` (objects, predicates and triplets of a scene graph), ``objects`` (matched one to
    one, with the rank of their category), ``places`` (floors and rooms), or what people are asked otherwise:
    ``retrieval`` (the first mask of each text), ``presence`` (is there such a thing at all?), ``annotation`` (names and
    shapes of masks), ``reasoning`` (questions that boxes settle). ``questions`` are those of the ``dataset`` itself or
    ``generated`` from the truth, ``per_kind`` of each kind at most; ``synonyms`` names the table of other names of
    classes. Protocols that are not ``by_default`` run where they are named. ``classes`` is the label set in the order
    of the original; files of predictions number it by ``ids``, or by ``lines``, places in the list from 0
    (``class_numbers``); ``ignore`` names classes that are known but not scored, and for ``categories`` labels whose
    objects are not. ``vocabulary``: the classifier chooses among ``all`` classes, the ``scored`` ones, or those scored
    ones that the ``scene``'s ground truth contains. ``prompt`` has ``{}`` for the class name, which ``prompt_names``
    may replace; of several ``prompts`` the mean feature counts. ``confidence``: ``ones`` for every mask, the
    ``prediction``'s own, or for queries the ``similarity`` of mask and text (cosine), or that stretched to 0..1 over
    the scene's masks for each query. ``top_k``: how many labels of a point, or masks of a query, count; all where
    absent. ``class_agnostic`` drops the labels: the truth's instances are those of the ``scored`` classes (the rest is
    void), all ``annotated`` ones, ``numbered``, where a number alone tells an object, whatever its class, or
    ``everything``, with the points that nobody annotated as one more. ``void``: masks on it are ``false-positives``;
    where absent, they are dropped at every threshold that their share of void is above, as in ScanNet's script.
    ``labels``: whether the same mask may stand there under several labels (``top-k``) or under ``one`` alone; where
    absent, either is scored, and no ranking has both. ``box_axes``: the box of an instance is the smallest around its
    points along the axes of the ``truth``'s box that it is held against, or along those of the ``world``, or of the
    ``aligned`` world, which the dataset's own motion turned along the walls (the world where it has none).
    ``unnamed``: the class as which objects and points count that have none; they have none where it is absent.
    ``predicates`` are those of the relations asked for, which people ``annotated`` or boxes give (``geometric``).
    """

    name: str
    version: Annotated[int, Field(ge=1)]
    summary: str
    kind: Kind
    metric: MetricName
    datasets: tuple[str, ...]
    by_default: bool = True
    label_space: str
    ground_truth: str
    classes: tuple[ClassEntry, ...] = ()
    class_numbers: Literal["ids", "lines"] = "ids"
    class_agnostic: Literal["scored", "annotated", "numbered", "everything"] | None = None
    void: Literal["false-positives"] | None = None
    stuff: tuple[str, ...] = ()
    unnamed: str | None = None
    labels: Literal["one", "top-k"] | None = None
    ignore: tuple[str, ...] = ()
    ignore_rule: Literal["exact", "substring"] = "exact"
    vocabulary: Literal["all", "scored", "scene"] | None = None
    prompt: str | None = None
    prompts: tuple[str, ...] = ()
    prompt_names: dict[str, str] = {}
    encoder: str | None = None
    transfer: TransferRules
    min_region_size: Annotated[int, Field(ge=1)] | None = None
    thresholds: tuple[float, ...] = ()
    confidence: Literal["ones", "prediction", "similarity", "similarity-min-max"] | None = None
    top_k: Annotated[int, Field(ge=1)] | None = None
    questions: Literal["dataset", "generated"] | None = None
    per_kind: Annotated[int, Field(ge=1)] | None = None
    synonyms: Literal["lexicon"] | None = None
    merging: MergeRules | None = None
    answers: AnswerRules | None = None
    box_axes: BOX_AXES | None = None
    presence: PresenceRules | None = None
    predicates: tuple[str, ...] = ()
    relations: Literal["annotated", "geometric"] | None = None
    aggregate: Literal["pooled", "scene-mean"] = "pooled"
    headline: Annotated[tuple[str, ...], Field(min_length=1)]
    not_comparable_with: tuple[str, ...] = ()

    # What the kinds differ in
    values_of_metric: ClassVar[ValuesOfMetric] = {}  # of each metric, what its values are called
    candidates: ClassVar[tuple[str, ...]] = ("map-points",)
    confidences: ClassVar[tuple[str, ...]] = ()  # where there are precision-recall curves
    allowed: ClassVar[Mapping[str, tuple[object, ...]]] = {}  # of those of OWN_FIELDS that take less than their type
    takes_dense: ClassVar[bool] = False  # a map with one feature a point
    uses_names: ClassVar[bool] = False  # of instances, without features
    needs_own_points: ClassVar[bool] = False  # objects are found by the points of the map itself
    needs_boxes: ClassVar[bool] = False  # in the truth
    needs_places: ClassVar[bool] = False  # of floors and rooms, in the truth and in the prediction
    is_judged: ClassVar[bool] = False  # its counts are how many were judged and how many are right
    names_points: ClassVar[bool] = False  # a class for every point
    needs_instances: ClassVar[bool] = False  # in the truth and in the prediction
    takes_votes: ClassVar[bool] = False  # of several neighbours
    transfers: ClassVar[bool] = True  # masks or classes to the points of the truth
    needs_cap: ClassVar[bool] = False  # how far that may be
    takes_voxels: ClassVar[bool] = True  # of masks that are reduced to one point a voxel
    text_metrics: ClassVar[tuple[str, ...]] = ()  # compare features with texts whatever labels there are
    ignores_classes: ClassVar[bool] = True  # ``ignore`` and ``prompt_names`` speak of ``classes``
    needs: ClassVar[tuple[str, ...]] = ()  # those of OWN_FIELDS that must be there
    takes: ClassVar[tuple[str, ...]] = ()  # those that may be there

    def _needed(self) -> tuple[str, ...]:
        """Those of ``OWN_FIELDS`` that must be there beside what these rules say already."""
        return self.needs

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        names = [entry.name for entry in self.classes]
        if len(set(names)) != len(names) or len({entry.id for entry in self.classes}) != len(names):
            raise ValueError("classes: each id and each name may stand there once")
        self._check_texts()
        needed = self._needed()
        for field in OWN_FIELDS:
            value = getattr(self, field)
            if value in (None, ()) and field in needed:
                raise ValueError(f"{field}: is missing, and kind '{self.kind}' needs it with these rules")
            if value not in (None, ()) and field not in (*needed, *self.takes):
                raise ValueError(f"{field}: kind '{self.kind}' does not take it with these rules")
            if value not in (None, (), *self.allowed.get(field, (value,))):
                raise ValueError(f"{field}: kind '{self.kind}' takes {' or '.join(map(repr, self.allowed[field]))}")
        self._check_classes(names)
        self._check_metric()
        self._check_transfer()
        if self.per_kind is not None and self.questions != "generated":
            raise ValueError("per_kind: belongs to generated questions")
        return self

    def _check_classes(self, names: Sequence[str]) -> None:
        unknown = [name for name in (*self.ignore, *self.prompt_names) if not any(name in known for known in names)]
        if unknown and self.ignores_classes:
            raise ValueError(f"ignore or prompt_names: '{unknown[0]}' is no class{suggest(unknown[0], names)}")
        if self.unnamed is not None and self.unnamed not in names:
            raise ValueError(f"unnamed: '{self.unnamed}' is no class{suggest(self.unnamed, names)}")
        scored = [entry.name for entry in self.scored]
        for name in self.stuff:
            if name not in scored:
                raise ValueError(f"stuff: '{name}' is no scored class{suggest(name, scored)}")

    def _check_texts(self) -> None:
        texts = self.prompts if self.prompt is None else (self.prompt, *self.prompts)
        compares = self.names_masks or not (self.needs_instances or self.uses_names or self.needs_places)
        if not compares and (texts or self.encoder):
            raise ValueError("prompt: these rules compare no features; they take no prompt and no encoder")
        if compares and (self.prompt is None) == (not self.prompts):
            raise ValueError("prompt: give either prompt or prompts")
        if without := [text for text in texts if "{}" not in text]:
            raise ValueError(f"prompt: '{without[0]}' has no {{}} for the class name")

    def _check_metric(self) -> None:
        if self.metric not in self.values_of_metric:
            raise ValueError(f"metric: kind '{self.kind}' takes {' or '.join(map(repr, self.values_of_metric))}")
        if not set(self.headline) <= set(self.value_names):
            raise ValueError(f"headline: a protocol of kind '{self.kind}' has {', '.join(self.value_names)}")
        if self.confidences and not {0.25, 0.5} <= set(self.thresholds):
            raise ValueError("thresholds: 0.25 and 0.5 must be among them")

    def _check_transfer(self) -> None:
        transfer, kind = self.transfer, f"kind '{self.kind}'"
        is_each = transfer.candidates == "each-mask"
        if transfer.candidates not in self.candidates:
            raise ValueError(f"transfer.candidates: {kind} takes {' or '.join(map(repr, self.candidates))}")
        if transfer.cap_m is None and (self.needs_cap or is_each):
            raise ValueError(f"transfer.cap_m: {kind} needs one, with {transfer.candidates}")
        if transfer.cap_m is not None and not self.transfers:
            raise ValueError(f"transfer.cap_m: {kind} transfers nothing")
        keeps_all = not self.transfers or not self.takes_voxels or is_each or transfer.neighbours > 1
        if transfer.evaluation_voxel_m > 0 and keeps_all:
            raise ValueError(f"transfer.evaluation_voxel_m: {kind} leaves no point out here; set it to 0")
        if transfer.neighbours > 1 and not self.takes_votes:
            raise ValueError("transfer.neighbours: belongs to kind 'semantic'")
        if transfer.neighbours == 1 and transfer.votes == "masks":
            raise ValueError("transfer.votes: a single neighbour holds no vote; give more neighbours")

    @property
    def value_names(self) -> tuple[str, ...]:
        """What the values of the metric are called that may stand in the headline."""
        return self.values_of_metric[self.metric]

    def is_ignored(self, name: str) -> bool:
        """Whether the class ``name`` is left out, by exact name or, under the substring rule, by a part of it."""
        return name in self.ignore if self.ignore_rule == "exact" else any(part in name for part in self.ignore)

    @property
    def scored(self) -> tuple[ClassEntry, ...]:
        """The classes that count, in order."""
        return tuple(entry for entry in self.classes if not self.is_ignored(entry.name))

    @property
    def curve_names(self) -> tuple[str, ...]:
        """What the precision-recall curves are named after: the scored classes, or ``object`` where labels are none."""
        return tuple(entry.name for entry in self.scored) if self.names_masks else ("object",)

    @property
    def names_masks(self) -> bool:
        """Whether masks must have the right class too."""
        return self.needs_instances and self.class_agnostic is None

    @property
    def n_labels(self) -> int | None:
        """How many labels of a mask or point count, if it has so many; None where its label is not asked for."""
        return (self.top_k or 1) if self.vocabulary is not None and self.class_agnostic is None else None

    @property
    def compares_texts(self) -> bool:
        """Whether features are compared with texts whatever labels there are."""
        return self.metric in self.text_metrics

    @property
    def asks(self) -> bool:
        """Whether a scene's truth is questions about it, the dataset's or made, rather than its labelled points."""
        return self.is_judged or self.questions is not None

    def texts_of(self, name: str) -> tuple[str, ...]:
        """The texts that stand for the class, label or query ``name``; their mean feature counts."""
        templates = self.prompts if self.prompt is None else (self.prompt,)
        return tuple(template.replace("{}", self.prompt_names.get(name, name)) for template in templates)

    @property
    def digest(self) -> str:
        """A content key of all rules; a field that a later version adds leaves it alone where it has its default."""
        return hashlib.sha256(self.model_dump_json(exclude_defaults=True).encode()).hexdigest()

    @property
    def as_json(self) -> dict[str, Any]:
        """All that ``digest`` counts, as plain values; ``read_rules`` makes the rules of them again."""
        return self.model_dump(mode="json", exclude_defaults=True)
