"""Named, versioned evaluations: everything that moves a number, read from ``rules/*.toml``.

A protocol is chosen by name, or by the path of a TOML file of the same form. Unknown keys and wrong values are errors
of one line that name the file and the key.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.core.errors import ConfigError, suggest

RULES = Path(__file__).parent / "rules"
_TABLE_PREFIX = "classes."  # rules/classes.<name>.toml holds a class table, not a protocol


class ClassEntry(BaseModel):
    """A class of the label set: its id in the label space, its name, the group it is averaged in."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    id: Annotated[int, Field(ge=0)]
    name: str
    group: str | None = None


class TransferRules(BaseModel):
    """How a prediction on other points than the truth's reaches the scored points.

    ``candidates``: ``object-points`` (only points that belong to an instance, as ConceptGraphs concatenates its object
    clouds), ``map-points`` (all points of the map; the nearest being background means no instance) or ``each-mask`` (a
    point is in every mask that has a point nearer than the cap). ``neighbours``: above 1 a point takes the class that
    most of so many nearest object points have, the first class of equals; objects that overlap vote each.
    ``cap_m``: farther neighbours do not count, no cap when absent; a point without a neighbour is predicted as nothing.
    Where ``evaluation_voxel_m`` is above 0, each mask is first reduced to one point a voxel; under kind ``categories``
    the whole cloud is, to the mean of the points. With a single neighbour, predictions on the scored points themselves
    are taken as they are.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    candidates: Literal["object-points", "map-points", "each-mask"]
    neighbours: Annotated[int, Field(ge=1, le=100)] = 1
    cap_m: Annotated[float, Field(gt=0)] | None = None
    evaluation_voxel_m: Annotated[float, Field(ge=0)] = 0.0


class MergeRules(BaseModel):
    """When a mask is faulty: over-merged or under-merged.

    ``over_merged_share``: of the object vertices that it covers, at least this share belongs to other objects than the
    one that it covers most. ``under_merged_share``: of the vertices of that object that all instances which stand for
    it cover, one after another, it covers less than this share; so one thing twice is under-merged too.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    over_merged_share: Annotated[float, Field(gt=0, le=1)]
    under_merged_share: Annotated[float, Field(ge=0, le=1)]


class AnswerRules(BaseModel):
    """How far a distance may be off: ``distance_m`` or ``distance_share`` of the true one, whichever is more."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    distance_m: Annotated[float, Field(ge=0)]
    distance_share: Annotated[float, Field(ge=0)]


_SECTIONS: dict[str, type[BaseModel]] = {"transfer": TransferRules, "merging": MergeRules, "answers": AnswerRules}

CATEGORIES = ("synonyms", "depictions", "vis_sim", "clutter", "missing", "incorrect")
AP_NAMES = ("AP", "AP50", "AP25")
VALUES_OF_METRIC: dict[str, tuple[str, ...]] = {
    "openlex3d-topn": CATEGORIES,
    "openlex3d-ranking": ("overall", "synonyms", "secondary"),
    "query-ap": AP_NAMES,
    "retrieval": ("instance", "affordance", "property", "relative", "all", "reachable"),
    "annotation": ("label n", "label n'", "well-merged", "under-merged", "over-merged"),
    "reasoning": ("answer", "objects"),
}
SHARE_KINDS = ("retrieval", "annotation", "reasoning")  # their counts are how many were judged and how many are right
_METRICS = {
    "semantic": ("conceptgraphs", "scannet", "hovsg"),
    "instance": ("scannet",),
    "queries": ("query-ap",),
    "categories": ("openlex3d-topn", "openlex3d-ranking"),
    **{kind: (kind,) for kind in SHARE_KINDS},
}
_CONFIDENCES = {"instance": ("ones", "prediction"), "queries": ("similarity", "similarity-min-max")}
_CANDIDATES = {
    "semantic": ("object-points", "map-points"),
    "instance": ("map-points",),
    "queries": ("each-mask", "map-points"),
    "categories": ("object-points",),
    **dict.fromkeys(SHARE_KINDS, ("map-points",)),
}


class ProtocolRules(BaseModel):
    """One evaluation, complete: the same rules and the same prediction give the same number.

    ``kind``: ``semantic`` (a class a point), ``instance`` (masks with a class), ``queries`` (masks ranked for each
    text), ``categories`` (how near a point's label comes to those of its object), or what people are asked otherwise:
    ``retrieval`` (the first mask of each text), ``annotation`` (names and shapes of masks), ``reasoning`` (questions
    that boxes settle). ``questions`` are those of the ``dataset`` itself or ``generated`` from the truth, ``per_kind``
    of each kind at most; ``synonyms`` names the table of other names of classes. Protocols that are not ``by_default``
    run where they are named. ``classes`` is the label set in
    the order of the original; ``ignore`` names classes that are known but not scored, and for ``categories`` labels
    whose objects are not. ``vocabulary``: the classifier chooses among ``all`` classes, the ``scored`` ones, or those
    scored ones that the ``scene``'s ground truth contains. ``prompt`` has ``{}`` for the class name, which
    ``prompt_names`` may replace; of several ``prompts`` the mean feature counts. ``confidence``: ``ones`` for every
    mask, the ``prediction``'s own, or for queries the ``similarity`` of mask and text (cosine), or that stretched to
    0..1 over the scene's masks for each query. ``top_k``: how many labels of a point, or masks of a query, count; all
    where absent. ``class_agnostic`` drops the labels: the truth's instances are those of the ``scored`` classes (the
    rest is void), all ``annotated`` ones, or ``everything``, with the points that nobody annotated as one more.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: str
    version: Annotated[int, Field(ge=1)]
    summary: str
    kind: Literal["semantic", "instance", "queries", "categories", "retrieval", "annotation", "reasoning"]
    metric: Literal[
        "conceptgraphs",
        "scannet",
        "hovsg",
        "query-ap",
        "openlex3d-topn",
        "openlex3d-ranking",
        "retrieval",
        "annotation",
        "reasoning",
    ]
    datasets: tuple[str, ...]
    by_default: bool = True
    label_space: str
    ground_truth: str
    classes: tuple[ClassEntry, ...] = ()
    class_agnostic: Literal["scored", "annotated", "everything"] | None = None
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
    aggregate: Literal["pooled", "scene-mean"] = "pooled"
    headline: Annotated[tuple[str, ...], Field(min_length=1)]
    not_comparable_with: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        self._check_classes()
        self._check_texts()
        self._check_metric()
        return self

    def _check_classes(self) -> None:
        names = [entry.name for entry in self.classes]
        if len(set(names)) != len(names) or len({entry.id for entry in self.classes}) != len(names):
            raise ValueError("classes: each id and each name may stand there once")
        has_labels = self.kind in ("semantic", "instance") and self.class_agnostic in (None, "scored")
        if bool(names) != has_labels:
            raise ValueError("classes: needed where labels count, that is under kinds 'semantic' and 'instance'")
        unknown = [name for name in (*self.ignore, *self.prompt_names) if not any(name in known for known in names)]
        if unknown and self.kind != "categories":
            raise ValueError(f"ignore or prompt_names: '{unknown[0]}' is no class{suggest(unknown[0], names)}")
        if self.class_agnostic is not None and self.kind != "instance":
            raise ValueError("class_agnostic: belongs to kind 'instance'")

    def _check_texts(self) -> None:
        texts = self.prompts if self.prompt is None else (self.prompt, *self.prompts)
        if self.class_agnostic is not None and (texts or self.vocabulary or self.encoder):
            raise ValueError("class_agnostic: takes no prompt, vocabulary or encoder")
        if (self.vocabulary is None) == (self.kind in ("semantic", "instance") and self.class_agnostic is None):
            raise ValueError("vocabulary: belongs to protocols that choose among classes, and these need it")
        if self.kind in ("annotation", "reasoning"):
            if texts or self.encoder:
                raise ValueError(f"prompt: kind '{self.kind}' compares no features; it takes no prompt and no encoder")
        elif self.class_agnostic is None and (self.prompt is None) == (not self.prompts):
            raise ValueError("prompt: give either prompt or prompts")
        without = [text for text in texts if "{}" not in text]
        if without:
            raise ValueError(f"prompt: '{without[0]}' has no {{}} for the class name")

    def _check_metric(self) -> None:
        has_curve = self.kind in ("instance", "queries")
        if self.metric not in _METRICS[self.kind] or (has_curve and None in (self.min_region_size, self.confidence)):
            names = " or ".join(f"'{name}'" for name in _METRICS[self.kind])
            rest = ", min_region_size, thresholds and confidence" if has_curve else ""
            raise ValueError(f"kind '{self.kind}' needs metric {names}{rest}")
        known = VALUES_OF_METRIC.get(self.metric, AP_NAMES if has_curve else ("mAcc", "mIoU", "F-mIoU"))
        if not set(self.headline) <= set(known):
            raise ValueError(f"headline: a protocol of kind '{self.kind}' has {', '.join(known)}")
        has_size = self.min_region_size is not None and self.kind not in SHARE_KINDS
        if not has_curve and (has_size or self.thresholds or self.confidence):
            raise ValueError("min_region_size, thresholds and confidence belong to kind 'instance' or 'queries'")
        if has_curve and not {0.25, 0.5} <= set(self.thresholds):
            raise ValueError("thresholds: 0.25 and 0.5 must be among them")
        if has_curve and self.confidence not in _CONFIDENCES[self.kind]:
            raise ValueError(f"confidence: kind '{self.kind}' takes {' or '.join(_CONFIDENCES[self.kind])}")
        if (self.metric == "openlex3d-topn") != (self.top_k is not None) and self.kind != "queries":
            raise ValueError("top_k: belongs to kind 'queries' and to metric 'openlex3d-topn', which needs it")
        self._check_transfer()
        self._check_questions()

    def _check_questions(self) -> None:
        asks = self.kind in ("retrieval", "reasoning")
        if (self.questions is not None) != asks or (self.kind in SHARE_KINDS and self.min_region_size is None):
            raise ValueError("questions: kinds 'retrieval' and 'reasoning' need them, and min_region_size")
        if self.kind == "reasoning" and self.questions != "generated":
            raise ValueError("questions: kind 'reasoning' takes 'generated'")
        if self.per_kind is not None and self.questions != "generated":
            raise ValueError("per_kind: belongs to generated questions")
        needs_names = self.kind == "annotation" or self.questions == "generated"
        if (self.synonyms is not None) != needs_names:
            raise ValueError("synonyms: kind 'annotation' and generated questions need a table, others take none")
        if (self.merging is not None) != (self.kind == "annotation"):
            raise ValueError("merging: kind 'annotation' needs it, others take none")
        if (self.answers is not None) != (self.kind == "reasoning"):
            raise ValueError("answers: kind 'reasoning' needs it, others take none")

    def _check_transfer(self) -> None:
        transfer = self.transfer
        if transfer.candidates not in _CANDIDATES[self.kind]:
            names = " or ".join(f"'{name}'" for name in _CANDIDATES[self.kind])
            raise ValueError(f"transfer.candidates: kind '{self.kind}' takes {names}")
        if transfer.candidates == "each-mask" and (transfer.cap_m is None or transfer.evaluation_voxel_m > 0):
            raise ValueError("transfer.cap_m: 'each-mask' needs one, and no evaluation_voxel_m")
        if transfer.neighbours > 1 and self.kind != "semantic":
            raise ValueError("transfer.neighbours: belongs to kind 'semantic'")
        if self.kind in SHARE_KINDS and transfer.cap_m is None:
            raise ValueError(f"transfer.cap_m: kind '{self.kind}' needs one")

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
        if self.class_agnostic is not None or self.kind == "queries":
            return ("object",)
        return tuple(entry.name for entry in self.scored)

    def texts_of(self, name: str) -> tuple[str, ...]:
        """The texts that stand for the class, label or query ``name``; their mean feature counts."""
        templates = self.prompts if self.prompt is None else (self.prompt,)
        return tuple(template.replace("{}", self.prompt_names.get(name, name)) for template in templates)

    @property
    def digest(self) -> str:
        """A content key of all rules; a field that a later version adds leaves it alone where it has its default."""
        return hashlib.sha256(self.model_dump_json(exclude_defaults=True).encode()).hexdigest()


def protocol_names() -> list[str]:
    """The names of the built-in protocols."""
    return sorted(path.stem for path in RULES.glob("*.toml") if not path.name.startswith(_TABLE_PREFIX))


def protocols_for(dataset: str) -> list[str]:
    """The protocols under which a dataset is scored unless others are named."""
    known = map(load_protocol, protocol_names())
    return [rules.name for rules in known if rules.by_default and dataset in rules.datasets]


def not_comparable_with(rules: ProtocolRules) -> list[str]:
    """Protocols whose numbers must not stand beside those of ``rules``: it names them, or they name it."""
    naming = [name for name in protocol_names() if rules.name in load_protocol(name).not_comparable_with]
    return sorted({*rules.not_comparable_with, *naming})


def rules_file(name: str) -> Path:
    """Where the rules called ``name`` are read from."""
    return RULES / f"{name}.toml" if name in protocol_names() else Path(name)


@lru_cache(maxsize=64)
def load_protocol(name: str) -> ProtocolRules:
    """The rules called ``name``, or those in the file ``name`` when it ends in ``.toml``."""
    known = protocol_names()
    if name in known:
        return read_protocol(rules_file(name))
    if name.endswith(".toml"):
        rules = read_protocol(Path(name))
        if rules.name in known:
            raise ConfigError(f"{name}: the protocol name '{rules.name}' is built in; choose another name")
        return rules
    raise ConfigError(f"unknown protocol '{name}'{suggest(name, known) or '; known: ' + ', '.join(known)}")


def read_protocol(path: Path) -> ProtocolRules:
    """The rules in a TOML file, where ``classes`` names a class table or lists rows [id, name] or [id, name, group]."""
    content = _read_toml(path)
    table = content.get("classes")
    if isinstance(table, str):
        tables = {p.stem.removeprefix(_TABLE_PREFIX): p for p in RULES.glob(f"{_TABLE_PREFIX}*.toml")}
        if table not in tables:
            known = suggest(table, tables) or "; known: " + ", ".join(sorted(tables))
            raise ConfigError(f"{_line_of(path, 'classes')}: unknown class table '{table}'{known}")
        content["classes"] = _read_toml(tables[table])["classes"]
    if "classes" in content:
        content["classes"] = _entries(path, content.get("classes"))
    try:
        return ProtocolRules.model_validate(_with_tuples(content))
    except ValidationError as error:
        raise ConfigError(_first_line(path, error)) from error


def _entries(path: Path, table: Any) -> list[dict[str, Any]]:
    keys = ("id", "name", "group")
    if not isinstance(table, list) or not all(isinstance(row, list) and 2 <= len(row) <= 3 for row in table):
        raise ConfigError(f"{_line_of(path, 'classes')}: classes must be a table's name or rows of [id, name]")
    return [dict(zip(keys, row, strict=False)) for row in table]


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # no TOML, no UTF-8, thousands of digits, nested thousands deep
        raise ConfigError(f"{path}: is no valid TOML: {error}") from error


def _with_tuples(value: Any) -> Any:
    """TOML knows lists alone; the strict model wants its tuples."""
    if isinstance(value, list):
        return tuple(_with_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return value


def _first_line(path: Path, error: ValidationError) -> str:
    """The first complaint as one line with the file, the line and, for an unknown key, the likely one."""
    # a misspelt key is both unknown and, under its right name, missing: the first says more
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        last = str(first["loc"][-1])
        sections: dict[str, type[BaseModel]] = {
            "transfer": TransferRules,
            "merging": MergeRules,
            "answers": AnswerRules,
        }
        fields = sections.get(key.partition(".")[0], ProtocolRules).model_fields
        return f"{_line_of(path, last)}: unknown key '{key}'{suggest(last, fields)}"
    if first["type"] == "missing":
        return f"{path}: the key '{key}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    where = _line_of(path, str(first["loc"][-1]) if first["loc"] else message.split(":")[0])
    message = message[0].lower() + message[1:]
    return f"{where}: {key}: {message}, not {first['input']!r}" if key else f"{where}: {message}"


def _line_of(path: Path, key: str) -> str:
    """``path:line`` of the first line that sets ``key``, or ``path`` alone."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if re.match(rf"\s*{re.escape(key)}\s*=", line):
            return f"{path}:{number}"
    return str(path)
