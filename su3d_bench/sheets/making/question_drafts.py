"""Questions made from the ground truth, with their answers, as people are asked whether they are right."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from su3d_bench.core.errors import printable
from su3d_bench.questions.audit import held_against
from su3d_bench.questions.generated import generate_questions
from su3d_bench.questions.generator import chosen
from su3d_bench.questions.model import REASONING, question_id
from su3d_bench.questions.scene_map import SceneMap
from su3d_bench.questions.truths import MIN_VERTICES, questions_of, scene_objects
from su3d_bench.sheets.items import ASKS
from su3d_bench.sheets.judging.scores import OF_ALL_KINDS
from su3d_bench.sheets.making.blinding import without_ids
from su3d_bench.sheets.making.drafts import MOST_TEXT, Draft, names_of_rows
from su3d_bench.sheets.making.truth_source import TruthSource


def question_drafts(source: TruthSource, scene: str, per_kind: int, left_out: Collection[str] = ()) -> list[Draft]:
    """``per_kind`` questions of each kind and of each template of reasoning, without those whose ids are ``left_out``.

    Of a template nothing takes the place of what is left out.
    """
    dataset, name = source.dataset(scene), scene.partition("/")[2]
    objects = scene_objects(dataset, name, source.truth(scene), MIN_VERTICES)
    found = [question for question in questions_of(dataset, name) if question.id not in left_out]
    shown = _Shown(source, scene, objects)
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


class _Shown:
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
