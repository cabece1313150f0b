"""The rules of an evaluation: everything that affects its values."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.core.errors import suggest

# The only list of each: mappings by kind or metric have keys of this type, so that mypy finds a misspelt one.
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
VoidRule = Literal["false-positives", "groups"]
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
    """A class of the label set: its id in the label space, its name, and its group for averages."""

    id: Annotated[int, Field(ge=0)]
    name: str
    group: str | None = None


class TransferRules(_Strict):
    """How a prediction on other points than the ground truth's is transferred to the scored points.

    ``candidates``: ``object-points`` (only points that belong to an instance, as ConceptGraphs concatenates its object
    clouds), ``map-points`` (all points of the map; no instance if the nearest is background) or ``each-mask`` (a point
    is in every mask that has a point nearer than the cap). ``neighbours``: above 1 a point takes the majority class of
    that many nearest object points, or with ``votes`` of ``masks`` that of the object that most of them belong to, the
    first on ties; overlapping objects vote separately. Of equally near points, those vote that the original's search
    finds: scikit-learn's ball tree, for votes of masks SciPy's k-d tree.
    ``cap_m``: farther neighbours do not count, no cap if absent; a point without a neighbour has no prediction.
    If ``evaluation_voxel_m`` is above 0, each mask is first downsampled to one point per voxel; for kind ``categories``
    the whole cloud is, to the mean of the points. With a single neighbour, and with votes of masks, predictions on the
    scored points themselves are used unchanged.
    """

    candidates: Literal["object-points", "map-points", "each-mask"]
    neighbours: Annotated[int, Field(ge=1, le=100)] = 1
    votes: Literal["classes", "masks"] = "classes"
    cap_m: Annotated[float, Field(gt=0)] | None = None
    evaluation_voxel_m: Annotated[float, Field(ge=0)] = 0.0


class MergeRules(_Strict):
    """When a mask counts as over-merged or under-merged.

    ``over_merged_share``: at least this share of the object vertices that it covers belongs to other objects than the
    one that it covers most. ``under_merged_share``: it covers less than this share of the vertices of that object that
    all instances assigned to it cover, counted per instance; so a duplicate is under-merged too.
    """

    over_merged_share: Annotated[float, Field(gt=0, le=1)]
    under_merged_share: Annotated[float, Field(ge=0, le=1)]


class AnswerRules(_Strict):
    """The tolerance of a distance: ``distance_m`` or ``distance_share`` of the true one, whichever is larger."""

    distance_m: Annotated[float, Field(ge=0)]
    distance_share: Annotated[float, Field(ge=0)]


class PresenceRules(_Strict):
    """When a text counts as present in the map, and over which rooms objects are counted.

    The relevancy of an instance to a text is the minimum over all ``canonical`` phrases of the text's share in the
    softmax of its cosine and that of the phrase, both times ``sharpness``; a text is present if that of an instance is
    above ``relevancy``. ``counted_over``: the rooms over which frequent objects, and objects that occur together, are
    counted to choose absent ones.
    """

    canonical: Annotated[tuple[str, ...], Field(min_length=1)]
    sharpness: Annotated[float, Field(gt=0)]
    relevancy: Annotated[float, Field(gt=0, lt=1)]
    counted_over: Literal["rooms", "homes"]


SECTIONS: dict[str, type[BaseModel]] = {
    "transfer": TransferRules, "merging": MergeRules, "answers": AnswerRules, "presence": PresenceRules
}  # fmt: skip


class ProtocolRules(_Strict):
    """One complete evaluation: the same rules and the same prediction give the same values.

    ``kind``: ``semantic`` (one class per point), ``top-k`` (the most likely classes of a point, which may have several
    labels), ``instance`` (masks with a class), ``panoptic`` (every point in a segment of a thing or of ``stuff``),
    ``queries`` (masks ranked for each text), ``boxes`` (with a class), ``categories`` (how close a point's label is
    to those of its object), ``grounding`` (the box of the first mask of each text), ``object-chains`` (one object by
    each of its texts), ``relations`` (objects, predicates and triplets of a scene graph), ``objects`` (matched one to
    one, with the rank of their category), ``places`` (floors and rooms), or questions that annotators answer in the
    originals: ``retrieval`` (the first mask of each text), ``presence`` (whether such an object exists), ``annotation``
    (names and shapes of masks), ``reasoning`` (questions that boxes can answer). ``questions`` are those of the
    ``dataset`` itself or ``generated`` from ground truth, at most ``per_kind`` per kind; ``synonyms`` names the table
    of alternative class names. Protocols that are not ``by_default`` run only if named. ``classes`` is the label set in
    the order of the original; prediction files number it by ``ids``, or by ``lines``, indices into the list from 0
    (``class_numbers``); ``ignore`` names classes that are known but not scored, and for ``categories`` labels whose
    objects are not. ``vocabulary``: the classifier chooses among ``all`` classes, the ``scored`` ones, or the scored
    ones that the ``scene``'s ground truth contains. ``prompt`` has ``{}`` for the class name, which ``prompt_names``
    may replace; of several ``prompts`` the mean feature counts. ``distractors``: names that no object has; what is most
    similar to one of them has no class. ``confidence``: ``ones`` for every mask, the
    ``prediction``'s own, or for queries the ``similarity`` of mask and text (cosine), or the cosine rescaled to 0..1
    over the scene's masks for each query. ``top_k``: the number of labels of a point, or masks of a query, that count;
    all if absent. ``class_agnostic`` drops the labels: the true instances are those of the ``scored`` classes (the rest
    is void), ``annotated``, all with a class, ``numbered``, where a number identifies an object, whatever its class, or
    ``everything``, with the unannotated points as one more. ``void``: masks on it are ``false-positives``; if absent,
    they are dropped at every threshold below their share of void, as in ScanNet's script; with ``groups``, those of
    values below 1000, points of a group of less than the minimum size count twice in it. ``labels``: whether the same
    mask may occur with several labels (``top-k``) or only with ``one``; if absent, both are scored, but not mixed in a
    ranking. ``box_axes``: the box of an instance is the smallest around its points along the axes of the ``truth``'s
    box that it is compared with, or along those of the ``world``, or of the ``aligned`` world, rotated along the walls
    by the dataset's own transform (the world if it has none). ``unnamed``: the class of objects and points without
    one; none if absent. ``predicates`` are those of the relations, which annotators gave (``annotated``) or boxes
    determine (``geometric``).
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
    void: VoidRule | None = None
    stuff: tuple[str, ...] = ()
    unnamed: str | None = None
    labels: Literal["one", "top-k"] | None = None
    ignore: tuple[str, ...] = ()
    ignore_rule: Literal["exact", "substring"] = "exact"
    vocabulary: Literal["all", "scored", "scene"] | None = None
    prompt: str | None = None
    prompts: tuple[str, ...] = ()
    prompt_names: dict[str, str] = {}
    distractors: tuple[str, ...] = ()
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
    values_of_metric: ClassVar[ValuesOfMetric] = {}  # names of the values of each metric
    values_of_groups: ClassVar[tuple[str, ...]] = ()  # those that also exist for each group of classes
    candidates: ClassVar[tuple[str, ...]] = ("map-points",)
    confidences: ClassVar[tuple[str, ...]] = ()  # if there are precision-recall curves
    allowed: ClassVar[Mapping[str, tuple[object, ...]]] = {}  # for those of OWN_FIELDS that accept less than their type
    takes_dense: ClassVar[bool] = False  # a map with one feature per point
    uses_names: ClassVar[bool] = False  # names of instances, without features
    needs_own_points: ClassVar[bool] = False  # objects are found by the points of the map itself
    needs_boxes: ClassVar[bool] = False  # in the ground truth
    needs_places: ClassVar[bool] = False  # floors and rooms, in ground truth and prediction
    is_judged: ClassVar[bool] = False  # its counts are the numbers of judged and of right answers
    names_points: ClassVar[bool] = False  # a class for every point
    needs_instances: ClassVar[bool] = False  # in ground truth and prediction
    takes_votes: ClassVar[bool] = False  # of several neighbours
    transfers: ClassVar[bool] = True  # masks or classes to the ground-truth points
    needs_cap: ClassVar[bool] = False  # a maximum distance for that
    takes_voxels: ClassVar[bool] = True  # of masks that are downsampled to one point per voxel
    text_metrics: ClassVar[tuple[str, ...]] = ()  # compare features with texts regardless of labels
    ignores_classes: ClassVar[bool] = True  # ``ignore`` and ``prompt_names`` refer to ``classes``
    needs: ClassVar[tuple[str, ...]] = ()  # required ones of OWN_FIELDS
    takes: ClassVar[tuple[str, ...]] = ()  # optional ones

    def _needed(self) -> tuple[str, ...]:
        """The ones of ``OWN_FIELDS`` that these rules require."""
        return self.needs

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        names = [entry.name for entry in self.classes]
        if len(set(names)) != len(names) or len({entry.id for entry in self.classes}) != len(names):
            raise ValueError("classes: ids and names must not repeat")
        self._check_texts()
        needed = self._needed()
        for field in OWN_FIELDS:
            value = getattr(self, field)
            if value in (None, ()) and field in needed:
                raise ValueError(f"{field}: is missing; kind '{self.kind}' needs it with these rules")
            if value not in (None, ()) and field not in (*needed, *self.takes):
                raise ValueError(f"{field}: kind '{self.kind}' does not take it with these rules")
            if value not in (None, (), *self.allowed.get(field, (value,))):
                raise ValueError(f"{field}: kind '{self.kind}' takes {' or '.join(map(repr, self.allowed[field]))}")
        self._check_classes(names)
        self._check_metric()
        self._check_transfer()
        if self.per_kind is not None and self.questions != "generated":
            raise ValueError("per_kind: only for generated questions")
        return self

    def _check_classes(self, names: Sequence[str]) -> None:
        unknown = [name for name in (*self.ignore, *self.prompt_names) if not any(name in known for known in names)]
        if unknown and self.ignores_classes:
            raise ValueError(f"ignore or prompt_names: '{unknown[0]}' is not a class{suggest(unknown[0], names)}")
        if self.unnamed is not None and self.unnamed not in names:
            raise ValueError(f"unnamed: '{self.unnamed}' is not a class{suggest(self.unnamed, names)}")
        scored = [entry.name for entry in self.scored]
        for name in self.stuff:
            if name not in scored:
                raise ValueError(f"stuff: '{name}' is not a scored class{suggest(name, scored)}")

    def _check_texts(self) -> None:
        texts = self.prompts if self.prompt is None else (self.prompt, *self.prompts)
        compares = self.names_masks or not (self.needs_instances or self.uses_names or self.needs_places)
        if not compares and (texts or self.encoder):
            raise ValueError("prompt: these rules compare no features; remove prompt and encoder")
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
            raise ValueError(f"transfer.cap_m: {kind} has no transfer; remove it")
        keeps_all = not self.transfers or not self.takes_voxels or is_each or transfer.neighbours > 1
        if transfer.evaluation_voxel_m > 0 and keeps_all:
            raise ValueError(f"transfer.evaluation_voxel_m: {kind} does not downsample here; set it to 0")
        if transfer.neighbours > 1 and not self.takes_votes:
            raise ValueError("transfer.neighbours: only for kind 'semantic'")
        if transfer.neighbours == 1 and transfer.votes == "masks":
            raise ValueError("transfer.votes: needs more than one neighbour")

    @property
    def value_names(self) -> tuple[str, ...]:
        """The names of the metric's values that can be in the headline."""
        of_groups = (f"{value} {group}" for value in self.values_of_groups for group in self.groups)
        return (*self.values_of_metric[self.metric], *of_groups)

    @property
    def groups(self) -> dict[str, list[int]]:
        """The scored classes of each group, by their positions among the scored classes."""
        groups: dict[str, list[int]] = {}
        for position, entry in enumerate(self.scored):
            if entry.group:
                groups.setdefault(entry.group, []).append(position)
        return groups

    @property
    def group_headline(self) -> dict[str, tuple[str, list[int]]]:
        """The headline values of a group, such as "AP novel": the value, and the positions of its classes."""
        named = {
            f"{value} {group}": (value, of) for value in self.values_of_groups for group, of in self.groups.items()
        }
        return {name: named[name] for name in self.headline if name in named}

    def is_ignored(self, name: str) -> bool:
        """Whether the class ``name`` is ignored, by exact name or, with the substring rule, by a part of it."""
        return name in self.ignore if self.ignore_rule == "exact" else any(part in name for part in self.ignore)

    @property
    def scored(self) -> tuple[ClassEntry, ...]:
        """The classes that count, in order."""
        return tuple(entry for entry in self.classes if not self.is_ignored(entry.name))

    @property
    def curve_names(self) -> tuple[str, ...]:
        """The names of the precision-recall curves: the scored classes, or ``object`` without labels."""
        return tuple(entry.name for entry in self.scored) if self.names_masks else ("object",)

    @property
    def names_masks(self) -> bool:
        """Whether masks must have the right class too."""
        return self.needs_instances and self.class_agnostic is None

    @property
    def n_labels(self) -> int | None:
        """The maximum number of labels of a mask or point that count; None if labels are not scored."""
        return (self.top_k or 1) if self.vocabulary is not None and self.class_agnostic is None else None

    @property
    def compares_texts(self) -> bool:
        """Whether features are compared with texts regardless of labels."""
        return self.metric in self.text_metrics

    @property
    def asks(self) -> bool:
        """Whether a scene's ground truth is questions (the dataset's or generated), not its labelled points."""
        return self.is_judged or self.questions is not None

    def texts_of(self, name: str) -> tuple[str, ...]:
        """The texts for the class, label or query ``name``; their mean feature counts."""
        templates = self.prompts if self.prompt is None else (self.prompt,)
        return tuple(template.replace("{}", self.prompt_names.get(name, name)) for template in templates)

    def with_names(self, names: Sequence[str]) -> Self:
        """The same rules with other ``names`` in the prompts, in the order of the classes; further ones distract."""
        texts = {entry.name: name for entry, name in zip(self.classes, names, strict=False)}
        distractors = (*self.distractors, *names[len(self.classes) :])
        return self.model_copy(update={"prompt_names": texts, "distractors": distractors})

    @property
    def digest(self) -> str:
        """A content key of all rules; fields with their default value do not affect it."""
        return hashlib.sha256(self.model_dump_json(exclude_defaults=True).encode()).hexdigest()

    @property
    def as_json(self) -> dict[str, Any]:
        """The content of ``digest`` as plain values; ``read_rules`` converts them back to rules."""
        return self.model_dump(mode="json", exclude_defaults=True)
