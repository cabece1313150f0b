"""The rules in which protocols differ; every choice of them between two gives a valid protocol."""

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
def test_every_choice_of_differing_rules_is_a_valid_protocol(first: ProtocolRules, second: ProtocolRules) -> None:
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


def test_pairs_of_each_kind_are_covered() -> None:
    assert {first.kind for first, _ in PAIRS} >= {"semantic", "instance"}
    assert len(PAIRS) > 30


def protocol(folder: Path, name: str, *lines: str, base: str = "rooms-instance") -> ProtocolRules:
    path = folder / f"{name}.toml"
    path.write_text("\n".join([f'extends = "{base}"', f'name = "{name}"', *lines]))
    return load_protocol(str(path))


def test_dependent_rules_are_grouped() -> None:
    groups = Mixtures(load_protocol("scannet200-instance"), load_protocol("class-agnostic-maskclustering")).groups
    (together,) = [group for group in groups if "class_agnostic" in group]
    assert {"classes", "vocabulary", "prompt"} <= set(together)


def test_classes_and_ignored_classes_are_grouped() -> None:
    groups = Mixtures(load_protocol("rooms-instance"), load_protocol("replica-openmask3d")).groups
    assert ("classes", "ignore") in groups and ("transfer.evaluation_voxel_m",) in groups


def test_own_class_id_lists_are_grouped_with_their_ground_truth() -> None:
    groups = Mixtures(load_protocol("scannet-instance"), load_protocol("scannet200-instance")).groups
    (together,) = [group for group in groups if "classes" in group]
    assert "ground_truth" in together


def test_single_rule_is_a_group_and_naming_fields_are_not(tmp_path: Path) -> None:
    other = protocol(tmp_path, "mine", "version = 7", "min_region_size = 7", "[transfer]", "cap_m = 0.5")
    mixtures = Mixtures(load_protocol("rooms-instance"), other)
    assert set(mixtures.groups) == {("min_region_size",), ("transfer.cap_m",)}
    (only,) = [one for one in differing(mixtures.first, other) if one.rule == "min_region_size"]
    assert (only.first, only.second) == (mixtures.first.min_region_size, 7)


def test_same_rules_have_no_differences() -> None:
    rules = load_protocol("rooms-semantic")
    assert differing(rules, rules) == [] and Mixtures(rules, rules).groups == ()


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("rooms-semantic", "rooms-instance", "rooms-semantic is of kind 'semantic' and rooms-instance of kind"),
        ("rooms-instance", "scannet-instance", "no ground truth has both"),
    ],
)
def test_unmixable_protocols_give_one_line(first: str, second: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Mixtures(load_protocol(first), load_protocol(second))
