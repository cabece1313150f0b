"""What a method of a finished run is scored on again: the truths, its maps, and what names them."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from su3d_bench.core.errors import ConfigError, DataError, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.evaluation.scoring import with_confidences_of_files
from su3d_bench.evaluation.text_truth import FilesOfTruth
from su3d_bench.evaluation.texts import GivenTexts, read_text_features
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import as_told
from su3d_bench.store.predictions import read_prediction

TruthOf = Callable[[str], GroundTruth]  # by the variant that a protocol asks for


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
