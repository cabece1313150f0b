"""Texts and names that do not tell whose map they are of: letters in place of its ids."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from su3d_bench.questions.scene_map import MapObject, SceneMap

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
