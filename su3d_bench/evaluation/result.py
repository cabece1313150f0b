"""Evaluation requests and results, and their JSON form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from su3d_bench.core.errors import some
from su3d_bench.metrics.compatibility import MIN_MULTI_LABEL_SHARE, labels_counted
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.instance.score import CONSTANT_CONFIDENCE
from su3d_bench.metrics.matching.checks import MaskFacts
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import ProtocolResult, combine, combined_metrics, metric_of, plain_json
from su3d_bench.predictions.base import Content

Confidences = Literal["protocol", "file"]
ValuesForm = Literal["classes", "instances", "numbers"]


@dataclass(frozen=True)
class Request:
    """What to score: ``predictions`` are folders or files, ``contents`` maps in memory by scene instead.

    ``ground_truth``: a folder of <scene>.txt in ScanNet's layout, instead of the dataset's own.
    ``ground_truth_values``: the meaning of their values, if ambiguous. ``protocols``: by default the dataset's headline
    protocol if it fits, otherwise all that fit (as with "all").
    ``scenes``: names or patterns. ``confidences``: if a protocol sets 1 for every mask, use its rule ("protocol") or
    the values in the files ("file"); None: those in the files for the formats of ScanNet's and MaskClustering's
    scripts, as these do, and the protocol's rule for all others. ``queries``: a file of texts and the objects that they
    refer to, for ``query-ap``. ``method``: the one to score of a run folder with several.
    """

    predictions: tuple[Path, ...]
    contents: Mapping[str, Content] | None = None
    dataset: str | None = None
    ground_truth: Path | None = None
    ground_truth_values: ValuesForm | None = None
    protocols: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    format: str | None = None
    text_features: Path | None = None
    confidences: Confidences | None = None
    queries: Path | None = None
    method: str | None = None


def default_name(out: Path | None) -> str:
    """The default name of predictions, used as the folder name in a run."""
    return "predictions" if out is None else out.resolve().name


SCHEMA = 1
# Names of the metrics in the file; the first ones of each kind are its headline.
KEYS = {
    "AP": "ap", "AP50": "ap50", "AP25": "ap25", "mAcc": "macc", "mIoU": "miou", "F-mIoU": "fmiou", "pAcc": "pacc",
    "recall": "acc", "precision": "precision", "IoU": "iou", "F1": "f1", "mPrecision": "mprecision", "mF1": "mf1",
}  # fmt: skip


@dataclass(frozen=True)
class SceneOutcome:
    """One scene under one protocol: counts of the prediction, of the ceiling and of every mask with every class."""

    score: SceneScore
    ceiling: SceneScore | None = None
    bound: InstanceCounts | None = None
    facts: MaskFacts | None = None
    warnings: tuple[str, ...] = ()


@dataclass
class SceneOutcomes:
    """Outcomes so far under one protocol."""

    scores: dict[str, SceneScore] = field(default_factory=dict)
    ceilings: dict[str, SceneScore | None] = field(default_factory=dict)
    bounds: list[InstanceCounts] = field(default_factory=list)
    facts: dict[str, MaskFacts] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    unscored: dict[str, str] = field(default_factory=dict)
    has_coverage: bool = False
    encoder: tuple[str, str] | None = None
    labels: str | None = None
    n_masks: int = 0
    n_several: int = 0
    n_of_class_0: int = 0

    def add(self, scene: str, outcome: SceneOutcome) -> None:
        self.scores[scene] = outcome.score
        self.ceilings[scene] = outcome.ceiling
        self.warnings += outcome.warnings
        if outcome.bound is not None:
            self.bounds.append(outcome.bound)
        if outcome.facts is not None:
            self.facts[scene] = outcome.facts


@dataclass(frozen=True)
class ProtocolEvaluation:
    """One protocol: ``result``, the ``ceiling``, and ``every_class``, the score of every mask with every class.

    ``with_ones``: the metrics with 1 for every confidence, if the protocol sets that but those in the files are used.

    ``missed`` scenes have no prediction and count as missed, ``skipped`` ones are skipped as in the original evaluator.
    ``scores`` and ``ceilings`` are by scene, ``unscored`` has a reason for each of the others; ``encoder``: name and
    digest of the encoder that classified the features. ``coverage``: by radius in metres, the share of scored points
    with a predicted point within it, None without coordinates. ``labels``: which labels count, None if none do.
    """

    rules: ProtocolRules
    result: ProtocolResult
    ceiling: Mapping[str, float] | None
    every_class: Mapping[str, float] | None
    with_ones: Mapping[str, float] | None
    coverage: Mapping[str, float] | None
    facts: Mapping[str, MaskFacts]
    missed: tuple[str, ...]
    skipped: tuple[str, ...]
    warnings: tuple[str, ...]
    scores: Mapping[str, SceneScore]
    ceilings: Mapping[str, SceneScore]
    unscored: Mapping[str, str]
    encoder: tuple[str, str] | None = None
    labels: str | None = None

    @property
    def n_duplicates(self) -> tuple[int, int]:
        """Pairs of masks with IoU above 0.9, and the identical ones among them, over all scenes."""
        scenes = self.facts.values()
        return sum(len(facts.near or ()) for facts in scenes), sum(len(facts.identical) for facts in scenes)

    @property
    def confidences(self) -> tuple[float, float] | None:
        """The lowest and highest confidence in the files; None without confidences."""
        lows = [facts.lowest_score for facts in self.facts.values() if facts.lowest_score is not None]
        highs = [facts.highest_score for facts in self.facts.values() if facts.highest_score is not None]
        return (min(lows), max(highs)) if lows else None

    @property
    def contested(self) -> float | None:
        """The fraction of masked points that are in several masks; None if no mask has points."""
        n_covered = sum(facts.n_covered for facts in self.facts.values())
        return sum(facts.n_contested for facts in self.facts.values()) / n_covered if n_covered else None

    def to_json(self) -> dict[str, Any]:
        result = self.result
        near, identical = self.n_duplicates
        confidences = self.confidences
        return {
            "version": result.version,
            "kind": self.rules.kind,
            "n_scenes": result.n_scenes,
            "metrics": _renamed({k: value for k, value in result.metrics.items() if k in self.rules.value_names}),
            "intervals": _renamed(result.intervals),
            "pooled": _renamed(result.pooled),
            "scene_mean": _renamed(result.scene_mean),
            "ceiling": None if self.ceiling is None else _renamed(self.ceiling),
            "every_mask_every_class": None if self.every_class is None else _renamed(self.every_class),
            "every_confidence_1": None if self.with_ones is None else _renamed(self.with_ones),
            "groups": {name: _renamed(values) for name, values in result.groups.items()},
            "per_class": {name: _renamed(values) for name, values in result.per_class.items()},
            "per_scene": {name: _renamed(values) for name, values in result.per_scene.items()},
            "coverage": None if self.coverage is None else plain_json(self.coverage),
            "n_predictions": dict(result.n_predictions),
            "duplicates": {"near": near, "identical": identical},
            "labels": self.labels,
            "confidences": None
            if confidences is None
            else {"min": confidences[0], "max": confidences[1], "constant": confidences[0] == confidences[1]},
            "contested_points": self.contested,
            "missed_scenes": list(self.missed),
            "skipped_scenes": list(self.skipped),
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True)
class Evaluation:
    """All protocols; ``not_scored`` has a reason for each of the others, ``remarks`` concern the files."""

    protocols: tuple[ProtocolEvaluation, ...]
    not_scored: Mapping[str, str]
    formats: tuple[str, ...]
    ground_truth: str
    remarks: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """The content of the ``--json`` file: fractions in full precision, null where undefined."""
        return {
            "schema": SCHEMA,
            "formats": list(self.formats),
            "ground_truth": self.ground_truth,
            "protocols": {protocol.result.protocol: protocol.to_json() for protocol in self.protocols},
            "not_scored": dict(self.not_scored),
            "remarks": list(self.remarks),
        }


def formed(rules: ProtocolRules, kept: SceneOutcomes, *, file_confidences: bool) -> ProtocolEvaluation:
    """The results of all scenes under one protocol."""
    result = combine(rules, kept.scores)
    ceilings = {scene: ceiling for scene, ceiling in kept.ceilings.items() if ceiling is not None}
    is_whole = len(ceilings) == len(kept.scores)
    covered = {radius: 1.0 - share for radius, share in result.coverage.items()}
    evaluation = ProtocolEvaluation(
        rules=rules,
        result=result,
        ceiling=combined_metrics(rules, ceilings) if is_whole else None,
        every_class=metric_of(rules).combine(kept.bounds) if len(kept.bounds) == len(kept.scores) else None,
        with_ones=_with_ones(rules, kept) if file_confidences else None,
        coverage=covered if kept.has_coverage else None,
        facts=kept.facts,
        missed=tuple(kept.missed),
        skipped=tuple(kept.skipped),
        warnings=(),
        scores=kept.scores,
        ceilings=ceilings,
        unscored=kept.unscored,
        encoder=kept.encoder,
        labels=kept.labels
        or labels_counted(
            rules,
            by_features=kept.encoder is not None,
            are_several=kept.n_masks > 0 and kept.n_several >= MIN_MULTI_LABEL_SHARE * kept.n_masks,
        ),
    )
    lines = [*_scene_warnings(kept), *_confidence_warnings(rules, evaluation, file_confidences), *kept.warnings]
    # for kind 'instance' already reported above, for all scenes at once
    lines += [line for line in result.warnings if not (rules.needs_instances and CONSTANT_CONFIDENCE in line)]
    return replace(evaluation, warnings=tuple(dict.fromkeys(lines)))


def _with_ones(rules: ProtocolRules, kept: SceneOutcomes) -> dict[str, float] | None:
    """The metrics with 1 for every confidence; None if the protocol does not set 1, or the files already have only 1.

    Which predictions match does not depend on confidences, but an instance matched twice takes the higher one; with 1
    for all there is no difference.
    """
    if rules.confidence != "ones":
        return None
    counts = [cast("InstanceCounts", score.counts) for score in kept.scores.values()]
    if all((of_scene.score == 1).all() for of_scene in counts):
        return None
    ones = [replace(of_scene, score=np.ones(len(of_scene.score))) for of_scene in counts]
    return metric_of(rules).combine(ones)


def _scene_warnings(kept: SceneOutcomes) -> list[str]:
    lines = []
    n = len(kept.scores) + len(kept.skipped) + len(kept.unscored)
    if kept.skipped:
        lines.append(
            f"{len(kept.skipped)} of {n} scenes have no prediction and are skipped, as in the original evaluator; "
            f"their objects do not count as missed: {some(kept.skipped, 5)}"
        )
    if kept.missed:
        lines.append(f"{len(kept.missed)} of {n} scenes have no prediction and count as missed: {some(kept.missed, 5)}")
    return lines + [f"{scene}: not scored: {why.replace(scene, '<scene>')}" for scene, why in kept.unscored.items()]


def grouped_reasons(reasons: Mapping[str, str]) -> list[str]:
    """One line for each distinct reason of ``reasons`` (by scene), with the scenes that it concerns.

    >>> grouped_reasons({"a": "x/a: no a.ply", "b": "x/b: no b.ply"})
    ['x/<scene>: no <scene>.ply (a, b)']
    """
    scenes_of: dict[str, list[str]] = {}
    for scene, reason in reasons.items():
        scenes_of.setdefault(reason.replace(scene, "<scene>"), []).append(scene)
    return [f"{line} ({some(scenes, 5)})" for line, scenes in scenes_of.items()]


def _confidence_warnings(rules: ProtocolRules, evaluation: ProtocolEvaluation, file_confidences: bool) -> list[str]:
    confidences = evaluation.confidences
    if not rules.needs_instances or not rules.confidences or confidences is None:
        return []
    if evaluation.with_ones is not None:
        shown = ", ".join(f"{name} {100 * evaluation.with_ones[name]:.1f}" for name in rules.headline)
        return [
            "the confidences in the files are used, as in the official script; numbers published under this "
            f"protocol use 1 for every mask, which gives {shown}"
        ]
    if rules.confidence == "ones" and not file_confidences:
        differ = (
            f"; those in the files ({confidences[0]:g} to {confidences[1]:g}) are ignored"
            if confidences[0] < confidences[1]
            else ""
        )
        return [f"the protocol sets all confidences to 1{differ}: AP per class is recall x (1 + precision) / 2"]
    if confidences[0] == confidences[1] and sum(facts.n_masks for facts in evaluation.facts.values()) > 1:
        return [f"{CONSTANT_CONFIDENCE} {confidences[0]:g}: AP per class is recall x (1 + precision) / 2"]
    return []


def _key(name: str) -> str:
    """The name of a metric in the file; for the k most likely classes it begins with k.

    >>> _key("mIoU"), _key("top-3 mIoU"), _key("mF1-other")
    ('miou', 'top_3_miou', 'mf1_other')
    """
    most_likely, gap, rest = name.rpartition(" ") if name.startswith("top-") else ("", "", name)
    return most_likely.replace("-", "_") + gap.replace(" ", "_") + KEYS.get(rest, rest.lower().replace("-", "_"))


def _renamed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values under their names in the file, without counts of classes."""
    plain = {_key(name): plain_json(value) for name, value in values.items()}
    return {name: value for name, value in plain.items() if not name.startswith("n_") and "conceptgraphs" not in name}
