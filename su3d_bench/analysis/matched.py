"""A finished run's maps matched to the ground truth again, as the evaluators of its protocols matched them.

``attribute``, ``report samples`` and the galleries of a page all go through ``matched_instances`` or
``Explained.matched``. Counts that differ from those stored in the run are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import ConfigError, DataError, PredictionError, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.evaluation.scoring import with_confidences_of_files
from su3d_bench.evaluation.text_truth import FilesOfTruth
from su3d_bench.evaluation.texts import GivenTexts, read_text_features
from su3d_bench.metrics.attribution.arrays import EXPLAINED, LookedAt, MendedScene
from su3d_bench.metrics.attribution.singles import SingleError
from su3d_bench.metrics.fitness import why_not_scorable
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import as_told
from su3d_bench.store.predictions import read_prediction

TruthOf = Callable[[str], GroundTruth]  # by the variant that a protocol asks for
MendedJob = Mapping[str, MendedScene]  # of a scene under a method, by protocol


@dataclass(frozen=True)
class Matched:
    """A scene under a method and a protocol: what was scored, and how the protocol's evaluator sees it."""

    explained: Explained
    scene: str
    rules: ProtocolRules
    truth: GroundTruth
    prediction: Prediction
    looked_at: LookedAt


def matched_instances(
    run: FinishedRun, methods: Sequence[Explained], scenes: Sequence[str]
) -> Iterator[tuple[str, Iterator[Matched]]]:
    """Scene after scene, what ``methods`` of ``run`` gave under each protocol that scored it."""
    encoder = cache(run.encoder)
    for scene in scenes:
        truth_of = cache(partial(truth_of_scene, run, scene))
        yield scene, (one for method in methods for one in method.matched(scene, truth_of, encoder))


def explained_of(run: FinishedRun, method: str, wanted: Sequence[str] = ()) -> Explained:
    """The protocols under which the errors of ``method`` are explained: those ``wanted``, else all that can be."""
    names, remarks = _protocols_of(run, wanted)
    return Explained(run, method, tuple(names), tuple(remarks))


@dataclass(frozen=True)
class Explained:
    """A method of a run, whose errors are explained under ``protocols``."""

    run: FinishedRun
    method: str
    protocols: tuple[str, ...]
    remarks: tuple[str, ...]

    @cached_property
    def _scores(self) -> Mapping[str, Mapping[str, SceneScore]]:
        return self.run.scores(self.method)

    @cached_property
    def _inputs(self) -> Inputs:
        return Inputs(self.run, self.method)

    def rules(self, protocol: str) -> ProtocolRules:
        """The rules of a protocol as they count for this method."""
        return self._inputs.rules(self.run.rules(protocol))

    def matched(self, scene: str, truth_of: TruthOf, encoder: Callable[[], Encoder]) -> Iterator[Matched]:
        """``scene`` as the evaluators of the protocols that scored it see it."""
        for name in self.scored_under(scene):
            rules = self.rules(name)
            truth, prediction = self._inputs.of_scene(scene, rules, truth_of)
            if (reason := why_not_scorable(rules, prediction)) is not None:
                raise PredictionError(f"{scene}: {reason}")
            look = EXPLAINED[rules.kind][1]
            looked_at = look(rules, truth, prediction, self._inputs.encoder(rules, prediction, encoder))
            yield Matched(self, scene, rules, truth, prediction, looked_at)

    def mended(self, scene: str, looked_at: Mapping[str, LookedAt]) -> MendedJob:
        """The counts of ``scene``, which must be those of the run, and those with its errors mended."""
        mended = {name: one.mended() for name, one in looked_at.items()}
        for name, counts in mended.items():
            self.refuse_other_counts(name, scene, counts.as_is)
        return mended

    def errors(self, scene: str, protocol: str, looked_at: LookedAt, most: int) -> tuple[int, Sequence[SingleError]]:
        """How many errors ``scene`` has under ``protocol``, and the ``most`` that cost the run most."""
        scores = self._scores[protocol]
        others = [score.counts for name, score in scores.items() if name != scene]
        return looked_at.errors(self.rules(protocol), scores[scene].counts, others, most)

    def instance_ids(self, scene: str) -> Sequence[int]:
        """How the method numbers its instances; nothing where their places are their numbers."""
        if self.run.data.truth_files is not None:
            return ()
        return getattr(self._inputs.of_map(scene), "ids", np.zeros(0, np.int64)).tolist()

    def refuse_other_counts(self, protocol: str, scene: str, formed: Counts) -> None:
        """A ``PredictionError`` where what is explained is not what the run's own number is of."""
        stored = self._scores[protocol][scene].counts
        if type(stored) is type(formed) and all(
            np.array_equal(getattr(stored, each.name), getattr(formed, each.name)) for each in fields(formed)
        ):
            return
        raise PredictionError(
            f"{printable(scene, 100)}: {protocol}: the counts of the run are not those that its prediction gives here; "
            "score it again"
        )

    def scored_under(self, scene: str) -> list[str]:
        """The protocols that scored ``scene``."""
        return [name for name in self.protocols if scene in self._scores[name]]


def _protocols_of(run: FinishedRun, wanted: Sequence[str]) -> tuple[list[str], list[str]]:
    """The protocols that can be explained, and remarks on the others; one that is named and cannot is an error."""
    for name in wanted:
        run.check_protocol(name)
    chosen, remarks = [], []
    for name in wanted or run.protocols:
        rules = run.rules(name)
        if rules.kind in EXPLAINED:
            chosen.append(name)
        elif wanted:
            raise ConfigError(f"protocol '{name}' is of kind '{rules.kind}'; only instance and semantic are explained")
        else:
            remarks.append(f"{name} is of kind {rules.kind}, which is not explained")
    if not chosen:
        raise ConfigError(f"{run.name}: was scored under no protocol of kind instance or semantic; nothing to explain")
    return chosen, remarks


def method_of(run: FinishedRun, method: str | None) -> str:
    """``method``, or the only one of the run; ``ConfigError`` where it must be named or has no scores."""
    if method is None and len(run.methods) > 1:
        raise ConfigError(f"{run.name}: holds {', '.join(run.methods)}; choose one with --method")
    chosen = method or run.methods[0]
    run.check_method(chosen)
    return chosen


def truth_of_scene(run: FinishedRun, scene: str, variant: str) -> GroundTruth:
    """The truth in the data of ``run``, which must be those that it was made from."""
    truth: GroundTruth = run.dataset(scene).ground_truth(scene.partition("/")[2], variant)
    return truth


class Inputs:
    """The truth, the maps and the encoder of a method of a run, be its predictions made here or elsewhere."""

    def __init__(self, run: FinishedRun, method: str) -> None:
        self._run, self._method = run, method
        self._files = FilesOfTruth(run)
        self.of_map = lru_cache(maxsize=1)(self._read_map)

    def rules(self, rules: ProtocolRules) -> ProtocolRules:
        """``rules`` as they count here: of files, their confidences may count where a rule has 1."""
        elsewhere = self._run.made_elsewhere.get(self._method)
        takes_files = elsewhere is not None and elsewhere.confidences == "file"
        return with_confidences_of_files(rules) if takes_files else rules

    def of_scene(self, scene: str, rules: ProtocolRules, truth_of: TruthOf) -> tuple[GroundTruth, Prediction]:
        if self._run.data.truth_files is not None:
            truth = self._files.truth(scene, rules)
            return truth, self._files.prediction(scene, self._method, rules, len(truth.points))
        truth = truth_of(rules.ground_truth)
        prediction = self.of_map(scene)
        if (part := self._run.told_truth(self._method)) is None:
            return truth, prediction
        first: str = self._run.dataset(scene).variants[0]
        return truth, as_told(part, rules, truth, prediction, lambda: truth_of(first).labels)

    def _read_map(self, scene: str) -> Prediction:
        return read_prediction(self._run.folder.job(scene, self._method).prediction)

    def encoder(self, rules: ProtocolRules, prediction: Prediction, own: Callable[[], Encoder]) -> Encoder | None:
        """What named the instances; None where they have names."""
        if getattr(prediction, "labels", None) is not None:
            return None
        elsewhere = self._run.made_elsewhere.get(self._method)
        if elsewhere is None or elsewhere.texts is None:
            return own()
        path, digest = elsewhere.texts
        given = read_text_features(Path(path))
        assert given is not None
        texts = GivenTexts(given, rules)
        if texts.digest != digest:
            raise DataError(f"{printable(path, 200)}: is not the file that {self._run.name} was scored with")
        return texts
