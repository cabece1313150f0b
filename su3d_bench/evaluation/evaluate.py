"""Predictions made elsewhere to the numbers of the published protocols: ``evaluate``.

Scene by scene, so that only one scene's masks are in memory. Wrong input raises a ``Su3dError`` of one line before
anything is answered; what is merely doubtful goes into the result as warnings.
"""

from __future__ import annotations

from collections.abc import Sequence

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.evaluation.request import Request
from su3d_bench.evaluation.result import Evaluation, ProtocolEvaluation
from su3d_bench.evaluation.scoring import Scoring
from su3d_bench.evaluation.truth import NOT_MEANT, kind_of_truth
from su3d_bench.predictions.scannet_text import ScannetText
from su3d_bench.predictions.scenes import Source, open_sources

__all__ = ["NOT_MEANT", "Evaluation", "ProtocolEvaluation", "Request", "evaluate"]


def evaluate(request: Request) -> Evaluation:
    """The numbers of ``request`` under every protocol that is named, or else that fits."""
    kind, scoring = kind_of_truth(request), Scoring(request)
    sources = open_sources(request.predictions, request.format)
    truths = kind(request, sources)
    if request.queries is not None:
        truths.take_queries(request.queries)
    if not truths.matches:
        raise PredictionError(f"{shown(request.predictions[0])}: has no prediction of a scene of {truths.where}")
    scoring.begin(truths, counts_file_confidences=_count_file_confidences(request, sources))
    of_files: dict[str, list[str]] = {}
    for match in truths.matches:
        prediction = match.source.reader.read(match.source.path, match.name)
        scoring.add(match.scene, prediction, f"{shown(match.source.path)}: {match.scene}")
        for line in prediction.remarks:
            of_files.setdefault(line, []).append(match.scene)
    with_prediction = [match.scene for match in truths.matches]
    scoring.add_missed([scene for scene in truths.scenes if scene not in with_prediction])
    remarks = list(truths.remarks)
    for line, scenes in of_files.items():
        is_shared = len(scenes) == len(with_prediction) > 1
        remarks += [f"every scene: {line}"] if is_shared else [f"{scene}: {line}" for scene in scenes]
    formats = tuple(dict.fromkeys(source.reader.name for source in sources))
    return scoring.tally.evaluation(formats, truths.where, remarks)


def _count_file_confidences(request: Request, sources: Sequence[Source]) -> bool:
    """Whether the confidences of the files count even where a protocol has 1 for every mask."""
    if request.confidences is not None:
        return request.confidences == "file"
    return all(source.reader.name == ScannetText.name for source in sources)
