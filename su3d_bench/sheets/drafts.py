"""What is put before people, before it is shuffled and drawn: one draft for all schemes that give the same.

Texts and names do not tell whose map they are of: letters stand in place of its ids.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import Float32Array, GroundTruth
from su3d_bench.metrics.instance.score import Covered
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import (
    AskedText,
    GivenAnswer,
    ReasoningTruth,
    TrueAnswer,
    are_objects_right,
    is_answer_right,
    judge_merging,
    judge_retrieval,
    labels_n,
)
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.questions.audit import held_against
from su3d_bench.questions.generated import generate_questions
from su3d_bench.questions.generator import chosen, generate
from su3d_bench.questions.model import (
    KINDS,
    REASONING,
    Answer,
    Question,
    points_found,
    question_id,
    rank_all,
    unsettled,
)
from su3d_bench.questions.scene_map import MapObject, SceneMap
from su3d_bench.questions.solver import AskMap, LanguageSolver, given_answer
from su3d_bench.questions.truths import MIN_VERTICES, own_questions, question_truth, scene_objects
from su3d_bench.questions.truths import questions_of as questions_of_scene
from su3d_bench.sheets.items import ASKS, RIGHT, WRONG, SheetKind
from su3d_bench.sheets.scores import OF_ALL_KINDS
from su3d_bench.sheets.sources import RunSource, TruthSource, mask_digest

UNKNOWN = "something unknown"  # what stands in place of an id that the map does not have


def without_ids(text: str, scene: SceneMap, spoken_of: Sequence[int]) -> tuple[str, dict[int, str]]:
    """``text`` with a name for each thing that it calls by its id, and these names, also of the ids ``spoken_of``.

    Things of one name are told apart by letters, in the order in which the text comes to them.
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
    """The forms of an id: ``#12`` as the built-in solver writes it, ``ID 12`` or ``(ID: 12)`` as language models do."""
    return rf"\(\s*IDs?\b\s*[:=#]?\s*{number}\s*\)|(?:#|\bIDs?\b\s*[:=#]?\s*){number}(?!\d)"


def _names(things: Sequence[MapObject]) -> dict[int, str]:
    """A name for each thing by its id."""
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


MOST_TEXT = 1000  # characters of a query, a label or an answer that a sheet shows
NO_LABEL = "(no label)"
NO_ANSWER = "(no answer)"
HINT = re.compile(r"; did you mean '[^']*'\?")  # for who can ask again


@dataclass(frozen=True)
class Draft:
    """An item without number and picture. ``rows`` of the map of ``methods[0]`` are outlined, ``others`` drawn too.

    ``title``: lines of the picture; ``text``: what the sheet shows; ``names`` (K) of the map's instances as the answer
    calls them, '' of those that it does not speak of. ``points`` (M, 3) m are what was found in a map that has no
    instances, and then row 0.
    """

    kind: SheetKind
    scene: str
    methods: tuple[str, ...]
    instance_ids: tuple[int, ...]
    rows: tuple[int, ...]
    title: tuple[str, ...]
    text: str
    asks: tuple[str, ...]
    question_id: str = ""
    question_kind: str = ""
    stands_for: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
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
    left_out: Collection[str] = (),
) -> list[Question]:
    """The questions of four kinds to a scene: those ``given``, else the ones that its ground truth answers.

    Those whose ids are ``left_out`` make room for others.
    """
    if given is None:
        rules = source.rules(scene, "retrieval")
        truth = source.truth(scene, rules)
        if rules is None or truth is None:
            raise ConfigError(
                f"{printable(scene, 100)}: has no ground truth that questions could be made from; name a file with "
                "--questions FILE, or --questions paper"
            )
        dataset, name = source.run.dataset(scene), scene.partition("/")[2]
        if rules.questions == "dataset":
            given = own_questions(dataset, name)
        else:
            assert rules.min_region_size is not None
            given = generate(scene, scene_objects(dataset, name, truth, rules.min_region_size))
    mine = [question for question in given if question.scene == scene and question.id not in left_out]
    return [question for kind in KINDS for question in chosen([each for each in mine if each.kind == kind], per_kind)]


def retrieval_drafts(source: RunSource, scene: str, questions: Sequence[Question], encoder: Encoder) -> list[Draft]:
    """For each question one draft for everything that some method finds first, with all methods that do.

    Of instances that is the most similar one, of features alone the points that ``points_found`` says.
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
                query = AskedText(question.kind, question.text, question.answers or ())
                is_right = judge_retrieval(covered.main_object, np.array([row]), [query])
                automatic = {"retrieval": judged(bool(is_right[0]))}
            drafts.append(
                Draft(
                    kind="retrieval",
                    scene=scene,
                    methods=tuple(methods),
                    instance_ids=tuple(firsts[name].id_at(place) for name in methods),
                    rows=(0,) if first.is_of_points else (row,),
                    title=(f"Is this: {question.text}?",),
                    text=printable(question.text, MOST_TEXT),
                    asks=("retrieval",),
                    question_id=question.id,
                    question_kind=question.kind,
                    automatic=automatic,
                    points=first.a_map.points[first.a_map.mask(row)] if first.is_of_points else None,
                )
            )
    return drafts


@dataclass(frozen=True)
class _Firsts:
    """What a map gives for some questions: the row of ``a_map`` for each; of features alone that is what is found."""

    a_map: Instances
    rows: tuple[int, ...]
    is_of_points: bool

    def id_at(self, place: int) -> int:
        """The number of the instance that answers a question; -1 of points, which are none."""
        return -1 if self.is_of_points else id_of(self.a_map, self.rows[place])


def _firsts(prediction: Prediction, texts: Sequence[str], encoder: Encoder) -> _Firsts | None:
    """What a map gives for each text; None of an empty one."""
    if not len(prediction.points):
        return None
    if isinstance(prediction, DenseFeatures):
        return _Firsts(points_found(prediction, texts, encoder), tuple(range(len(texts))), True)
    assert isinstance(prediction, Instances)
    if not len(prediction):
        return None
    ranked = rank_all(prediction, texts, encoder)
    return _Firsts(prediction, tuple(int(ranking.order[0]) for ranking in ranked), False)


def annotation_drafts(source: RunSource, scene: str, n_most: int, random: np.random.Generator) -> list[Draft]:
    """At most ``n_most`` instances a scene, drawn with ``random``, each with its labels n and n' in drawn order.

    Methods take turns, however many instances each has. What the filter of labels n' leaves out has label n alone.
    """
    rules = source.rules(scene, "annotation")
    truth = source.truth(scene, rules)
    draft_of: dict[bytes, Draft] = {}
    for method in source.methods:
        instances = source.instances(scene, method)
        judge = _annotation_judge(source, scene, rules, truth, instances)
        own, refined = labels_n(instances), source.refined(scene, method)
        for row in range(len(instances)):
            labels = [own[row], *([refined.names[row]] if refined is not None and refined.is_kept[row] else [])]
            names = [printable(label, MOST_TEXT) or NO_LABEL for label in labels]
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
                    text="",
                    asks=(),
                    automatic=judge(row, names),
                )
    drafts = list(draft_of.values())
    kept = sorted(_in_turn(drafts, source.methods, random.permutation(len(drafts)).tolist())[:n_most])
    return [_with_labels_shuffled(drafts[k], random) for k in kept]


def _in_turn(drafts: Sequence[Draft], methods: Sequence[str], order: Sequence[int]) -> list[int]:
    """``order`` so that each method in turn has a part in the next draft, as long as it has one left."""
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
    """The draft with label n and label n' as labels 1 and 2 in drawn order; as one where they are equal."""
    meant: dict[str, list[str]] = {}
    for name, what in zip(draft.title, ("n", "n'"), strict=False):
        meant.setdefault(name, []).append(what)
    order = random.permutation(len(meant))
    names = [list(meant)[k] for k in order]
    stands_for = {f"label {k + 1}": tuple(meant[name]) for k, name in enumerate(names)}
    automatic = {ask: draft.automatic[what[0]] for ask, what in stands_for.items() if what[0] in draft.automatic}
    if "merging" in draft.automatic:
        automatic["merging"] = draft.automatic["merging"]
    lines = tuple(f"Label {k + 1}: {name}" for k, name in enumerate(names))
    asks = (*stands_for, "merging")
    text = "\n".join(lines)
    return replace(draft, title=lines, text=text, asks=asks, stands_for=stands_for, automatic=automatic)


Judge = Callable[[int, Sequence[str]], Mapping[str, str]]


def _annotation_judge(
    source: RunSource, scene: str, rules: ProtocolRules | None, truth: GroundTruth | None, instances: Instances
) -> Judge:
    """What the truth says of an instance and its labels: ``n``, ``n'`` and ``merging``; nothing where it is silent."""
    covered = source.covered(scene, rules, instances)
    if covered is None or rules is None or truth is None or rules.merging is None:
        return lambda row, names: {}
    known: Any = question_truth(rules, source.run.dataset(scene), scene.partition("/")[2], truth)
    merges, main = judge_merging(rules.merging, covered), covered.main_object

    def judge(row: int, names: Sequence[str]) -> Mapping[str, str]:
        if int(main[row]) not in known.object_ids:
            return {}
        labels = {
            what: judged(known.is_called(name, int(main[row]))) for what, name in zip(("n", "n'"), names, strict=False)
        }
        return {**labels, "merging": merges[row]}

    return judge


def also(draft: Draft, method: str, instance_id: int) -> Draft:
    """The draft, said by one more method; that of a method said twice stays as it is."""
    if method in draft.methods:
        return draft
    return replace(draft, methods=(*draft.methods, method), instance_ids=(*draft.instance_ids, instance_id))


def id_of(instances: Instances, row: int) -> int:
    return int(instances.ids[row]) if len(instances.ids) else row


def requests_into(requests: list[ChatRequest], model: LanguageModel, config: LanguageConfig) -> AskMap:
    """Puts what a language model would be asked into ``found`` and asks nobody."""

    def ask(scene: SceneMap, questions: Sequence[str]) -> Sequence[Answer]:
        solver = LanguageSolver(scene, model, config)
        requests.extend(solver.request(question) for question in questions)
        return [unsettled("not asked")] * len(questions)

    return ask


def reasoning_drafts(
    source: RunSource,
    scene: str,
    given: Sequence[Question] | None,
    per_kind: int,
    ask: AskMap,
    left_out: Collection[str] = (),
) -> list[Draft]:
    """The answers about each map, one draft for all maps of which the same is said.

    Asked are the questions of kind ``reasoning`` that are ``given``, else ``per_kind`` of each template, made from the
    ground truth; without those whose ids are ``left_out``.
    """

    def is_asked(text: str) -> bool:
        return question_id(scene, REASONING, text) not in left_out

    rules = source.rules(scene, "reasoning")
    known = (
        [] if given is not None else [true for true in _known(source, scene, rules, per_kind) if is_asked(true.text)]
    )
    texts = [answer.text for answer in known]
    if given is not None:
        mine = [question.text for question in given if question.scene == scene and question.kind == REASONING]
        texts = [text for text in mine if is_asked(text)]
    groups: dict[bytes, Draft] = {}
    for method in source.methods:
        instances = source.instances(scene, method)
        a_map = source.scene_map(scene, method)
        covered = source.covered(scene, rules, instances) if known else None
        shown = _ShownMap(scene, method, instances, a_map)
        for place, (text, answer) in enumerate(zip(texts, ask(a_map, texts), strict=True)):
            rows, (text_told, names) = shown.rows(answer.object_ids), shown.told(answer)
            key = text.encode() + b"\0" + text_told.encode() + mask_digest(instances, rows)
            if key in groups:
                groups[key] = also(groups[key], method, shown.instance_id(rows))
                continue
            automatic = {}
            if covered is not None and rules is not None:
                true = known[place]
                automatic = _judged_answer(rules, true, given_answer(true, answer, a_map), covered)
            kind = known[place].kind if known else REASONING
            groups[key] = shown.draft(text, kind, answer, text_told, names, automatic)
    return list(groups.values())


def _known(source: RunSource, scene: str, rules: ProtocolRules | None, per_kind: int) -> Sequence[TrueAnswer]:
    """Questions made from the ground truth of a scene, with their answers."""
    truth = source.truth(scene, rules)
    if rules is None or truth is None:
        raise ConfigError(
            f"{printable(scene, 100)}: has no ground truth that questions could be made from; name a file of "
            "questions of kind reasoning with --questions FILE"
        )
    with_fewer = rules.model_copy(update={"per_kind": per_kind})
    made: Any = question_truth(with_fewer, source.run.dataset(scene), scene.partition("/")[2], truth)
    assert isinstance(made, ReasoningTruth)
    return made.asked


def told(answer: Answer) -> str:
    """The answer as people see it: why a language model gave none names the model, which they must not see.

    Nor does the word that the map has instead, which is no part of the answer.
    """
    is_without = answer.solver == "llm" and not answer.is_settled
    return NO_ANSWER if is_without else HINT.sub("", answer.text)


class _ShownMap:
    """A map of a method whose answers become drafts."""

    def __init__(self, scene: str, method: str, instances: Instances, a_map: SceneMap) -> None:
        self._scene, self._method, self._instances = scene, method, instances
        self._map = a_map
        self._row_of = {thing.id: thing.row for thing in a_map.objects}

    def told(self, answer: Answer) -> tuple[str, dict[int, str]]:
        """The answer as people see it, and how it calls the objects that it rests on, by their ids."""
        return without_ids(told(answer), self._map, (*answer.object_ids, *answer.reference_ids))

    def rows(self, ids: Sequence[int]) -> tuple[int, ...]:
        return tuple(self._row_of[object_id] for object_id in ids)

    def instance_id(self, rows: Sequence[int]) -> int:
        """That of the only instance; -1 of several or none."""
        return id_of(self._instances, rows[0]) if len(rows) == 1 else -1

    def draft(
        self,
        question: str,
        kind: str,
        answer: Answer,
        text: str,
        names: Mapping[int, str],
        automatic: Mapping[str, str],
    ) -> Draft:
        rows = self.rows(answer.object_ids)
        asks = ("answer", "objects") if rows else ("answer",)
        return Draft(
            kind="reasoning",
            scene=self._scene,
            methods=(self._method,),
            instance_ids=(self.instance_id(rows),),
            rows=rows,
            title=(question, f"Answer: {text}"),
            text=f"{printable(question, MOST_TEXT)}\nAnswer: {printable(text, MOST_TEXT)}",
            asks=asks,
            question_id=question_id(self._scene, REASONING, question),
            question_kind=kind,
            automatic={ask: value for ask, value in automatic.items() if ask in asks},
            others=self.rows(answer.reference_ids),
            names=names_of_rows(names, self._row_of, len(self._instances)),
        )


def names_of_rows(names: Mapping[int, str], row_of: Mapping[int, int], n_rows: int) -> tuple[str, ...]:
    """The names of ids by the rows of a map; '' for the rest."""
    of_row = {row_of[number]: name for number, name in names.items() if number in row_of}
    return tuple(of_row.get(row, "") for row in range(n_rows))


def _judged_answer(rules: ProtocolRules, true: TrueAnswer, given: GivenAnswer, covered: Covered) -> dict[str, str]:
    assert rules.answers is not None
    main = covered.main_object
    judgements = {"answer": judged(is_answer_right(rules.answers, true, given, main))}
    if true.object_ids:
        judgements["objects"] = judged(are_objects_right(true, given, main))
    return judgements


def question_drafts(source: TruthSource, scene: str, per_kind: int, left_out: Collection[str] = ()) -> list[Draft]:
    """``per_kind`` questions of each kind and of each template of reasoning, without those whose ids are ``left_out``.

    Of a template nothing takes the place of what is left out.
    """
    dataset, name = source.dataset(scene), scene.partition("/")[2]
    objects = scene_objects(dataset, name, source.truth(scene), MIN_VERTICES)
    found = [question for question in questions_of_scene(dataset, name) if question.id not in left_out]
    shown = _ShownQuestions(source, scene, objects)
    drafts = []
    for question in chosen(found, per_kind):
        told = ", ".join(objects.by_id(k).shown for k in question.answers or () if k in objects.ids)
        drafts.append(shown.draft(f"Find: {question.text}", told, question.id, question.kind, question.answers or ()))
    for made in generate_questions(objects, n_each=per_kind):
        made_id, answer = question_id(scene, REASONING, made.text), made.answer
        if made_id not in left_out:
            held = [thing.id for thing in held_against(made, objects)]
            told = "no" if answer.value is False else answer.text
            drafts.append(shown.draft(made.text, told, made_id, made.kind, answer.object_ids, held))
    return drafts


class _ShownQuestions:
    """A scene whose questions become drafts."""

    def __init__(self, source: TruthSource, scene: str, objects: SceneMap) -> None:
        self._scene = scene
        ids = source.instances(scene).ids.tolist()
        self._row_of = {instance: row for row, instance in enumerate(ids)}
        self._objects = objects

    def draft(
        self, asked: str, told: str, made_id: str, kind: str, answers: Sequence[int], references: Sequence[int] = ()
    ) -> Draft:
        spoken_of = [number for number in (*answers, *references) if number in self._objects.ids]
        told, names = without_ids(told, self._objects, spoken_of)
        lines = asked, f"Answer: {told}"
        rows = self._rows(answers)
        methods = kind, OF_ALL_KINDS  # no method answers: what is counted together is a kind
        return Draft(
            kind="questions",
            scene=self._scene,
            methods=methods,
            instance_ids=(answers[0] if len(answers) == 1 else -1,) * len(methods),
            rows=rows,
            title=lines,
            text="\n".join(printable(line, MOST_TEXT) for line in lines),
            asks=tuple(ask.name for ask in ASKS["questions"]),
            question_id=made_id,
            question_kind=kind,
            others=tuple(row for row in self._rows(references) if row not in rows),
            names=names_of_rows(names, self._row_of, len(self._row_of)),
        )

    def _rows(self, ids: Sequence[int]) -> tuple[int, ...]:
        return tuple(self._row_of[instance] for instance in ids if instance in self._row_of)
