"""Questions of a scene, from the dataset or generated from its ground truth, and the ground truth of protocols."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from su3d_bench.core.errors import FramesMissing, GroundTruthMissing
from su3d_bench.core.interfaces import Encoder, HasCompleteObjects, HasQueries
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions import score
from su3d_bench.metrics.questions.score import AnnotationTruth, PresenceTruth, RefinedNames, SolverAnswer, TrueAnswer
from su3d_bench.metrics.scoring import QuestionTruth
from su3d_bench.questions.appearance import Sight, sights
from su3d_bench.questions.chains import chain_truth
from su3d_bench.questions.generated import counted_scenes, generate_questions, presence_questions
from su3d_bench.questions.generator import accuracy_by_name, chosen, generate
from su3d_bench.questions.model import Question, new_question
from su3d_bench.questions.refining import voted_names
from su3d_bench.questions.scene_map import SceneMap, is_called, known_objects, map_of
from su3d_bench.questions.solver import BUILT_IN, MapSolver, built_in, given_answer

Refine = Callable[[Instances], RefinedNames | None]
MIN_VERTICES = 100  # ScanNet's smallest instance that counts
# The ground truth with the most classes, if it is not the first of a dataset.
FULLEST = ("scannet200-vertices",)
BOXES = "boxes"  # the ground truth that needs the fewest files
MAX_KEPT = 4  # scenes whose objects are cached: every method and protocol needs the same
_Kept = OrderedDict[tuple[int, str, str, int], tuple[Any, SceneMap]]  # keeps the dataset, whose id is in the key
_KEPT: _Kept = OrderedDict()


def has_own_queries(dataset: Any) -> bool:
    """Whether a dataset (class or object) provides questions and answers."""
    return isinstance(dataset, HasQueries)


def own_questions(dataset: Any, scene: str) -> tuple[Question, ...]:
    """The dataset's own questions about a scene, with all correct answers."""
    address = f"{dataset.name}/{scene}"
    return tuple(
        new_question(address, query.kind, query.text, query.answers, f"{dataset.name} truth")
        for query in dataset.queries(scene)
    )


def question_truth(
    rules: ProtocolRules,
    dataset: Any,
    scene: str,
    truth: GroundTruth,
    refine: Refine | None = None,
    solver: MapSolver | None = None,
) -> QuestionTruth | QueryTruth:
    """The ground truth of a scene under a protocol that asks questions.

    ``refine`` returns labels n' (default: by vote); ``solver`` answers reasoning questions (default: built-in).
    """
    assert rules.min_region_size is not None
    if rules.kind == "queries" and rules.questions == "dataset":
        return _query_truth(own_questions(dataset, scene), truth)
    if rules.kind == "annotation":
        return _annotation_truth(rules.min_region_size, truth, refine or voted_names)
    objects = scene_objects(dataset, scene, truth, rules.min_region_size)
    if rules.kind == "object-chains":
        return chain_truth(f"{dataset.name}/{scene}", truth, objects, rules.per_kind)
    if rules.presence is not None:
        over = rules.presence.counted_over
        counted = counted_scenes(over)
        asked = presence_questions(f"{dataset.name}/{scene}", truth, objects, rules.per_kind or len(objects), counted)
        return PresenceTruth(truth, asked, f"popular and adversarial by the contents of {len(counted)} built-in {over}")
    if rules.kind == "reasoning":
        return _reasoning_truth(rules, truth, objects, refine or voted_names, solver)
    if rules.questions == "dataset":
        questions = own_questions(dataset, scene)
    else:
        questions = generate(f"{dataset.name}/{scene}", objects, rules.per_kind)
    if rules.kind == "queries":
        return _query_truth(questions, truth)
    return score.RetrievalTruth(truth, tuple(_asked(question, objects) for question in questions))


def _query_truth(questions: Sequence[Question], truth: GroundTruth) -> QueryTruth:
    """The distinct texts with their answer objects, over the labelled points."""
    answers: dict[str, set[int]] = {}
    for question in questions:
        answers.setdefault(question.text, set()).update(question.answers or ())
    queries = tuple(TextQuery(text, tuple(sorted(ids))) for text, ids in answers.items())
    owner = np.where(truth.instance > 0, truth.instance, -1).astype(np.int64)
    return QueryTruth(truth.points, owner, queries, truth.variant, truth.source, truth.labels.space)


def _asked(question: Question, objects: SceneMap) -> score.TextTarget:
    answers = question.answers or ()
    by_chance = len(answers) / max(1, len(objects))
    return score.TextTarget(question.kind, question.text, answers, by_chance, accuracy_by_name(question, objects))


def scene_objects(dataset: Any, scene: str, truth: GroundTruth, min_vertices: int) -> SceneMap:
    """The objects for the questions of a scene, complete if the dataset knows them, as frames show them."""
    key = (id(dataset), scene, truth.variant, min_vertices)
    if key not in _KEPT:
        while len(_KEPT) >= MAX_KEPT:
            _KEPT.popitem(last=False)
        whole = dataset.whole_objects(scene) if isinstance(dataset, HasCompleteObjects) else None
        seen = _sights(dataset, scene, truth, min_vertices)
        _KEPT[key] = dataset, known_objects(truth, min_vertices, whole, seen)
    return _KEPT[key][1]


def _sights(dataset: Any, scene: str, truth: GroundTruth, min_vertices: int) -> Mapping[int, Sight] | None:
    """What frames show of the objects; None without frames, or if boxes do not determine which pixels are whose."""
    try:
        return None if truth.boxes is not None else sights(dataset, scene, truth, min_vertices)
    except FramesMissing:
        return None


def _annotation_truth(min_vertices: int, truth: GroundTruth, refine: Refine) -> AnnotationTruth:
    name_of = {known.id: known.name for known in known_objects(truth, min_vertices).objects}
    return AnnotationTruth(truth, tuple(name_of), lambda label, object_id: is_called(label, name_of[object_id]), refine)


def _reasoning_truth(
    rules: ProtocolRules, truth: GroundTruth, objects: SceneMap, refine: Refine, solver: MapSolver | None
) -> score.ReasoningTruth:
    questions = generate_questions(objects, n_each=rules.per_kind or len(objects) ** 2)
    known = {thing.id for thing in objects.objects}
    true = [
        TrueAnswer(
            question.text, question.kind, question.answer.value,
            tuple(sorted(set(question.answer.object_ids) & known)), question.by_chance, question.by_name,
        )
        for question in questions
    ]  # fmt: skip

    def solve(instances: Instances, encoder: Encoder | None) -> Sequence[SolverAnswer]:
        scene = map_of(instances, refine(instances))
        answers = (solver.ask if solver else built_in(encoder))(scene, [question.text for question in true])
        return [given_answer(*both, scene) for both in zip(true, answers, strict=True)]

    return score.ReasoningTruth(truth, tuple(true), solve, solver.name if solver else BUILT_IN)


def questions_of(dataset: Any, scene: str, *, per_kind: int | None = None, own: bool = True) -> tuple[Question, ...]:
    """The questions of a scene, at most ``per_kind`` of each kind.

    Raises ``GroundTruthMissing`` if the scene has no ground truth to generate them from.
    """
    if own and has_own_queries(dataset):
        return chosen(own_questions(dataset, scene), per_kind)
    objects = scene_objects(dataset, scene, fullest_truth(dataset, scene), MIN_VERTICES)
    return generate(f"{dataset.name}/{scene}", objects, per_kind)


def fullest_truth(dataset: Any, scene: str) -> GroundTruth:
    """The ground truth with the most classes; ``GroundTruthMissing`` if the dataset has none."""
    if not dataset.variants:
        raise GroundTruthMissing(f"{dataset.name}/{scene}: the dataset has no ground truth to generate questions from")
    variant = next((name for name in FULLEST if name in dataset.variants), dataset.variants[0])
    try:
        truth: GroundTruth = dataset.ground_truth(scene, variant)
    except GroundTruthMissing:
        if BOXES not in dataset.variants:
            raise
        truth = dataset.ground_truth(scene, BOXES)
    return truth
