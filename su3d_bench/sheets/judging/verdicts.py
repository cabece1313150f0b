"""What people say of a question as a whole, and the list of those that not everybody calls right."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from su3d_bench.formats.tables.csv_text import csv_lines
from su3d_bench.questions.query_files import COLUMN
from su3d_bench.sheets.items import VERDICTS, Key
from su3d_bench.sheets.judging.answers import Judgement

if TYPE_CHECKING:
    from su3d_bench.sheets.judging.scores import SecondLook

WHOLE = "all three"
COLUMNS = (COLUMN, "scene", "kind", "why", "text")


def whole_verdicts(judgements: Iterable[Judgement]) -> Iterator[Judgement]:
    """What each annotator says of each question as a whole: the worst of what they say of its parts."""
    given: dict[tuple[str, str], list[str]] = defaultdict(list)
    for judgement in judgements:
        given[judgement.item_id, judgement.annotator].append(judgement.answer)
    for (item_id, annotator), answers in given.items():
        yield Judgement(item_id, annotator, WHOLE, max(answers, key=VERDICTS.index))


def disputed_csv(key: Key, looks: Iterable[SecondLook]) -> str:
    """A line for each question of ``looks``, as ``--leave-out`` reads it, with why it stands there."""
    of_item = {item.id: item for item in key.items}
    why: dict[str, list[str]] = defaultdict(list)
    texts: dict[str, str] = {}
    for look in looks:
        texts[look.item_id] = look.text
        why[look.item_id].append(f"{look.ask}: {', '.join(sorted(set(look.answers.values())))}")
    rows: list[tuple[str, ...]] = [COLUMNS]
    for item_id, reasons in why.items():
        item = of_item[item_id]
        rows.append((item.question_id, item.scene, item.question_kind, "; ".join(reasons), texts[item_id]))
    return csv_lines(rows)
