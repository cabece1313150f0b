"""Drafts of the items to judge, before shuffling and rendering; methods with the same result share one draft.

Texts and names do not reveal the method: letters replace the ids of its map.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import Float32Array, GroundTruth
from su3d_bench.human_eval.answers import LABELS
from su3d_bench.human_eval.items import RIGHT, WRONG, SheetKind
from su3d_bench.human_eval.sources import RunSource, mask_digest
from su3d_bench.metrics.instance.score import CoveredObjects
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions import score
from su3d_bench.metrics.questions.score import TrueAnswer
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.questions import ground_truths, model
from su3d_bench.questions.generator import chosen, generate
from su3d_bench.questions.model import REASONING, Answer, Question, question_id
from su3d_bench.questions.scene_map import MapObject, SceneMap
from su3d_bench.questions.solver import AskMap, LanguageSolver, given_answer

UNKNOWN = "something unknown"  # replaces an id that the map does not have


def without_ids(text: str, scene: SceneMap, spoken_of: Sequence[int]) -> tuple[str, dict[int, str]]:
    """``text`` with object ids replaced by names, and the names, including those of the ids ``spoken_of``.

    Objects with the same name get letters in order of appearance.
    """
    numbers = {int(digits) for digits in re.findall(r"\d{1,18}", text)}
    written = [thing for thing in scene.objects if thing.id in numbers]
    forms = [
        rf"(?:{re.escape(_plain(thing))}\s+)?(?:{_called(str(thing.id))}|\b(?:object|item|thing)\s+{thing.id}(?!\d))"
        for thing in sorted(written, key=lambda thing: (-len(thing.name), -thing.id))
    ]
    calls = re.compile("|".join([*forms, _called(r"\d+")]), re.IGNORECASE)

    def id_of(match: re.Match[str]) -> int:
        return int(re.findall(r"\d+", match[0])[-1])

    known = set(scene.ids)
    in_order = dict.fromkeys((*map(id_of, calls.finditer(text)), *spoken_of))
    names = _names([scene.by_id(number) for number in in_order if number in known])
    return calls.sub(lambda match: names.get(id_of(match), UNKNOWN), text), names


def _called(number: str) -> str:
    """A pattern for an id: ``#12`` as in the built-in solver, ``ID 12`` or ``(ID: 12)`` as in language models."""
    return rf"\(\s*IDs?\b\s*[:=#]?\s*{number}\s*\)|(?:#|\bIDs?\b\s*[:=#]?\s*){number}(?!\d)"


def _names(things: Sequence[MapObject]) -> dict[int, str]:
    """Object id -> name."""
    plain = {thing.id: _plain(thing) for thing in things}
    shared = {name for name, n in Counter(plain.values()).items() if n > 1}
    n_before: Counter[str] = Counter()
    names = {}
    for number, name in plain.items():
        names[number] = f"{name} {_letter(n_before[name])}" if name in shared else name
        n_before[name] += 1
    return names


def _plain(thing: MapObject) -> str:
    return thing.name or "object"


def _letter(k: int) -> str:
    return chr(ord("A") + k) if k < 26 else str(k + 1)


MAX_TEXT = 1000  # characters of a query, a label or an answer that a sheet shows
NO_LABEL = "(no label)"
NO_ANSWER = "(no answer)"
HINT = re.compile(r"; did you mean '[^']*'\?")  # only useful to users who can ask again


@dataclass(frozen=True)
class Draft:
    """An item without number and picture; ``rows`` of the map of ``methods[0]`` are outlined, ``others`` drawn too.

    ``title``: lines of the picture; ``text``: text on the sheet; ``names`` (K): names of the map's instances in the
    answer, '' if not mentioned. ``points`` (M, 3) m: the retrieved points of a map without instances, used as
    row 0.
    """

    kind: SheetKind
    scene: str
    methods: tuple[str, ...]
    instance_ids: tuple[int, ...]
    rows: tuple[int, ...] = ()
    title: tuple[str, ...] = ()
    text: str = ""
    asks: tuple[str, ...] = ()
    question_id: str = ""
    question_kind: str = ""
    represents: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    automatic: Mapping[str, str] = field(default_factory=dict)
    others: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    points: Float32Array | None = field(default=None, compare=False)


def judged(is_right: bool) -> str:
    return RIGHT if is_right else WRONG


def questions_of(
    source: RunSource,
    scene: str,
    given: Sequence[Question] | None,
    per_kind: int | None,
) -> list[Question]:
    """The questions of four kinds for a scene: those ``given``, otherwise generated from its ground truth."""
    if given is None:
        rules, truth = _known_truth(source, scene, "retrieval")
        dataset, name = source.run.dataset(scene), scene.partition("/")[2]
        if rules.questions == "dataset":
            given = ground_truths.own_questions(dataset, name)
        else:
            assert rules.min_region_size is not None
            given = generate(scene, ground_truths.scene_objects(dataset, name, truth, rules.min_region_size))
    mine = [one for one in given if one.scene == scene and one.kind in model.KINDS]
    return list(chosen(mine, per_kind))


def _known_truth(source: RunSource, scene: str, kind: str) -> tuple[ProtocolRules, GroundTruth]:
    """The ground truth from which questions of a kind are generated, and its rules."""
    rules = source.rules(scene, kind)
    truth = source.truth(scene, rules)
    if rules is None or truth is None:
        raise ConfigError(
            f"{printable(scene, 100)}: no ground truth to generate questions from; pass a question "
            "file with --questions FILE or use --questions paper"
        )
    return rules, truth


def retrieval_drafts(source: RunSource, scene: str, questions: Sequence[Question], encoder: Encoder) -> list[Draft]:
    """For each question, one draft per distinct top-ranked result, with all methods that return it.

    The result is the most similar instance or, for a map of features only, the points of ``retrieved_points``.
    """
    rules = source.rules(scene, "retrieval")
    texts = [question.text for question in questions]
    every = {method: _firsts(source.prediction(scene, method), texts, encoder) for method in source.methods}
    firsts = {method: found for method, found in every.items() if found is not None}
    objects = {method: source.covered(scene, rules, found.a_map) for method, found in firsts.items()}
    drafts = []
    for place, question in enumerate(questions):
        groups: dict[bytes, list[str]] = {}
        for method, found in firsts.items():
            groups.setdefault(mask_digest(found.a_map, [found.rows[place]]), []).append(method)
        for methods in groups.values():
            first, covered = firsts[methods[0]], objects[methods[0]]
            row = first.rows[place]
            automatic = {}
            if covered is not None and question.is_known:
                query = score.TextTarget(question.kind, question.text, question.answers or ())
                is_right = score.judge_retrieval(covered.main_object, np.array([row]), [query])
                automatic = {"retrieval": judged(bool(is_right[0]))}
            drafts.append(
                Draft(
                    kind="retrieval",
                    scene=scene,
                    methods=tuple(methods),
                    instance_ids=tuple(firsts[name].id_at(place) for name in methods),
                    rows=(0,) if first.uses_points else (row,),
                    title=(f"Is this: {question.text}?",),
                    text=printable(question.text, MAX_TEXT),
                    asks=("retrieval",),
                    question_id=question.id,
                    question_kind=question.kind,
                    automatic=automatic,
                    points=first.a_map.points[first.a_map.mask(row)] if first.uses_points else None,
                )
            )
    return drafts


@dataclass(frozen=True)
class _Firsts:
    """Results of a map: the row of ``a_map`` for each question, or the retrieved points if it has features only."""

    a_map: Instances
    rows: tuple[int, ...]
    uses_points: bool

    def id_at(self, place: int) -> int:
        """The id of the instance that answers a question; -1 for points."""
        return -1 if self.uses_points else id_of(self.a_map, self.rows[place])


def _firsts(prediction: Prediction, texts: Sequence[str], encoder: Encoder) -> _Firsts | None:
    """The result of a map for each text; None for an empty map."""
    if not len(prediction.points):
        return None
    if isinstance(prediction, DenseFeatures):
        return _Firsts(model.retrieved_points(prediction, texts, encoder), tuple(range(len(texts))), True)
    assert isinstance(prediction, Instances)
    if not len(prediction):
        return None
    ranked = model.rank_all(prediction, texts, encoder)
    return _Firsts(prediction, tuple(int(ranking.order[0]) for ranking in ranked), False)


def annotation_drafts(source: RunSource, scene: str, n_most: int, random: np.random.Generator) -> list[Draft]:
    """At most ``n_most`` instances per scene, sampled with ``random``, with labels n and n' in random order.

    Methods take turns regardless of their instance counts. Instances excluded by the filter of labels n' only have
    label n.
    """
    rules = source.rules(scene, "annotation")
    truth = source.truth(scene, rules)
    draft_of: dict[bytes, Draft] = {}
    for method in source.methods:
        instances = source.instances(scene, method)
        judge = _annotation_judge(source, scene, rules, truth, instances)
        own, refined = score.labels_n(instances), source.refined(scene, method)
        for row in range(len(instances)):
            labels = [own[row], *([refined.names[row]] if refined is not None and refined.is_kept[row] else [])]
            names = [printable(label, MAX_TEXT) or NO_LABEL for label in labels]
            key = mask_digest(instances, [row]) + "\0".join(names).encode()
            if key in draft_of:
                draft_of[key] = also(draft_of[key], method, id_of(instances, row))
            else:
                draft_of[key] = Draft(
                    kind="annotation",
                    scene=scene,
                    methods=(method,),
                    instance_ids=(id_of(instances, row),),
                    rows=(row,),
                    title=tuple(names),
                    automatic=judge(row, names),
                )
    drafts = list(draft_of.values())
    kept = sorted(_in_turn(drafts, source.methods, random.permutation(len(drafts)).tolist())[:n_most])
    return [_with_labels_shuffled(drafts[k], random) for k in kept]


def _in_turn(drafts: Sequence[Draft], methods: Sequence[str], order: Sequence[int]) -> list[int]:
    """``order`` rearranged so that methods contribute drafts in turn while they have any left."""
    mine = {method: deque(k for k in order if method in drafts[k].methods) for method in methods}
    taken: dict[int, None] = {}
    while any(mine.values()):
        for left in mine.values():
            while left and left[0] in taken:
                left.popleft()
            if left:
                taken[left.popleft()] = None
    return list(taken)


def _with_labels_shuffled(draft: Draft, random: np.random.Generator) -> Draft:
    """The draft with labels n and n' as labels 1 and 2 in random order; equal labels are shown once."""
    meant: dict[str, list[str]] = {}
    for name, what in zip(draft.title, LABELS, strict=False):
        meant.setdefault(name, []).append(what)
    order = random.permutation(len(meant))
    names = [list(meant)[k] for k in order]
    represents = {f"label {k + 1}": tuple(meant[name]) for k, name in enumerate(names)}
    automatic = {ask: draft.automatic[what[0]] for ask, what in represents.items() if what[0] in draft.automatic}
    if "merging" in draft.automatic:
        automatic["merging"] = draft.automatic["merging"]
    lines = tuple(f"Label {k + 1}: {name}" for k, name in enumerate(names))
    draft = replace(draft, title=lines, text="\n".join(lines), asks=(*represents, "merging"))
    return replace(draft, represents=represents, automatic=automatic)


Judge = Callable[[int, Sequence[str]], Mapping[str, str]]


def _annotation_judge(
    source: RunSource, scene: str, rules: ProtocolRules | None, truth: GroundTruth | None, instances: Instances
) -> Judge:
    """Ground-truth judgements ``n``, ``n'`` and ``merging`` of an instance; those without ground truth are omitted."""
    covered = source.covered(scene, rules, instances)
    if covered is None or rules is None or truth is None or rules.merging is None:
        return lambda row, names: {}
    known: Any = ground_truths.question_truth(rules, source.run.dataset(scene), scene.partition("/")[2], truth)
    merges, main = score.judge_merging(rules.merging, covered), covered.main_object

    def judge(row: int, names: Sequence[str]) -> Mapping[str, str]:
        if int(main[row]) not in known.object_ids:
            return {}
        labelled = zip(LABELS, names, strict=False)
        labels = {what: judged(known.is_called(name, int(main[row]))) for what, name in labelled}
        return {**labels, "merging": merges[row]}

    return judge


def also(draft: Draft, method: str, instance_id: int) -> Draft:
    """The draft with one more method; unchanged if the method is already listed."""
    if method in draft.methods:
        return draft
    return replace(draft, methods=(*draft.methods, method), instance_ids=(*draft.instance_ids, instance_id))


def id_of(instances: Instances, row: int) -> int:
    return int(instances.ids[row]) if len(instances.ids) else row


def requests_into(requests: list[ChatRequest], client: LanguageModel, config: LanguageConfig) -> AskMap:
    """Collect the requests to a language model in ``requests`` without sending them."""

    def ask(scene: SceneMap, questions: Sequence[str]) -> Sequence[Answer]:
        solver = LanguageSolver(scene, client, config)
        requests.extend(solver.request(question) for question in questions)
        return [model.undecided("not asked")] * len(questions)

    return ask


def reasoning_drafts(
    source: RunSource, scene: str, given: Sequence[Question] | None, per_kind: int, ask: AskMap
) -> list[Draft]:
    """The answers about each map; maps with the same answer share one draft.

    Uses the ``given`` questions of kind ``reasoning``, otherwise ``per_kind`` generated from the ground truth for each
    template.
    """
    rules = source.rules(scene, "reasoning")
    asked: Sequence[Question | TrueAnswer] = (
        _known(source, scene, per_kind)
        if given is None
        else [question for question in given if question.scene == scene and question.kind == REASONING]
    )
    groups: dict[bytes, Draft] = {}
    for method in source.methods:
        instances, a_map = source.instances(scene, method), source.scene_map(scene, method)
        covered = source.covered(scene, rules, instances) if given is None else None
        row_of = {thing.id: thing.row for thing in a_map.objects}
        for one, answer in zip(asked, ask(a_map, [one.text for one in asked]), strict=True):
            rows = [row_of[object_id] for object_id in answer.object_ids]
            instance_id = id_of(instances, rows[0]) if len(rows) == 1 else -1
            shown, names = without_ids(reply(answer), a_map, (*answer.object_ids, *answer.reference_ids))
            key = one.text.encode() + b"\0" + shown.encode() + mask_digest(instances, rows)
            if key in groups:
                groups[key] = also(groups[key], method, instance_id)
                continue
            asks = ("answer", "objects") if rows else ("answer",)
            automatic: Mapping[str, str] = {}
            if covered is not None and rules is not None and isinstance(one, TrueAnswer):
                automatic = _judged_answer(rules, one, given_answer(one, answer, a_map), covered)
            draft = Draft(
                kind="reasoning",
                scene=scene,
                methods=(method,),
                instance_ids=(instance_id,),
                text=f"{printable(one.text, MAX_TEXT)}\nAnswer: {printable(shown, MAX_TEXT)}",
                asks=asks,
                question_id=question_id(scene, REASONING, one.text),
                question_kind=one.kind,
                automatic={ask: value for ask, value in automatic.items() if ask in asks},
            )
            ids = answer.object_ids, answer.reference_ids
            groups[key] = with_answer(draft, one.text, shown, ids, names, row_of)
    return list(groups.values())


def _known(source: RunSource, scene: str, per_kind: int) -> Sequence[TrueAnswer]:
    """Questions generated from the ground truth of a scene, with their answers."""
    rules, truth = _known_truth(source, scene, "reasoning")
    with_fewer = rules.model_copy(update={"per_kind": per_kind})
    made: Any = ground_truths.question_truth(with_fewer, source.run.dataset(scene), scene.partition("/")[2], truth)
    assert isinstance(made, score.ReasoningTruth)
    return made.asked


def with_answer(
    draft: Draft,
    question: str,
    answer: str,
    ids: tuple[Sequence[int], Sequence[int]],
    names: Mapping[int, str],
    row_of: Mapping[int, int],
) -> Draft:
    """The draft with question and answer as title; the objects they mention are outlined and named.

    ``ids``: the answer objects and the reference objects, as in ``names`` and ``row_of``.
    """
    rows, others = (tuple(row_of[one] for one in of_part if one in row_of) for of_part in ids)
    name_of = {row_of[one]: name for one, name in names.items() if one in row_of}
    return replace(
        draft,
        title=(question, f"Answer: {answer}"),
        rows=rows,
        others=tuple(row for row in others if row not in rows),
        names=tuple(name_of.get(row, "") for row in range(max(row_of.values(), default=-1) + 1)),
    )


def reply(answer: Answer) -> str:
    """The answer as shown to annotators, without the name of the language model in failure reasons.

    Suggestions of other words of the map are removed too.
    """
    is_without = answer.solver == "llm" and not answer.is_decided
    return NO_ANSWER if is_without else HINT.sub("", answer.text)


def _judged_answer(
    rules: ProtocolRules, true: TrueAnswer, given: score.SolverAnswer, covered: CoveredObjects
) -> dict[str, str]:
    assert rules.answers is not None
    main = covered.main_object
    judgements = {"answer": judged(score.is_answer_right(rules.answers, true, given, main))}
    if true.object_ids:
        judgements["objects"] = judged(score.are_objects_right(true, given, main))
    return judgements
