"""The rules in which two protocols differ, and the protocols between them: some rules of each.

Rules that depend on each other are changed together: those for which one alone gives no valid protocol, such as a
class list and the names in ``ignore``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

from pydantic import BaseModel, ValidationError

from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.compatibility import ID_LISTS
from su3d_bench.metrics.protocols.model import ProtocolRules

# Fields that name a protocol, or state its use or display, and do not affect any value.
NAMING = ("name", "version", "summary", "datasets", "by_default", "headline", "not_comparable_with")
# The encoder of the features; the text tower is that of the run, whatever the rule.
CONSTANT_RULES = ("encoder",)


@dataclass(frozen=True)
class RuleDifference:
    """A rule, such as ``transfer.cap_m``, and its plain value in each protocol."""

    rule: str
    first: Any
    second: Any


def differing(first: ProtocolRules, second: ProtocolRules) -> list[RuleDifference]:
    """The rules in which two protocols differ, in the order of the model; ``ConfigError`` for two kinds."""
    if first.kind != second.kind:
        raise ConfigError(
            f"{first.name} is of kind '{first.kind}' and {second.name} of kind '{second.kind}': they share no rules to "
            "compare; 'protocols show' prints each"
        )
    found = []
    for field in type(first).model_fields:
        if field in NAMING:
            continue
        of_first, of_second = getattr(first, field), getattr(second, field)
        if isinstance(of_first, BaseModel) and isinstance(of_second, BaseModel):
            leaves = ((f"{field}.{leaf}", leaf) for leaf in type(of_first).model_fields)
            values = [(key, getattr(of_first, leaf), getattr(of_second, leaf)) for key, leaf in leaves]
        else:
            values = [(field, of_first, of_second)]
        found += [RuleDifference(key, plain(one), plain(other)) for key, one, other in values if one != other]
    return found


def plain(value: Any) -> Any:
    """The JSON value of a rule."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    return [plain(item) for item in value] if isinstance(value, tuple) else value


@dataclass(frozen=True)
class Mixtures:
    """The protocols between two of the same kind with common values; ``ConfigError`` for any others."""

    first: ProtocolRules
    second: ProtocolRules

    def __post_init__(self) -> None:
        differing(self.first, self.second)  # checks that both are of one kind
        if self.first.label_space != self.second.label_space:
            raise ConfigError(
                f"{self.first.name} scores the labels of '{self.first.label_space}' and {self.second.name} those of "
                f"'{self.second.label_space}': no ground truth has both"
            )
        if not self.values:
            raise ConfigError(f"{self.first.name} and {self.second.name} have no value with the same name")

    @property
    def values(self) -> tuple[str, ...]:
        """The headline values of the first that the second has too."""
        return tuple(name for name in self.first.headline if name in self.second.value_names)

    @cached_property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The rules that differ and can affect a value, grouped if they depend on each other.

        Merged until every choice of groups gives a valid protocol.
        """
        rules = [one.rule for one in differing(self.first, self.second) if one.rule not in CONSTANT_RULES]
        groups: list[tuple[str, ...]] = [(rule,) for rule in rules]
        # Ground truths with their own list of class ids are grouped with the classes.
        own_ids = [ID_LISTS.get(one.ground_truth) for one in (self.first, self.second)]
        if own_ids[0] != own_ids[1]:
            groups = _merged(groups, [group for group in groups if group[0] in ("classes", "ground_truth")])
        while (apart := self._inseparable(groups)) is not None:
            groups = _merged(groups, apart)
        return tuple(groups)

    def of(self, groups: Collection[int]) -> ProtocolRules:
        """The first protocol with these ``groups`` of rules, by index, from the second."""
        return self._with([rule for number in sorted(groups) for rule in self.groups[number]])

    def _with(self, moved: Sequence[str]) -> ProtocolRules:
        values = {field: getattr(self.first, field) for field in type(self.first).model_fields}
        for rule in moved:
            field, _, leaf = rule.partition(".")
            given = getattr(self.second, field)
            values[field] = values[field].model_copy(update={leaf: getattr(given, leaf)}) if leaf else given
        title = f"{self.first.name} with {', '.join(moved)} of {self.second.name}" if moved else self.first.name
        values |= {"name": title, "version": 1, "headline": self.values, "not_comparable_with": ()}
        return type(self.first).model_validate(values)

    def _inseparable(self, groups: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]] | None:
        """Two groups of which one alone gives no valid protocol; None if every choice is valid."""
        for chosen in (list(some) for n in range(1, len(groups)) for some in combinations(groups, n)):
            if self._is_protocol(chosen):
                continue
            rest = [group for group in groups if group not in chosen]
            for one in chosen:
                for other in rest:
                    without = [group for group in chosen if group != one]
                    if self._is_protocol(without) and self._is_protocol([*chosen, other]):
                        return [one, other]
            return [chosen[0], rest[0]]
        return None

    def _is_protocol(self, groups: Sequence[tuple[str, ...]]) -> bool:
        try:
            self._with([rule for group in groups for rule in group])
        except ValidationError:
            return False
        return True


def _merged(groups: Sequence[tuple[str, ...]], together: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """``groups`` with those of ``together`` merged at the position of the first."""
    if len(together) < 2:
        return list(groups)
    one = tuple(rule for group in groups if group in together for rule in group)
    place = min(groups.index(group) for group in together)
    return [*groups[:place], one, *(group for group in groups[place:] if group not in together)]
