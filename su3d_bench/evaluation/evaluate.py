"""Score external predictions with the published protocols: load, match to ground truth, score, report.

Works scene by scene, so that only one scene's masks are in memory. Invalid input raises a one-line ``Su3dError``;
doubtful input only adds warnings to the result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from su3d_bench.core.errors import ConfigError, DataError, GroundTruthMissing, PredictionError, shown, some, with_notes
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Masks
from su3d_bench.core.system.files import noted
from su3d_bench.core.types import GroundTruth
from su3d_bench.datasets.openlex3d.release import OpenLexRelease
from su3d_bench.evaluation import scoring as scene_scoring
from su3d_bench.evaluation.ground_truth import NOT_INTENDED, DatasetTruths, OpenLexTruths, SceneTruths, VertexTruth
from su3d_bench.evaluation.result import Evaluation, ProtocolEvaluation, Request, SceneOutcomes, formed, grouped_reasons
from su3d_bench.evaluation.text_ground_truth import FLAG, TextTruths
from su3d_bench.evaluation.texts import TextFeatures, encoder_for, read_text_features
from su3d_bench.metrics import compatibility
from su3d_bench.metrics.protocols.loading import ALL_PROTOCOLS, load_protocol, more_protocols_line, protocol_names
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.predictions.base import Content, ScenePrediction, VertexLabels, VertexMasks
from su3d_bench.predictions.formats import Source, memory_sources, open_sources
from su3d_bench.predictions.run_predictions import OWN_RUNS
from su3d_bench.questions.query_files import VARIANT as QUERY_OBJECTS

RANKED_BY_FILE = {"scannet-text", "maskclustering"}  # formats whose own evaluators use the confidences in the files

NOT_REQUESTED = "applies too; not requested"

__all__ = ["Evaluation", "ProtocolEvaluation", "Request", "evaluate", "warnings_of"]


class EvaluationStore(Protocol):
    """Keeps what was read: the content of each scene, None if it has none, and the files."""

    def begin(self, truths: SceneTruths, sources: Sequence[Source], *, counts_file_confidences: bool) -> None: ...

    def keep(self, scene: str, content: Content, files: Iterable[Path], rules: Sequence[ProtocolRules]) -> None: ...


def evaluate(request: Request, kept: EvaluationStore | None = None) -> Evaluation:
    """The numbers of ``request`` under every named protocol, or the default ones; ``kept`` receives each scene."""
    # Load.
    _check_values_have_texts(request, is_text=request.ground_truth is not None)
    texts = read_text_features(request.text_features)
    sources = (
        open_sources(request.predictions, request.format, request.method)
        if request.contents is None
        else memory_sources(request.contents)
    )

    # Match to ground truth.
    truths = _open_truths(request, sources)
    if request.queries is not None:
        truths.add_queries(request.queries)
    if not truths.matches:
        raise PredictionError(f"{shown(request.predictions[0])}: has no prediction for any scene of {truths.where}")

    # Score.
    file_confidences = _count_file_confidences(request, sources)
    scoring = Scoring(truths, request.protocols, texts, file_confidences=file_confidences)
    if kept is not None:
        kept.begin(truths, sources, counts_file_confidences=file_confidences)
    scenes_of_remark: dict[str, list[str]] = {}
    for match in truths.matches:
        with noted() as files:
            prediction = match.source.reader.read(match.source.path, match.name)
        scoring.add(match.scene, prediction, f"{shown(match.source.path)}: {match.scene}")
        if kept is not None:
            kept.keep(match.scene, prediction.content, files, scoring.rules_of(match.scene))
        for line in prediction.remarks:
            scenes_of_remark.setdefault(line, []).append(match.scene)
    with_prediction = {match.scene for match in truths.matches}
    missed = [scene for scene in truths.scenes if scene not in with_prediction]
    nothing = scoring.add_missed(missed)
    for scene in missed:
        if kept is not None and (rules := scoring.rules_of(scene)):
            kept.keep(scene, nothing, (), rules)

    # Report.
    remarks = [*truths.remarks, *_remarks_on_files(scenes_of_remark, len(truths.matches))]
    protocols, not_scored = scoring.results()
    formats = tuple(dict.fromkeys(source.reader.name for source in sources))
    return Evaluation(protocols, not_scored, formats, truths.where, tuple(dict.fromkeys(remarks)))


def warnings_of(result: Evaluation) -> list[str]:
    """Lines on an evaluation: formats, ground truth, remarks on the files, and why protocols did not score them."""
    lines = [f"format: {', '.join(result.formats)}; ground truth: {result.ground_truth}", *result.remarks]
    reasons: dict[str, list[str]] = {}
    for name, reason in result.not_scored.items():
        reasons.setdefault(reason, []).append(name)
    if more := reasons.pop(NOT_REQUESTED, []):
        lines.append(more_protocols_line(more))
    relevant = {reason: names for reason, names in reasons.items() if not reason.startswith(NOT_INTENDED)}
    return lines + [f"not scored under {', '.join(names)}: {reason}" for reason, names in relevant.items()]


def _open_truths(request: Request, sources: Sequence[Source]) -> SceneTruths:
    """The requested ground truth: a dataset's, or a folder of OpenLex3D labels or of text files."""
    if request.ground_truth is None:
        return DatasetTruths(request, sources)
    if OpenLexRelease.datasets_at(request.ground_truth):
        _check_values_have_texts(request, is_text=False)
        return OpenLexTruths(request, sources)
    return TextTruths(request, sources)


def _check_values_have_texts(request: Request, *, is_text: bool) -> None:
    if request.ground_truth_values is not None and not is_text:
        raise ConfigError(
            f"evaluate: {FLAG} describes the text files of --ground-truth; remove it, no text files are used here"
        )


def _count_file_confidences(request: Request, sources: Sequence[Source]) -> bool:
    """Whether confidences in the files are used where a protocol sets 1 for every mask."""
    if request.confidences is not None:
        return request.confidences == "file"
    return all(source.reader.name in RANKED_BY_FILE for source in sources)


def _remarks_on_files(scenes_of_remark: dict[str, list[str]], n: int) -> Iterable[str]:
    """Each remark with the scenes it concerns, out of ``n`` scenes with a prediction."""
    for line, scenes in scenes_of_remark.items():
        which = scenes[0] if len(scenes) == 1 else f"{len(scenes)} of {n} scenes ({some(scenes, 5)})"
        yield f"{'every scene' if len(scenes) == n > 1 else which}: {line}"


class Scoring:
    """Scores scene after scene under the named protocols, or under the dataset's headline protocol if that fits.

    ``rules`` and ``outcomes`` hold, by name, the remaining protocols and the outcomes so far; ``unfit`` has the reasons
    for the others. ``file_confidences``: use those of the files if a protocol sets 1 for every mask.
    """

    def __init__(
        self, truths: SceneTruths, named: Sequence[str], texts: TextFeatures | None, *, file_confidences: bool
    ) -> None:
        """Select the protocols that can score this ground truth; fail if a named one cannot."""
        self.rules: dict[str, ProtocolRules] = {}
        self.outcomes: dict[str, SceneOutcomes] = {}
        self.unfit: dict[str, str] = {}
        self._truths, self._texts, self._file_confidences = truths, texts, file_confidences
        own = [load_protocol(name) for name in named if name != ALL_PROTOCOLS]
        self._named = {rules.name for rules in own}
        self._headlines = () if named else truths.headlines
        self._first: Content | None = None  # the first prediction that is not empty
        if not own or ALL_PROTOCOLS in named:
            own += map(load_protocol, dict.fromkeys([*truths.headlines, *protocol_names()]))
        self._faults: list[str] = []  # reasons that are faults of the data
        for rules in {one.name: one for one in own}.values():
            reason = truths.incompatibility(rules, is_named=rules.name in self._named)
            if reason is None:
                self.rules[rules.name], self.outcomes[rules.name] = rules, SceneOutcomes()
            elif rules.name in self._named:
                raise ConfigError(f"protocol '{rules.name}' cannot score these predictions: {reason}")
            else:
                self.unfit[rules.name] = reason
        if not self.rules:
            raise ConfigError(f"no protocol can score {truths.where}; see su3d-bench protocols")

    def rules_of(self, scene: str) -> list[ProtocolRules]:
        """The protocols under which a scene has a score."""
        return [rules for name, rules in self.rules.items() if scene in self.outcomes[name].scores]

    def add(self, scene: str, prediction: ScenePrediction, where: str) -> None:
        """Score one scene; at the first non-empty one, protocols that do not fit are dropped or, if named, raise."""
        facts = scene_scoring.facts_of(prediction.content)
        if any(rules.names_masks for rules in self.rules.values()):
            facts = replace(facts, n_several=_n_under_several_labels(prediction.content))
        is_empty = isinstance(prediction.content, VertexMasks | Instances) and not len(prediction.content)
        if self._first is None and not is_empty:
            self._keep_headline(prediction, facts)
        found = {name: self._score(rules, scene, prediction, facts) for name, rules in self.rules.items()}
        reasons = {name: reason for name, reason in found.items() if reason is not None}
        for name, reason in reasons.items():
            if name in self._named or self._first is not None:
                raise PredictionError(f"{where}: {name}: {reason}")
            del self.rules[name], self.outcomes[name]
            self.unfit[name] = reason
        if not self.rules:
            # faults of the data, then the most frequent reason: files that only one protocol needs may not be used
            self._faults += filter(None, [self._fault(scene, facts)])
            count = Counter(reasons.values())
            ordered = sorted({*self._faults, *count}, key=lambda why: (why not in self._faults, -count[why], why))
            first, *others = ((why, [name for name in reasons if reasons[name] == why]) for why in ordered)
            error = PredictionError(f"{where}: none of {len(reasons)} protocols can score it: {first[0]}")
            raise with_notes(error, (f"{', '.join(names)}: {why}".removeprefix(": ") for why, names in others))
        if self._first is None and not is_empty:
            self._first = prediction.content

    def _fault(self, scene: str, facts: compatibility.ContentFacts) -> str | None:
        """Why the points of the prediction cannot be those of the ground truth."""
        if facts.n_points is None or not isinstance(self._truths, DatasetTruths):
            return None
        try:
            return compatibility.length_mismatch(facts, len(self._truths.vertices(scene, facts.n_points)))
        except GroundTruthMissing as error:
            return str(error)

    def _keep_headline(self, prediction: ScenePrediction, facts: compatibility.ContentFacts) -> None:
        """If none is named and the headline protocol fits, keep only it and those of the queries."""
        reasons = {name: self._fit(rules, prediction, facts)[0] for name, rules in self.rules.items()}
        if any(reasons.get(name, "absent") is None for name in self._headlines):
            for name, rules in list(self.rules.items()):
                if name not in self._headlines and rules.ground_truth != QUERY_OBJECTS:
                    del self.rules[name], self.outcomes[name]
                    self.unfit[name] = reasons[name] or NOT_REQUESTED

    def add_missed(self, scenes: Sequence[str]) -> Content:
        """Scenes without a prediction: skipped if the original evaluator skips them, otherwise counted as missed.

        Returns the content used as the prediction of a scene that counts as missed.
        """
        nothing = scene_scoring.empty_like(self._first)
        for name, rules in self.rules.items():
            kept = self.outcomes[name]
            if scene_scoring.skips_missing_scenes(rules):
                kept.skipped += scenes
                continue
            for scene in scenes:
                reason = self._score_content(rules, scene, nothing, None)
                if reason is not None:
                    raise DataError(f"{name}: {reason}")
                if scene not in kept.unscored:
                    kept.missed.append(scene)  # which says more than the warnings on an empty prediction
                    kept.scores[scene] = replace(kept.scores[scene], warnings=())
        return nothing

    def results(self) -> tuple[tuple[ProtocolEvaluation, ...], dict[str, str]]:
        """The results per protocol over all scenes, and the reasons why the other protocols have none."""
        not_scored = dict(self.unfit)
        protocols = []
        for name, kept in self.outcomes.items():
            rules = self.rules[name]
            if rules.names_masks and name not in self._named and 0 < kept.n_masks == kept.n_of_class_0:
                not_scored[name] = "needs classes, every mask has class 0"
            elif kept.scores:
                protocols.append(formed(rules, kept, file_confidences=self._file_confidences))
            else:
                not_scored[name] = "; ".join(grouped_reasons(kept.unscored)) or "no scene was scored"
        if not protocols:
            lines = [line for kept in self.outcomes.values() for line in grouped_reasons(kept.unscored)]
            first, *others = dict.fromkeys(lines or [not_scored[name] for name in self.outcomes])
            raise with_notes(PredictionError(f"nothing could be scored: {first}"), others)
        return tuple(protocols), dict(sorted(not_scored.items()))

    def _fit(
        self, rules: ProtocolRules, prediction: ScenePrediction, facts: compatibility.ContentFacts
    ) -> tuple[str | None, Encoder | None]:
        """The reason why a prediction does not fit the protocol, None if it does; and the encoder of its features."""
        has_points = self._truths.has_points
        if facts.form == "vertex-masks" and compatibility.needs_map(rules) and isinstance(self._truths, DatasetTruths):
            facts = replace(facts, form="instances", has_every_label=facts.has_labels, n_points=None)
        reason = compatibility.content_incompatibility(rules, facts, has_points=has_points)
        if reason is None and has_points and rules.name not in self._named and self._first is None:
            reason = compatibility.class_id_incompatibility(rules, facts)
        if reason is not None or (n_dimensions := compatibility.n_feature_dimensions(rules, facts)) is None:
            return reason, None
        encoder = encoder_for(rules, n_dimensions, self._texts, is_own=prediction.format == OWN_RUNS.name)
        return (encoder, None) if isinstance(encoder, str) else (None, encoder)

    def _score(
        self, rules: ProtocolRules, scene: str, prediction: ScenePrediction, facts: compatibility.ContentFacts
    ) -> str | None:
        """The reason why a scene cannot be scored under the protocol; None if it was."""
        reason, encoder = self._fit(rules, prediction, facts)
        if reason is not None:
            return reason
        kept = self.outcomes[rules.name]
        if encoder is not None:
            kept.encoder = encoder.name, encoder.digest
        if facts.n and (rules.n_labels or 0) > 1:
            content = prediction.content
            further = content.further if isinstance(content, VertexLabels) else getattr(content, "further_labels", None)
            given = compatibility.labels_counted(
                rules, by_features=encoder is not None, are_several=further is not None
            )
            if kept.labels not in (None, given):
                return f"gives {given} per point, but earlier scenes {kept.labels}; use the same number in all scenes"
            kept.labels = given
        kept.n_masks += facts.n
        kept.n_several += facts.n_several
        kept.n_of_class_0 += 0 if facts.class_ids is None else int((facts.class_ids == 0).sum())
        return self._score_content(rules, scene, prediction.content, encoder)

    def _score_content(self, rules: ProtocolRules, scene: str, content: Content, encoder: Encoder | None) -> str | None:
        kept, facts = self.outcomes[rules.name], scene_scoring.facts_of(content)
        try:
            truth = self._truths.of_scene(rules, scene)
            points = scene_scoring.vertices_for(rules, self._truths, scene, content)
        except GroundTruthMissing as error:
            if kept.scores or len(self._truths.scenes) > 1:
                kept.unscored[scene] = str(error)
                return None
            self._faults.append(str(error))
            return str(error)
        over = truth.points if points is None and isinstance(truth, GroundTruth) else points
        if over is not None and (reason := compatibility.length_mismatch(facts, len(over))) is not None:
            self._faults.append(reason)
            return reason
        if points is not None:
            content = scene_scoring.on_vertices(content, points, rules)
        used = scene_scoring.with_confidences_of_files(rules) if self._file_confidences else rules
        if isinstance(truth, VertexTruth):
            if (reason := compatibility.length_mismatch(facts, len(truth.values))) is not None:
                raise PredictionError(f"{scene}: {reason}")
            outcome = scene_scoring.score_on_vertices(used, truth, scene, content, encoder)
            kept.warnings += [line for line in truth.doubts if line not in kept.warnings]
        elif isinstance(truth, GroundTruth):
            outcome = scene_scoring.score_on_truth(used, truth, scene, content, encoder)
        else:
            outcome = scene_scoring.score_on_objects(used, truth, scene, content, encoder)
        kept.has_coverage = self._truths.has_points
        kept.add(scene, outcome)
        return None


def _n_under_several_labels(content: Content) -> int:
    """The number of masks that also occur with another label; 0 if there are no labels."""
    labels = content.class_numbers if isinstance(content, VertexMasks) else getattr(content, "labels", None)
    if labels is None or not isinstance(content, Masks):
        return 0
    return int(compatibility.under_several_labels(content, [*labels]).sum())
