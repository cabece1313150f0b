"""Label n': one name for an instance, chosen from the names of its best views by vote or by a language model.

The file of labels n' is stored next to a map, which itself stays unchanged. The paper's filter of large background
objects is applied again under labels n': "Large background objects (walls, ground, roof, ceiling) and objects with
bounding boxes > 95 % of image area are excluded" (section III-A, Filtering and Post-Processing); labels n' "help to
filter out undesired large instances" (the text beside Table V).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.core.digests import digest_file
from su3d_bench.core.english import words
from su3d_bench.core.errors import PredictionError, StoreError, printable
from su3d_bench.core.files.atomic import read_json, write_json
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.questions.score import RefinedNames
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.perception.detections import is_background
from su3d_bench.perception.language.captioner import REFINE, REFINE_FORM, list_of_names, reason_of
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.parsing import chosen_name
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.run_folder import JobFolder

_OF_IMAGES = OpenSU3DConfig()


class FilterConfig(BaseModel):
    """Which instances labels n' exclude; no ``background_names`` and a ``max_map_fraction`` of 1 exclude none."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    # The paper's list, compared with the head noun of a name, as for detections in images.
    background_names: Annotated[tuple[str, ...], Field(strict=False)] = _OF_IMAGES.background_names
    # The paper's share is of an image's area; the map has no image, so its floor plan is used instead (ours).
    max_map_fraction: float = Field(default=_OF_IMAGES.max_box_fraction, gt=0, le=1)


def exclusion_reasons(instances: Instances, names: Sequence[str], config: FilterConfig) -> tuple[str, ...]:
    """The reason for excluding each instance under its label n' in ``names``; '' if not excluded."""
    reasons = []
    for name, fraction in zip(names, _map_fractions(instances).tolist(), strict=True):
        reason = f"its box has {100 * fraction:.0f} % of the map's area from above"
        if is_background(name, config.background_names):
            reason = f"'{printable(name, 60)}' is background"
        elif fraction <= config.max_map_fraction:
            reason = ""
        reasons.append(reason)
    return tuple(reasons)


def _map_fractions(instances: Instances) -> Float64Array:
    """The share (K,) of the map's area from above covered by the box of each instance; 0 if the map has no area."""
    k, points, boxes = len(instances), instances.points, instances.boxes.astype(np.float64)
    if boxes.shape != (k, 2, 3) or points.ndim != 2 or points.shape[1] != 3:
        raise PredictionError(f"this map has boxes {boxes.shape} for {k} instances, and points {points.shape}")
    if not len(points):
        return np.zeros(k)
    area = float(np.prod(np.ptp(points[:, :2], axis=0).astype(np.float64)))
    sides = np.maximum(boxes[:, 1, :2] - boxes[:, 0, :2], 0.0)
    answer: Float64Array = np.prod(sides, axis=1) / area if area > 0 else np.zeros(k)
    return answer


MAX_NAMES = 5  # the paper's m: n' is chosen from the names of this many best views
MAX_ANSWER_TOKENS = 200  # a name needs few; models that reason in their answer need more
Source = Literal["model", "vote", "label"]


@dataclass(frozen=True)
class TopNames:
    """The names of an instance's ``m`` best views, best first, with their prediction scores; ``label`` is n."""

    label: str
    names: tuple[str, ...]
    scores: tuple[float, ...]


@dataclass(frozen=True)
class RefinedName:
    """Label n' of an instance and its ``source``; ``label`` means that n was kept, for the ``reason`` given."""

    name: str
    source: Source
    reason: str
    key: str = ""


def top_names(instances: Instances, m: int) -> list[TopNames]:
    """Names of the ``m`` views with the highest prediction score of each instance; ties: the earlier view."""
    if instances.view_names is None or instances.view_scores is None:
        raise PredictionError("the map has no per-view names; run a method that stores them (opensu3d)")
    tops = []
    for k, label in enumerate(instances.names):
        first, last = int(instances.view_indptr[k]), int(instances.view_indptr[k + 1])
        scores = np.asarray(instances.view_scores[first:last], np.float64)
        order = [first + int(row) for row in np.argsort(-scores, kind="stable")[:m]]
        names = [(instances.view_names[row].strip(), float(instances.view_scores[row])) for row in order]
        named = [(name, score) for name, score in names if name]
        tops.append(TopNames(label, tuple(name for name, _ in named), tuple(score for _, score in named)))
    return tops


def vote(top: TopNames) -> RefinedName:
    """The name with the greatest sum of prediction scores; ties: the one with the best view.

    Names that differ only in case, hyphens or plural count together, in the spelling of the best view. No language
    model is used: names of different words stay different.

    >>> vote(TopNames("sofa", ("sofa", "couch", "couch"), (0.9, 0.5, 0.5))).name
    'couch'
    """
    if not top.names:
        return _unnamed(top)
    totals: dict[tuple[str, ...], float] = {}
    spelling: dict[tuple[str, ...], str] = {}
    for name, score in zip(top.names, top.scores, strict=True):
        key = words(name) or (name,)
        totals[key] = totals.get(key, 0.0) + score
        spelling.setdefault(key, name)
    best = max(totals.values())
    return RefinedName(next(spelling[key] for key, total in totals.items() if total == best), "vote", "")


class ModelRefiner:
    """Asks the text model for a single name, with the paper's prompt."""

    def __init__(self, model: LanguageModel, config: LanguageConfig) -> None:
        self._model = model
        self._config = config

    def requests(self, tops: Sequence[TopNames]) -> list[ChatRequest]:
        """One request per named instance."""
        config = self._config
        return [
            ChatRequest(
                "refine",
                config.text_model,
                f"{REFINE}. {REFINE_FORM}",
                list_of_names(top.names),
                max_answer_tokens=min(config.max_answer_tokens, MAX_ANSWER_TOKENS),
                temperature=config.temperature,
                seed=config.seed,
                reasoning_effort=config.reasoning_effort,
            )
            for top in tops
            if top.names
        ]

    def refine(self, tops: Sequence[TopNames]) -> list[RefinedName]:
        """n' of each instance: the model's name if usable, otherwise n with the reason."""
        requests = self.requests(tops)
        answers = iter(zip(requests, self._model.ask_all(requests), strict=True))
        return [_chosen(top, *next(answers)) if top.names else _unnamed(top) for top in tops]


def _chosen(top: TopNames, request: ChatRequest, reply: Reply) -> RefinedName:
    name = None if reply.failure else chosen_name(reply.text, top.names)
    if name is None:
        return RefinedName(top.label, "label", reason_of(reply), request.key)
    return RefinedName(name, "model", "", request.key)


def _unnamed(top: TopNames) -> RefinedName:
    return RefinedName(top.label, "label", "no view has a name")


log = logging.getLogger(__name__)
FILE_NAME = "refined_names.json"
SCHEMA = 2
Refiner = Literal["vote", "model"]


def voted_names(instances: Instances) -> RefinedNames | None:
    """Label n' by vote: among the names of the best views, the one with the greatest sum of prediction scores."""
    if instances.view_names is None or instances.view_scores is None:
        return None
    names = tuple(vote(top).name for top in top_names(instances, MAX_NAMES))
    left_out = exclusion_reasons(instances, names, FilterConfig())
    return RefinedNames(names, f"a vote over the names of {MAX_NAMES} views, no language model", left_out)


class NameRecord(BaseModel):
    """Labels n and n' of one instance, the candidates for n', and why it is excluded under n' ('' if it is not)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: int
    label: str
    refined: str
    source: Source
    reason: str
    candidates: tuple[str, ...]
    request: str
    left_out: str


class NameRecords(BaseModel):
    """Labels n' of a map and the filter that goes with them; ``prediction_sha256`` ties them to the map.

    ``model`` is empty for the vote.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: int
    prediction_sha256: str
    refiner: Refiner
    model: str
    top_m: int
    filter: FilterConfig
    names: tuple[NameRecord, ...]

    @property
    def refined(self) -> RefinedNames:
        who = f"the model {self.model}" if self.refiner == "model" else "the vote"
        return RefinedNames(
            tuple(record.refined for record in self.names),
            f"{who} of the refiner, names of {self.top_m} views",
            tuple(record.left_out for record in self.names),
        )


def records_of(
    job: JobFolder,
    instances: Instances,
    tops: Sequence[TopNames],
    refined: Sequence[RefinedName],
    refiner: Refiner,
    model: str,
    top_m: int,
    config: FilterConfig,
) -> NameRecords:
    """The records of one map, one per instance; large background objects under their label n' are excluded."""
    ids = instances.ids.tolist() if len(instances.ids) else range(len(instances))
    left_out = exclusion_reasons(instances, [name.name for name in refined], config)
    names = tuple(
        NameRecord(
            id=one_id,
            label=top.label,
            refined=name.name,
            source=name.source,
            reason=name.reason,
            candidates=top.names,
            request=name.key,
            left_out=reason,
        )
        for one_id, top, name, reason in zip(ids, tops, refined, left_out, strict=True)
    )
    return NameRecords(
        schema_version=SCHEMA,
        prediction_sha256=digest_file(job.prediction),
        refiner=refiner,
        model=model,
        top_m=top_m,
        filter=config,
        names=names,
    )


def write_records(job: JobFolder, records: NameRecords) -> Path:
    """Write the file next to the map; returns its path."""
    job.prepare()
    path = job.path / FILE_NAME
    write_json(path, records.model_dump(mode="json"))
    return path


def read_records(job: JobFolder) -> NameRecords | None:
    """Labels n' of the map, or None; ``StoreError`` if they belong to another map."""
    path = job.path / FILE_NAME
    if not path.is_file():
        return None
    try:
        content = read_json(path)
        if isinstance(content, dict) and content.get("schema_version") == 1:
            raise StoreError(f"{path}: has no filter of large background; run su3d-bench runs refine again")
        records = NameRecords.model_validate(content)
    except (ValidationError, RecursionError) as error:
        raise StoreError(f"{path}: invalid file; run su3d-bench runs refine again") from error
    if records.schema_version != SCHEMA or records.prediction_sha256 != digest_file(job.prediction):
        raise StoreError(f"{path}: does not belong to the map {job.prediction.name}; run su3d-bench runs refine again")
    return records


def refine_by_model(job: JobFolder, model: LanguageModel, config: LanguageConfig) -> None:
    """Store labels n' by the text model with a map that has names per view, unless they are there."""
    with suppress(StoreError):  # those of another map
        known = read_records(job)
        if known is not None and (known.refiner, known.model) == ("model", config.text_model):
            return
    instances = read_prediction(job.prediction)
    if isinstance(instances, Instances) and instances.view_names is not None:
        tops = top_names(instances, MAX_NAMES)
        refined = ModelRefiner(model, config).refine(tops)
        by = config.text_model, MAX_NAMES, FilterConfig()
        write_records(job, records_of(job, instances, tops, refined, "model", *by))


def refined_digest(job: JobFolder) -> dict[str, str]:
    """The digest of the file, for the key of the scores; empty if there is none."""
    path = job.path / FILE_NAME
    return {"refined": digest_file(path)} if path.is_file() else {}


def refined_names(job: JobFolder, instances: Instances) -> RefinedNames | None:
    """Labels n' of the map in ``job``; a file of another map is ignored with a warning."""
    try:
        records = read_records(job)
    except StoreError as error:
        log.warning("%s; until then, n' is the vote", error)
        records = None
    if records is None or len(records.names) != len(instances):
        return voted_names(instances)
    return records.refined
