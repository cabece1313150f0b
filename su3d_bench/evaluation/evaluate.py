"""Predictions made elsewhere to the numbers of the published protocols: ``evaluate``.

Scene by scene, so that only one scene's masks are in memory. Wrong input raises a ``Su3dError`` of one line before
anything is answered; what is merely doubtful goes into the result as warnings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.system.files import noted
from su3d_bench.evaluation.request import Request
from su3d_bench.evaluation.result import Evaluation, ProtocolEvaluation, some_names
from su3d_bench.evaluation.scoring import Scoring
from su3d_bench.evaluation.truth import NOT_MEANT, SceneTruths, kind_of_truth
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.predictions.base import Content
from su3d_bench.predictions.scannet_text import ScannetText
from su3d_bench.predictions.scenes import Source, open_sources

__all__ = ["Evaluation", "ProtocolEvaluation", "Request", "evaluate", "said_of"]


class Keeps(Protocol):
    """Who keeps what was read: of each scene its content, None where nothing stands for it, and the files."""

    def begin(self, truths: SceneTruths, sources: Sequence[Source], *, counts_file_confidences: bool) -> None: ...

    def keep(self, scene: str, content: Content, files: Iterable[Path], rules: Sequence[ProtocolRules]) -> None: ...


def evaluate(request: Request, kept: Keeps | None = None) -> Evaluation:
    """The numbers of ``request`` under every protocol that is named, or else that fits; ``kept`` gets each scene."""
    kind, scoring = kind_of_truth(request), Scoring(request)
    sources = open_sources(request.predictions, request.format)
    truths = kind(request, sources)
    if request.queries is not None:
        truths.take_queries(request.queries)
    if not truths.matches:
        raise PredictionError(f"{shown(request.predictions[0])}: has no prediction of a scene of {truths.where}")
    counts_confidences = _count_file_confidences(request, sources)
    scoring.begin(truths, counts_file_confidences=counts_confidences)
    if kept is not None:
        kept.begin(truths, sources, counts_file_confidences=counts_confidences)
    of_files: dict[str, list[str]] = {}
    for match in truths.matches:
        with noted() as files:
            prediction = match.source.reader.read(match.source.path, match.name)
        scoring.add(match.scene, prediction, f"{shown(match.source.path)}: {match.scene}")
        if kept is not None:
            kept.keep(match.scene, prediction.content, files, scoring.rules_of(match.scene))
        for line in prediction.remarks:
            of_files.setdefault(line, []).append(match.scene)
    with_prediction = [match.scene for match in truths.matches]
    nothing = scoring.add_missed([scene for scene in truths.scenes if scene not in with_prediction])
    for scene in truths.scenes:
        if kept is not None and scene not in with_prediction and (rules := scoring.rules_of(scene)):
            kept.keep(scene, nothing, (), rules)
    remarks = list(truths.remarks)
    for line, scenes in of_files.items():
        n = len(with_prediction)
        which = scenes[0] if len(scenes) == 1 else f"{len(scenes)} of {n} scenes ({some_names(scenes)})"
        remarks.append(f"{'every scene' if len(scenes) == n > 1 else which}: {line}")
    formats = tuple(dict.fromkeys(source.reader.name for source in sources))
    return scoring.tally.evaluation(formats, truths.where, remarks)


def said_of(result: Evaluation) -> list[str]:
    """What must be said of an evaluation: formats and truth, remarks on the files, why protocols did not score them."""
    lines = [f"format: {', '.join(result.formats)}; ground truth: {result.ground_truth}", *result.remarks]
    reasons: dict[str, list[str]] = {}
    for name, reason in result.not_scored.items():
        reasons.setdefault(reason, []).append(name)
    told = {reason: names for reason, names in reasons.items() if not reason.startswith(NOT_MEANT)}
    return lines + [f"not scored under {', '.join(names)}: {reason}" for reason, names in told.items()]


def _count_file_confidences(request: Request, sources: Sequence[Source]) -> bool:
    """Whether the confidences of the files count even where a protocol has 1 for every mask."""
    if request.confidences is not None:
        return request.confidences == "file"
    return all(source.reader.name == ScannetText.name for source in sources)
