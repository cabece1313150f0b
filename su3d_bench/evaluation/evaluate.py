"""Predictions made elsewhere to the numbers of the published protocols: ``evaluate``.

Scene by scene, so that only one scene's masks are in memory. Wrong input raises a ``Su3dError`` of one line before
anything is answered; what is merely doubtful goes into the result as warnings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core import registry
from su3d_bench.core.errors import ConfigError, DataError, GroundTruthMissing, PredictionError, shown
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import GroundTruth, Instances
from su3d_bench.evaluation.openlex import (
    VARIANTS,
    OpenLexRelease,
    holds_release,
    score_on_objects,
    score_on_questions,
    why_not_lex_content,
)
from su3d_bench.evaluation.result import Evaluation, ProtocolEvaluation, SceneOutcomes, form_evaluation
from su3d_bench.evaluation.scenes import OWN_FORMAT, Match, Source, match_scenes, open_sources, planned_scenes
from su3d_bench.evaluation.scoring import (
    SceneOutcome,
    check_length,
    n_feature_dimensions,
    nothing_like,
    score_on_truth,
    score_on_vertices,
    why_not_content,
    why_not_numbers,
)
from su3d_bench.evaluation.texts import TextFeatures, encoder_for, read_text_features
from su3d_bench.evaluation.truth import (
    TextTruth,
    choose_scenes,
    dataset_of_names,
    doubts,
    open_dataset,
    read_text_truth,
    text_scenes,
    text_variant,
)
from su3d_bench.metrics.fitness import TruthFacts, why_not_truth
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery
from su3d_bench.metrics.protocols import SHARE_KINDS, ProtocolRules, load_protocol, protocol_names
from su3d_bench.predictions.base import Content, ScenePrediction, VertexMasks
from su3d_bench.predictions.scannet_text import ScannetText
from su3d_bench.questions.files.queries import VARIANT as QUERY_OBJECTS
from su3d_bench.questions.files.queries import query_truth, read_query_file
from su3d_bench.runs.plan import data_root

__all__ = ["Evaluation", "ProtocolEvaluation", "Request", "evaluate"]


NOT_MEANT = "is not meant for"
Confidences = Literal["protocol", "file"]


@dataclass(frozen=True)
class Request:
    """What to score: ``predictions`` are folders or files; everything else may be left out.

    ``ground_truth``: a folder of <scene>.txt in ScanNet's layout, in place of the dataset's own. ``protocols``: all
    that fit where none is named. ``scenes``: names or patterns. ``confidences``: where a protocol has 1 for every mask,
    its own rule, or what the files say; None: what the files say in the official script's format, which that script
    reads as it stands, and the protocol's rule in all others. ``queries``: a file of texts and the objects that they
    speak of, for ``query-ap``.
    """

    predictions: tuple[Path, ...]
    dataset: str | None = None
    ground_truth: Path | None = None
    protocols: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    format: str | None = None
    text_features: Path | None = None
    confidences: Confidences | None = None
    queries: Path | None = None


@dataclass
class _Ground:
    """The truth of every scene: ``text`` without coordinates, OpenLex3D's ``lex``, or ``dataset``, read when asked."""

    where: str
    dataset_name: str | None
    scenes: tuple[str, ...]
    text: TextTruth | None = None
    files: Mapping[str, Path] = field(default_factory=dict)
    dataset: Any = None
    lex: OpenLexRelease | None = None
    queries: Mapping[str, tuple[TextQuery, ...]] | None = None
    _kept: dict[tuple[str, str], GroundTruth] = field(default_factory=dict)

    def truth(self, scene: str, variant: str) -> GroundTruth:
        if (scene, variant) not in self._kept:
            self._kept = {key: one for key, one in self._kept.items() if key[0] == scene}
            self._kept[scene, variant] = self.dataset.ground_truth(scene, variant)
        return self._kept[scene, variant]

    def query_truth(self, scene: str) -> QueryTruth:
        """The queries of a scene over its objects; ``GroundTruthMissing`` where the file has none of this scene."""
        assert self.queries is not None
        if scene not in self.queries:
            raise GroundTruthMissing(f"{self.where}/{scene}: the file of queries has none of this scene")
        truth = self.truth(scene, self.dataset.variants[0])
        return query_truth(truth, self.queries[scene], f"{self.where}/{scene}")


def evaluate(request: Request) -> Evaluation:
    """The numbers of ``request`` under every protocol that is named, or else that fits."""
    sources = open_sources(request.predictions, request.format)
    texts = None if request.text_features is None else read_text_features(request.text_features)
    ground, matches, remarks = _open_ground(request, sources)
    if request.queries is not None:
        if ground.dataset is None or not ground.dataset.variants:
            raise ConfigError("evaluate: --queries needs the objects of a dataset; name one with --dataset")
        ground.queries = read_query_file(request.queries)
    if not matches:
        raise PredictionError(f"{shown(request.predictions[0])}: has no prediction of a scene of {ground.where}")
    candidates, unfit = _candidates(request, ground)
    scoring = _Scoring(ground, texts, {one.name: one for one in candidates}, dict(unfit))
    scoring.uses_file_confidences = _uses_file_confidences(request, sources)
    of_files: dict[str, list[str]] = {}
    for match in matches:
        prediction = match.source.reader.read(match.source.path, match.name)
        scoring.add(match, prediction, is_named=bool(request.protocols))
        for one in prediction.remarks:
            of_files.setdefault(one, []).append(match.scene)
    for line, scenes in of_files.items():
        is_shared = len(scenes) == len(matches) > 1
        remarks += [f"every scene: {line}"] if is_shared else [f"{scene}: {line}" for scene in scenes]
    with_prediction = [match.scene for match in matches]
    scoring.add_missed([scene for scene in ground.scenes if scene not in with_prediction])
    formats = tuple(dict.fromkeys(source.reader.name for source in sources))
    return form_evaluation(
        scoring.rules,
        scoring.outcomes,
        scoring.unfit,
        formats,
        ground.where,
        remarks,
        file_confidences=scoring.uses_file_confidences,
    )


def _uses_file_confidences(request: Request, sources: Sequence[Source]) -> bool:
    """Whether the confidences of the files count even where a protocol has 1 for every mask."""
    if request.confidences is not None:
        return request.confidences == "file"
    return all(source.reader.name == ScannetText.name for source in sources)


def _open_ground(request: Request, sources: Sequence[Source]) -> tuple[_Ground, list[Match], list[str]]:
    """The truth, the prediction of each scene that has one, and remarks."""
    names = [name for source in sources for name in source.scenes]
    if request.ground_truth is not None:
        is_lex = holds_release(request.ground_truth)
        return _open_lex(request, sources) if is_lex else _open_text(request, sources)
    of_names = {name.partition("/")[0] for name in names if "/" in name}
    dataset_name = request.dataset or (of_names.pop() if len(of_names) == 1 else None)
    if dataset_name is None:
        hint = dataset_of_names(names)
        what = f"--dataset {hint}" if hint else "--dataset NAME"
        raise ConfigError(f"evaluate: against which ground truth? name one with {what} or --ground-truth DIR")
    dataset = open_dataset(dataset_name)
    dataset_name = str(dataset.name)
    known = list(dataset.scenes())
    asked = choose_scenes(request.scenes, known, dataset_name) if _are_all(request.scenes, known) else []
    matches, remarks = match_scenes(sources, known, dataset_name, dataset_name, asked)
    matched = [match.scene for match in matches]
    if request.scenes:
        scenes = choose_scenes(request.scenes, list(dict.fromkeys([*known, *matched])), dataset_name)
    else:
        planned = planned_scenes(sources, dataset_name)
        are_single = all(_is_of_one_scene(source.path) for source in sources)
        scenes = matched if are_single else [*dict.fromkeys([*matched, *(known if planned is None else planned)])]
    ground = _Ground(dataset_name, dataset_name, tuple(scenes), dataset=dataset)
    return ground, [match for match in matches if match.scene in scenes], remarks


def _is_of_one_scene(path: Path) -> bool:
    """Whether a path stands for its scene alone: a file, or the folder of one method and scene in a run."""
    return path.is_file() or (path / "prediction.npz").is_file()


def _are_all(asked: Sequence[str], known: Sequence[str]) -> bool:
    """Whether every one of ``asked`` names a scene of the list, and not one that is made on demand."""
    return bool(asked) and all(word.rpartition("/")[2] in known for word in asked)


def _open_lex(request: Request, sources: Sequence[Source]) -> tuple[_Ground, list[Match], list[str]]:
    assert request.ground_truth is not None
    release = OpenLexRelease(request.ground_truth, data_root())
    where, known = shown(request.ground_truth), release.scenes()
    scenes = choose_scenes(request.scenes, known, where) if request.scenes else known
    matches, remarks = match_scenes(sources, known, None, where, scenes if request.scenes else ())
    ground = _Ground(where, None, tuple(scenes), lex=release)
    return ground, [match for match in matches if match.scene in scenes], remarks


def _open_text(request: Request, sources: Sequence[Source]) -> tuple[_Ground, list[Match], list[str]]:
    assert request.ground_truth is not None
    files = text_scenes(request.ground_truth)
    where = shown(request.ground_truth)
    if request.scenes:
        files = {scene: files[scene] for scene in choose_scenes(request.scenes, list(files), where)}
    name = dataset_of_names(files)
    if request.dataset is not None:
        name = str(registry.load("dataset", request.dataset).name)
    chosen = _only_chosen(sources, request, files)
    matches, remarks = match_scenes(chosen, list(files), name, where, list(files) if request.scenes else ())
    truth = read_text_truth({match.scene: files[match.scene] for match in matches})
    return _Ground(where, name, tuple(files), text=truth, files=files), matches, remarks


def _only_chosen(sources: Sequence[Source], request: Request, files: Mapping[str, Path]) -> list[Source]:
    """The sources, without the scenes that ``--scenes`` leaves out."""
    if not request.scenes or request.ground_truth is None:
        return list(sources)
    left_out = set(text_scenes(request.ground_truth)) - set(files)
    return [Source(one.path, one.reader, tuple(n for n in one.scenes if n not in left_out)) for one in sources]


def _candidates(request: Request, ground: _Ground) -> tuple[list[ProtocolRules], dict[str, str]]:
    """The protocols that may score this truth, and why others cannot; named ones that cannot are an error."""
    if not request.protocols and ground.dataset_name is None and ground.lex is None:
        raise ConfigError(
            f"{ground.where}: whose labels are these? name the protocol with --protocol or the dataset with --dataset"
        )
    names = list(dict.fromkeys(request.protocols)) or protocol_names()
    fitting, unfit = [], {}
    for name in names:
        rules = load_protocol(name)
        reason = _why_not_truth(rules, ground, is_named=bool(request.protocols))
        if reason is None:
            fitting.append(rules)
        elif request.protocols:
            raise ConfigError(f"protocol '{rules.name}' cannot score these predictions: {reason}")
        else:
            unfit[rules.name] = reason
    if not fitting:
        raise ConfigError(f"no protocol scores {ground.where}; see su3d-bench protocols")
    return fitting, unfit


def _why_not_truth(rules: ProtocolRules, ground: _Ground, *, is_named: bool) -> str | None:
    if ground.lex is not None:
        return None if rules.ground_truth in VARIANTS else f"{NOT_MEANT} the labels of OpenLex3D"
    if rules.ground_truth == QUERY_OBJECTS:
        if ground.queries is not None:
            return None
        return "needs --queries FILE" if is_named else f"{NOT_MEANT} scenes without queries"
    if ground.dataset is not None:
        if not is_named and (ground.dataset_name not in rules.datasets or not rules.by_default):
            return f"{NOT_MEANT} {ground.dataset_name} unless it is named"
        return why_not_truth(rules, TruthFacts.of_dataset(ground.dataset))
    assert ground.text is not None
    if rules.kind in SHARE_KINDS:
        return "needs the objects of a dataset; name one with --dataset" if is_named else f"{NOT_MEANT} texts"
    if rules.kind == "instance" and not ground.text.has_instances:
        return "needs instances, the ground truth holds class ids alone (expected class id * 1000 + instance)"
    if is_named:
        return None
    if ground.dataset_name not in rules.datasets:
        return f"{NOT_MEANT} {ground.dataset_name}"
    variant = text_variant(ground.text, rules.label_space)
    return None if variant in {None, rules.ground_truth} else f"the labels of the ground truth are '{variant}'"


class _Scoring:
    """Outcomes of scene after scene under the protocols that are still in."""

    def __init__(
        self, ground: _Ground, texts: TextFeatures | None, rules: dict[str, ProtocolRules], unfit: dict[str, str]
    ) -> None:
        self.rules = rules
        self.unfit = unfit
        self.outcomes: dict[str, SceneOutcomes] = {name: SceneOutcomes() for name in rules}
        self.uses_file_confidences = False
        self._ground = ground
        self._texts = texts
        self._first: Content | None = None

    def add(self, match: Match, prediction: ScenePrediction, *, is_named: bool) -> None:
        """Score one scene; at the first that is not empty, protocols that do not fit go out or, when named, raise."""
        reasons: dict[str, str] = {}
        for rules in list(self.rules.values()):
            reason = self._score(rules, match, prediction, is_named=is_named)
            if reason is not None:
                reasons[rules.name] = reason
        where = f"{shown(match.source.path)}: {match.scene}"
        for name, reason in reasons.items():
            if is_named or self._first is not None:
                raise PredictionError(f"{where}: {name}: {reason}")
            self.unfit[name] = reason
            del self.rules[name], self.outcomes[name]
        if not self.rules:
            first, *others = dict.fromkeys(reasons.values())
            more = f" (and {len(others)} more reasons)" if others else ""
            raise PredictionError(f"{where}: none of {len(reasons)} protocols can score it: {first}{more}")
        if self._first is None and not _is_empty(prediction.content):
            self._first = prediction.content

    def _score(self, rules: ProtocolRules, match: Match, prediction: ScenePrediction, *, is_named: bool) -> str | None:
        """The reason why a scene cannot be scored under the protocol; None where it was."""
        content = prediction.content
        has_points = self._ground.text is None
        if self._ground.lex is not None or rules.ground_truth == QUERY_OBJECTS or rules.kind in SHARE_KINDS:
            reason = why_not_lex_content(rules, content)
        else:
            reason = why_not_content(rules, content, has_points=has_points)
        if reason is None and has_points and not is_named and self._first is None:
            reason = why_not_numbers(rules, content)
        if reason is not None:
            return reason
        encoder: Encoder | None = None
        n_dimensions = n_feature_dimensions(rules, content)
        if n_dimensions is not None:
            found = encoder_for(rules, n_dimensions, self._texts, is_own=prediction.format == OWN_FORMAT)
            if isinstance(found, str):
                return found
            encoder = found
        return self._score_content(rules, match.scene, content, encoder)

    def _score_content(self, rules: ProtocolRules, scene: str, content: Content, encoder: Encoder | None) -> str | None:
        kept = self.outcomes[rules.name]
        outcome: SceneOutcome
        if self._ground.text is not None:
            check_length(scene, content, len(self._ground.text.values[scene]))
            outcome = score_on_vertices(self._used(rules), self._ground.text, scene, content, encoder)
            kept.warnings += [line for line in doubts(rules, self._ground.text) if line not in kept.warnings]
        else:
            try:
                found = self._on_points(rules, scene, content, encoder)
            except GroundTruthMissing as error:
                if kept.scores or len(self._ground.scenes) > 1:
                    kept.unscored[scene] = str(error)
                    return None
                return str(error)
            if isinstance(found, str):
                return found
            outcome, kept.has_coverage = found, True
        kept.add(scene, outcome)
        return None

    def _on_points(
        self, rules: ProtocolRules, scene: str, content: Content, encoder: Encoder | None
    ) -> SceneOutcome | str:
        """The outcome against a truth with coordinates, or the reason why there is none."""
        if self._ground.lex is not None:
            return score_on_objects(rules, self._ground.lex.truth(scene, rules.ground_truth), scene, content, encoder)
        if rules.ground_truth == QUERY_OBJECTS:
            return score_on_objects(rules, self._ground.query_truth(scene), scene, content, encoder)
        truth = self._ground.truth(scene, rules.ground_truth)
        if rules.kind in SHARE_KINDS:
            return score_on_questions(rules, self._ground.dataset, scene, truth, content, encoder)
        try:
            check_length(scene, content, len(truth.points))
        except PredictionError as error:
            return str(error).removeprefix(f"{scene}: ")
        return score_on_truth(self._used(rules), truth, scene, content, encoder)

    def _used(self, rules: ProtocolRules) -> ProtocolRules:
        changes = self.uses_file_confidences and rules.kind == "instance" and rules.confidence == "ones"
        return rules.model_copy(update={"confidence": "prediction"}) if changes else rules

    def add_missed(self, scenes: Sequence[str]) -> None:
        """Scenes without a prediction: left out where the original leaves them out, otherwise counted as missed."""
        nothing = nothing_like(self._first)
        text = self._ground.text
        if text is not None and not all(skips_missing_scenes(rules) for rules in self.rules.values()):
            self._ground.text = text.with_scenes({scene: self._ground.files[scene] for scene in scenes})
        for rules in self.rules.values():
            kept = self.outcomes[rules.name]
            if skips_missing_scenes(rules):
                kept.skipped += scenes
                continue
            for scene in scenes:
                reason = self._score_content(rules, scene, nothing, None)
                if reason is not None:
                    raise DataError(f"{rules.name}: {reason}")
                if scene not in kept.unscored:
                    kept.missed.append(scene)


def _is_empty(content: Content) -> bool:
    return isinstance(content, VertexMasks | Instances) and not len(content)


def skips_missing_scenes(rules: ProtocolRules) -> bool:
    """Whether the original leaves scenes without a prediction out, so that their objects never count as missed.

    evaluate_semantic_instance.py, evaluate_semantic_label.py and those made after them walk the prediction files.
    """
    return rules.metric == "scannet" and rules.name in protocol_names() and "rooms" not in rules.name
