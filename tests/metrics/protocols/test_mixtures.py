"""In which rules protocols differ, and that every choice of them between two makes a protocol."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pytest

from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.metrics.protocols.mixtures import CONSTANT_RULES, NAMING, Mixtures, differing
from su3d_bench.metrics.protocols.model import ProtocolRules

RULES = [load_protocol(name) for name in protocol_names()]
PAIRS = [
    (first, second)
    for first, second in combinations(RULES, 2)
    if (first.kind, first.label_space) == (second.kind, second.label_space)
    and set(first.headline) & set(second.value_names)
]


def of_rule(rules: ProtocolRules, rule: str) -> object:
    field, _, leaf = rule.partition(".")
    value = getattr(rules, field)
    return getattr(value, leaf) if leaf else value


@pytest.mark.parametrize(("first", "second"), PAIRS, ids=lambda rules: rules.name)
def test_every_choice_of_rules_makes_a_protocol_from_the_first_to_the_second(
    first: ProtocolRules, second: ProtocolRules
) -> None:
    mixtures = Mixtures(first, second)
    rules = [one.rule for one in differing(first, second)]
    moved = [rule for group in mixtures.groups for rule in group]
    assert sorted(moved) == sorted(set(rules) - set(CONSTANT_RULES))
    n = len(mixtures.groups)
    for bits in range(1 << n):
        chosen = [k for k in range(n) if bits >> k & 1]
        between = mixtures.of(chosen)
        of_second = {rule for k in chosen for rule in mixtures.groups[k]}
        for rule in moved:
            assert of_rule(between, rule) == of_rule(second if rule in of_second else first, rule)
    last = mixtures.of(range(n))
    same = set(type(first).model_fields) - {*NAMING, *CONSTANT_RULES}
    assert {field for field in same if getattr(last, field) != getattr(second, field)} == set()


def test_pairs_of_each_kind_are_walked() -> None:
    assert {first.kind for first, _ in PAIRS} >= {"semantic", "instance"}
    assert len(PAIRS) > 30


def protocol(folder: Path, name: str, *lines: str, base: str = "rooms-instance") -> ProtocolRules:
    path = folder / f"{name}.toml"
    path.write_text("\n".join([f'extends = "{base}"', f'name = "{name}"', *lines]))
    return load_protocol(str(path))


def test_rules_that_need_one_another_move_together() -> None:
    groups = Mixtures(load_protocol("scannet200-instance"), load_protocol("class-agnostic-maskclustering")).groups
    (together,) = [group for group in groups if "class_agnostic" in group]
    assert {"classes", "vocabulary", "prompt"} <= set(together)


def test_classes_and_what_is_left_out_of_them_move_together() -> None:
    groups = Mixtures(load_protocol("rooms-instance"), load_protocol("replica-openmask3d")).groups
    assert ("classes", "ignore") in groups and ("transfer.evaluation_voxel_m",) in groups


def test_class_ids_of_a_list_of_their_own_move_with_the_truth_that_holds_them() -> None:
    groups = Mixtures(load_protocol("scannet-instance"), load_protocol("scannet200-instance")).groups
    (together,) = [group for group in groups if "classes" in group]
    assert "ground_truth" in together


def test_a_rule_alone_is_a_group_and_what_only_names_is_none(tmp_path: Path) -> None:
    other = protocol(tmp_path, "mine", "version = 7", "min_region_size = 7", "[transfer]", "cap_m = 0.5")
    mixtures = Mixtures(load_protocol("rooms-instance"), other)
    assert set(mixtures.groups) == {("min_region_size",), ("transfer.cap_m",)}
    (only,) = [one for one in differing(mixtures.first, other) if one.rule == "min_region_size"]
    assert (only.first, only.second) == (mixtures.first.min_region_size, 7)


def test_the_same_rules_differ_in_nothing() -> None:
    rules = load_protocol("rooms-semantic")
    assert differing(rules, rules) == [] and Mixtures(rules, rules).groups == ()


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("rooms-semantic", "rooms-instance", "rooms-semantic is of kind 'semantic' and rooms-instance of kind"),
        ("rooms-instance", "scannet-instance", "no truth has both"),
    ],
)
def test_what_cannot_be_mixed_is_told_in_one_line(first: str, second: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Mixtures(load_protocol(first), load_protocol(second))
