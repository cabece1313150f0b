"""Which conditions a sweep has, and the names of the methods under them.

A sweep is one run whose methods include each method clean and under every condition, so that it is resumed, extended
and distributed as any other, and perception of unchanged images is computed once.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from su3d_bench.core.errors import ConfigError, counted, suggest
from su3d_bench.corruptions.apply import CORRUPTIONS, Cell, Condition, parse_conditions
from su3d_bench.corruptions.model import MAX_SEVERITY
from su3d_bench.runs.plan import method_targets, named_method

MAX_METHODS = 2000


def conditions_of(wanted: Sequence[str], severities: Sequence[int], only: Sequence[str]) -> list[tuple[Condition, ...]]:
    """The conditions of a sweep: every one in ``only``, or the ``severities`` of the ``wanted`` corruptions.

    ``wanted``: families (``depth``), corruptions (``depth/holes``) or pairs of them (``depth/holes+pose/jumps``); all
    corruptions if empty. Raises ``ConfigError`` for an unknown name or severity.
    """
    if only:
        return [parse_conditions(text) for text in only]
    if wrong := [severity for severity in severities if not 0 <= severity <= MAX_SEVERITY]:
        raise ConfigError(f"--severities {wrong[0]}: expected 0 to {MAX_SEVERITY}")
    named = dict.fromkeys(one for text in wanted or _families() for one in _combinations(text))
    return [
        parse_conditions("+".join(f"{address}/{severity}" for address in addresses))
        for addresses, severity in itertools.product(named, severities)
    ]


def _combinations(text: str) -> Iterator[tuple[str, ...]]:
    of_parts = [
        [address for address, row in CORRUPTIONS.items() if part in (address, row.family)] for part in text.split("+")
    ]
    for part, found in zip(text.split("+"), of_parts, strict=True):
        if not found:
            raise ConfigError(f"unknown corruption '{part}'{suggest(part, [*_families(), *CORRUPTIONS])}")
    return itertools.product(*of_parts)


def _families() -> list[str]:
    return list(dict.fromkeys(row.family for row in CORRUPTIONS.values()))


def clean_targets(methods: Sequence[str]) -> list[str]:
    """The requested methods with ``all`` replaced by names; ``ConfigError`` for one that is already corrupted."""
    targets = method_targets(methods)
    if corrupted := [target for target in targets if named_method(target).corruption]:
        raise ConfigError(f"--methods {corrupted[0]}: is already under a corruption; name the method alone")
    return targets


def methods_of(methods: Sequence[str], conditions: Sequence[tuple[Condition, ...]]) -> list[str]:
    """What to run: each of ``methods`` clean and under each of ``conditions``; ``ConfigError`` if they are too many."""
    targets = [*methods, *(method + Cell(method, one).suffix for method in methods for one in conditions)]
    if len(targets) > MAX_METHODS:
        raise ConfigError(f"{counted(len(targets), 'cell')}: one sweep can have at most {MAX_METHODS}")
    return targets
