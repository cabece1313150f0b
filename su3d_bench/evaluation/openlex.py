"""Predictions against OpenLex3D's released labels and queries, which lie beside the mesh of the dataset."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import GroundTruth, Instances, Prediction
from su3d_bench.datasets.openlex3d import (
    CATEGORIES_NAME,
    PROMPTS_NAME,
    Corners,
    Level,
    OpenLexFiles,
    categories_truth,
    queries_truth,
    replica_corners,
)
from su3d_bench.datasets.replica.folders import find_original_scene, original_name
from su3d_bench.datasets.replica.mesh_truth import read_annotated_mesh
from su3d_bench.evaluation.checks import check_cloud, empty_warnings, mask_facts
from su3d_bench.evaluation.scoring import SceneOutcome
from su3d_bench.metrics.fitness import why_not_scorable
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.metrics.scoring import QuestionTruth, score_scene
from su3d_bench.predictions.base import Content, VertexLabels, VertexMasks
from su3d_bench.questions.truths import question_truth

DATASET = "replica"  # of those that OpenLex3D labels, the one whose mesh can be read here
QUERY_LEVEL: Level = "l0"  # the level that the release evaluates unless another is asked for
VARIANTS = ("openlex3d-visible", "openlex3d-face-corners")
NO_CEILING = (
    "no ceiling is known: masks grow by the threshold, over their neighbours too, and each query's best mask has "
    "confidence 1, so that perfect masks with perfect features need not reach 1"
)

NOTHING = Instances.of(np.zeros((0, 3), np.float32), [], labels=())
NO_QUERY_CEILING = "no ceiling is known: how well perfect masks are ranked is up to the encoder"


@dataclass(frozen=True)
class OpenLexRelease:
    """OpenLex3D's text files below ``folder`` and the original release of Replica below ``data_root``."""

    folder: Path
    data_root: Path

    def scenes(self) -> tuple[str, ...]:
        """The scenes with labels, in alphabetical order."""
        return tuple(sorted(path.parent.name for path in (self.folder / DATASET).glob(f"*/{CATEGORIES_NAME}")))

    def truth(self, scene: str, variant: str) -> OpenLexTruth | QueryTruth:
        """The truth of a scene; ``GroundTruthMissing`` where one of its files is not there."""
        files = OpenLexFiles(self.folder, DATASET, scene)
        corners = _corners(self.data_root, scene)
        if variant == VARIANTS[0]:
            return categories_truth(files, corners)
        return queries_truth(files, corners, QUERY_LEVEL)


def holds_release(folder: Path) -> bool:
    """Whether a folder of ground truth is OpenLex3D's."""
    return (folder / DATASET / PROMPTS_NAME).is_file()


@lru_cache(maxsize=1)
def _corners(data_root: Path, scene: str) -> Corners:
    """The corners of a scene; the last ones are kept, because every protocol asks for them anew."""
    where = f"{DATASET}/{scene}"
    original = find_original_scene(data_root, scene)
    if original is None:
        raise GroundTruthMissing(
            f"{where}: no mesh for OpenLex3D's objects; expected {original_name(scene)}/habitat of the original "
            f"release in {data_root / 'replica_v1'}"
        )
    return replica_corners(read_annotated_mesh(original, where))


def why_not_lex_content(rules: ProtocolRules, content: Content) -> str | None:
    """Why a prediction cannot be scored under OpenLex3D's protocols; None where it can."""
    if isinstance(content, VertexMasks | VertexLabels):
        return "needs a map with points of its own, the prediction is over the points of another truth"
    reason = why_not_scorable(rules, content)
    return reason.removeprefix(f"{rules.name}: ") if reason else None


def score_on_objects(
    rules: ProtocolRules,
    truth: OpenLexTruth | QueryTruth | QuestionTruth,
    scene: str,
    content: Content,
    encoder: Encoder | None,
) -> SceneOutcome:
    """The outcome against objects with labels or queries; an empty prediction where ``content`` has no points."""
    prediction: Prediction = NOTHING if isinstance(content, VertexMasks | VertexLabels) else content
    base = truth.scene if isinstance(truth, QuestionTruth) else truth
    told = check_cloud(scene, prediction.points, base.points)
    facts = None
    if isinstance(prediction, Instances):
        facts = mask_facts(prediction, np.asarray(prediction.scores, np.float64), len(prediction.points))
        told += empty_warnings(scene, facts, prediction, prediction.names)
    if rules.kind == "queries":
        told.append(NO_CEILING if base.variant in VARIANTS else NO_QUERY_CEILING)
    return SceneOutcome(score_scene(rules, truth, prediction, encoder), None, None, facts, tuple(told))


def score_on_questions(
    rules: ProtocolRules, dataset: Any, scene: str, truth: GroundTruth, content: Content, encoder: Encoder | None
) -> SceneOutcome:
    """The outcome; labels n' are those of the vote, for a file beside a run's map is not part of a prediction."""
    return score_on_objects(rules, question_truth(rules, dataset, scene, truth), scene, content, encoder)
