"""Which names are those of large background objects: by the noun that says what a thing is, not by the whole name."""

from __future__ import annotations

from collections.abc import Iterable

from su3d_bench.core.english import head_phrases, words

# Words that end in the same noun and mean something else.
_OTHER_THINGS = frozenset((("coffee", "ground"), ("video", "wall")))


def is_background(name: str, background_names: Iterable[str]) -> bool:
    """Whether all that ``name`` names is one of ``background_names``, with whatever stands before it.

    >>> names = ("Brick walls", "hardwood flooring", "wall lamp", "floor mat")
    >>> [is_background(name, ("wall", "floor")) for name in names]
    [True, True, False, False]
    """
    phrases = head_phrases(name)
    background = [words(one) for one in background_names]
    return bool(phrases) and all(_ends_in_one(phrase, background) for phrase in phrases)


def _ends_in_one(phrase: tuple[str, ...], background: list[tuple[str, ...]]) -> bool:
    # Flooring is floor and roofing is roof.
    spoken = phrase, (*phrase[:-1], phrase[-1].removesuffix("ing"))
    return phrase[-2:] not in _OTHER_THINGS and any(
        one and each[-len(one) :] == one for one in background for each in spoken
    )
