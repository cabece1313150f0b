"""The questions of one scene of a dataset: its own knowledge where it has some, else made from its ground truth."""

from __future__ import annotations

from typing import Any

from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.questions.colours import colour_words
from su3d_bench.questions.generator import chosen, generate
from su3d_bench.questions.known_objects import known_objects
from su3d_bench.questions.model import Question
from su3d_bench.questions.truths import has_own_queries, own_questions

MIN_VERTICES = 100  # ScanNet's smallest instance that counts
# The truth with the most classes, where it is not the first that a dataset gives.
FULLEST = ("scannet200-vertices",)


def questions_of(
    dataset: Any, scene: str, *, per_kind: int | None = None, own: bool = True, colours: bool = False
) -> tuple[Question, ...]:
    """The questions of a scene, ``per_kind`` at most of each kind; ``colours``: look up those of objects in its frames.

    Raises ``GroundTruthMissing`` where the scene has no truth to make them from.
    """
    if own and has_own_queries(dataset):
        return chosen(own_questions(dataset, scene), per_kind)
    if not dataset.variants:
        raise GroundTruthMissing(f"{dataset.name}/{scene}: the dataset has no ground truth to make questions from")
    variant = next((name for name in FULLEST if name in dataset.variants), dataset.variants[0])
    truth = dataset.ground_truth(scene, variant)
    words = colour_words(dataset, scene, truth, MIN_VERTICES) if colours else None
    return generate(f"{dataset.name}/{scene}", known_objects(truth, MIN_VERTICES, words), per_kind)
