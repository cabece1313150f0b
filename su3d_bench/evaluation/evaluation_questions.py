"""One scene's prediction from elsewhere under a protocol that asks questions: retrieval, annotation, reasoning."""

from __future__ import annotations

from typing import Any

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import GroundTruth
from su3d_bench.evaluation.openlex import score_on_objects
from su3d_bench.evaluation.scoring import SceneOutcome
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.predictions.base import Content
from su3d_bench.questions.truths import question_truth


def score_on_questions(
    rules: ProtocolRules, dataset: Any, scene: str, truth: GroundTruth, content: Content, encoder: Encoder | None
) -> SceneOutcome:
    """The outcome; labels n' are those of the vote, for a file beside a run's map is not part of a prediction."""
    return score_on_objects(rules, question_truth(rules, dataset, scene, truth), scene, content, encoder)
