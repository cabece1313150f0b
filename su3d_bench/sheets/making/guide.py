"""How to judge, in the words that page and workbook share; what each choice means stands with the questions."""

from __future__ import annotations

from collections.abc import Mapping

from su3d_bench.sheets.items import CANNOT_TELL, Sheet, SheetKind

GUIDE = "how to judge"
_ROOM = "Below is the room from a corner and from above as the photographs saw it"
_LETTERS = "Things of one name have letters: lamp A of the answer is lamp A of the picture."
_PICTURE: Mapping[SheetKind, tuple[str, ...]] = {
    "retrieval": (
        "The thing that was found is outlined in the photograph; beside it is a closer look.",
        f"{_ROOM}; what was found is red.",
    ),
    "annotation": (
        "The mask is outlined in the photograph; beside it is a closer look.",
        f"{_ROOM}; the mask is red. A side that no picture shows is not missing.",
    ),
    "reasoning": (
        "What the answer names is outlined in the photograph; beside it is a closer look. An answer that names nothing "
        "comes with photographs of the room.",
        f"{_ROOM}; what the answer names is red, what it was held against blue. {_LETTERS}",
    ),
    "questions": (
        "What the answer names is outlined in the photograph; beside it is a closer look.",
        f"{_ROOM}; what the answer names is red, what it was held against blue. {_LETTERS}",
    ),
}
_ALONE = (
    "Two seconds are usually enough; the first impression is what counts.",
    "Judge alone, and do not talk about single items before all are done: how far people agree is itself a result.",
)


def guide_of(sheet: Sheet) -> tuple[str, ...]:
    """The sentences that an annotator of a set reads first."""
    is_open = any(CANNOT_TELL in ask.choices for ask in sheet.asks)
    unsure = (f"'{CANNOT_TELL}' is for what the picture does not show; it is counted apart, and no fault of yours.",)
    return (*_PICTURE[sheet.kind], *(unsure if is_open else ()), *_ALONE)
