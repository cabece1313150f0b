"""What several scenes are warned of, said once."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

# A number of things in a scene, and what is said of them before the first of them is named. Scenes share classes.
_COUNTED = re.compile(r"(?P<n>\d+) (?:of (?P<of>\d+) )?(?P<what>(?!class)[^,:;(]+)(?:[,:;(].*)?", re.DOTALL)
_PLURAL = {"mask": "masks", "pair": "pairs", "has": "have", "counts": "count", "is": "are"}


def summed(warnings: Sequence[str], scenes: Collection[str]) -> list[tuple[str, list[str]]]:
    """What is said, and of which ``scenes``: of several that say the same the numbers are added up.

    A warning begins with its scene and a colon, or is of none.

    >>> summed(["a: 1 empty mask, the first is mask 3", "b: 2 empty masks, the first is mask 0", "c"], ["a", "b"])
    [('3 empty masks', ['a', 'b']), ('c', [])]
    >>> summed(["a: 1 of 4 masks has no class: 1 of class 7", "b: 2 of 6 masks have no class: 2 of class 9"], "ab")
    [('3 of 10 masks have no class', ['a', 'b'])]
    """
    groups: dict[str, list[tuple[str, str, re.Match[str] | None]]] = {}
    for line in warnings:
        scene, _, sentence = line.partition(": ")
        if scene not in scenes:
            groups.setdefault(line, []).append(("", line, None))
            continue
        found = _COUNTED.fullmatch(sentence)
        groups.setdefault(sentence if found is None else _in_plural(found["what"]), []).append((scene, sentence, found))
    return [(_said(key, group), [scene for scene, _, _ in group if scene]) for key, group in groups.items()]


def _said(key: str, group: Sequence[tuple[str, str, re.Match[str] | None]]) -> str:
    counts = [found for _, _, found in group if found is not None]
    if len(group) == 1 or not counts:
        return group[0][1]
    total = f"{sum(int(found['n']) for found in counts)} "
    if all(found["of"] for found in counts):
        total += f"of {sum(int(found['of']) for found in counts)} "
    return total + key


def _in_plural(words: str) -> str:
    first, *rest = words.strip().split(" ")
    verb = next((k for k, word in enumerate(rest) if word in ("has", "have")), len(rest))
    plural = [_PLURAL.get(word, word) if k <= verb or word == "counts" else word for k, word in enumerate(rest)]
    return " ".join([_PLURAL.get(first, first), *plural])
