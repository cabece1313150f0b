"""Protocols: the built-in rules, the needs of each kind, and what a prediction or ground truth lacks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from places import CASES
from pydantic import ValidationError
from scored_room import instances

from su3d_bench.core.errors import ConfigError
from su3d_bench.datasets.rooms.classes import CLASSES
from su3d_bench.metrics.compatibility import (
    ContentFacts,
    Form,
    TruthFacts,
    class_id_incompatibility,
    list_of_ids,
    n_feature_dimensions,
    truth_incompatibility,
)
from su3d_bench.metrics.instance.average_precision import MIN_REGION_SIZE, THRESHOLDS
from su3d_bench.metrics.protocols.kinds import RULES_OF_KIND
from su3d_bench.metrics.protocols.loading import (
    load_protocol,
    not_comparable_with,
    protocol_names,
    rule_differences,
    rules_file,
)
from su3d_bench.metrics.protocols.model import Kind, MetricName, ProtocolRules
from su3d_bench.metrics.scoring import METRICS


@pytest.mark.parametrize("name", protocol_names())
def test_a_protocol_is_named_as_its_file_and_names_others_that_exist(name: str) -> None:
    rules = load_protocol(name)
    assert rules.name == name
    assert set(rules.not_comparable_with) <= {*protocol_names()} - {name}
    assert set(rules.ignore) <= {entry.name for entry in rules.classes} or rules.kind == "categories"


@pytest.mark.parametrize("name", protocol_names())
def test_every_rule_from_an_original_states_its_source(name: str) -> None:
    text = rules_file(name).read_text()
    assert "Source" in text or "ConceptGraphs' rules" in text


def test_conceptgraphs_exclusions_leave_51_48_and_46_classes() -> None:
    assert [len(load_protocol(f"replica-conceptgraphs-ex{n}").scored) for n in (1, 4, 6)] == [51, 48, 46]
    scored = {entry.name for entry in load_protocol("replica-conceptgraphs-ex6").scored}
    assert {"wall-plug", "blinds", "panel"} <= scored


@pytest.mark.parametrize(
    ("name", "case", "oracle"),
    [
        ("replica-openmask3d", "replica01_all_ones", "replica_script"),
        ("scannet-instance", "inst01_basic", "official_py3_pr26"),
        ("scannet200-instance", "scannet200_01", "openmask3d"),
        ("scannet-semantic", "sem01_all_classes", "official_py3"),
    ],
)
def test_class_ids_are_those_of_the_original(name: str, case: str, oracle: str) -> None:
    expected = json.loads((CASES / f"{case}.json").read_text())[oracle]
    assert [entry.id for entry in load_protocol(name).scored] == expected["class_ids"]


@pytest.mark.parametrize("name", protocol_names())
def test_instance_protocols_use_the_original_thresholds_and_size(name: str) -> None:
    rules = load_protocol(name)
    if rules.kind == "boxes":
        assert (rules.thresholds, rules.min_region_size) == ((0.25, 0.5), 5)
    elif rules.kind in ("instance", "queries"):
        n_points = MIN_REGION_SIZE if rules.kind == "instance" and not name.startswith("opensun3d") else 1
        assert (rules.thresholds, rules.min_region_size) == (THRESHOLDS, n_points)
    else:
        asks = rules.is_judged and (rules.kind != "object-chains" or rules.questions is not None)
        n_vertices = MIN_REGION_SIZE if asks else 1 if rules.metric == "semantic-kitti" else None
        assert (rules.thresholds, rules.min_region_size, rules.confidence) == ((), n_vertices, None)


def test_the_51_classes_of_ovo_fall_into_three_thirds() -> None:
    group = {entry.name: entry.group for entry in load_protocol("replica-ovo51").scored}
    assert [list(group.values()).count(name) for name in ("head", "common", "tail")] == [17, 17, 17]
    assert (group["wall"], group["blanket"], group["tv-stand"], group["monitor"], group["switch"]) == (
        "head", "head", "common", "common", "tail",
    )  # fmt: skip


def test_scannet200_groups_have_64_68_and_66_classes() -> None:
    groups = [entry.group for entry in load_protocol("scannet200-instance").scored]
    assert [groups.count(name) for name in ("head", "common", "tail")] == [64, 68, 66]


def test_classes_of_the_protocol_are_those_of_the_rooms() -> None:
    ours = {(entry.id, entry.name) for entry in load_protocol("rooms-instance").classes}
    assert ours == {(known.id, known.name) for known in CLASSES}


def test_prompts_use_the_class_name_unless_the_rules_replace_it() -> None:
    assert load_protocol("replica-conceptgraphs-ex6").texts_of("tv-screen") == ("an image of tv-screen",)
    assert load_protocol("scannet-instance").texts_of("otherfurniture") == ("a other in a scene",)


def test_the_substring_rule_ignores_names_that_contain_the_word() -> None:
    rules = load_protocol("replica-mesh-ex6").model_copy(update={"ignore_rule": "substring"})
    ignored = {entry.name for entry in rules.classes if rules.is_ignored(entry.name)}
    assert ignored == {"other", "floor", "wall", "ceiling", "door", "window", "indoor-plant", "wall-plug"}


@pytest.mark.parametrize("name", protocol_names())
def test_incomparable_protocols_are_listed_from_both_sides(name: str) -> None:
    rules = load_protocol(name)
    others = not_comparable_with(rules)
    assert set(rules.not_comparable_with) <= set(others)
    assert all(name in not_comparable_with(load_protocol(other)) for other in others)


def test_digest_ignores_rules_with_default_values() -> None:
    class Later(ProtocolRules):
        is_new: bool = False

    rules = load_protocol("rooms-semantic")
    later = Later.model_construct(**dict(rules))
    assert later.digest == rules.digest
    assert later.model_copy(update={"is_new": True}).digest != rules.digest


def test_loaded_rules_are_immutable() -> None:
    rules: Any = load_protocol("rooms-semantic")
    with pytest.raises(ValidationError, match="frozen"):
        rules.version = 9


def test_digest_changes_with_every_rule() -> None:
    rules = load_protocol("rooms-semantic")
    changed = rules.model_copy(update={"prompt": "a picture of {}"})
    assert rules.digest == load_protocol("rooms-semantic").digest
    assert changed.digest != rules.digest


def test_every_kind_has_rules_and_a_metric_and_every_metric_belongs_to_a_kind() -> None:
    assert set(RULES_OF_KIND) == set(METRICS) == set(get_args(Kind))
    names = [name for rules in RULES_OF_KIND.values() for name in rules.values_of_metric]
    assert set(names) == set(get_args(MetricName))


def test_one_name_is_enough_for_scoring() -> None:
    mask, points = np.arange(2, dtype=np.int32), np.zeros((2, 3), np.float32)
    for labels, has_names in ((["chair", ""], True), (["", ""], False)):
        assert ContentFacts.of(instances(points, [mask, mask], labels)).has_names == has_names


MESH = TruthFacts("truth", "replica", ("mesh-vertices",))
TRUTHS = [
    ("rooms-semantic", MESH, None),
    ("rooms-instance", MESH, None),
    ("rooms-instance", replace(MESH, has_instances=False), "needs instances, the ground truth has class ids only"),
    ("rooms-semantic", replace(MESH, has_instances=False, has_points=False), None),
    ("rooms-annotation", replace(MESH, has_points=False), "needs the objects of a dataset"),
    ("rooms-semantic", replace(MESH, label_space="nyu40"), "it scores the labels of 'replica', truth has those of"),
    ("rooms-semantic", replace(MESH, label_space=None, variants=()), None),
    ("rooms-semantic", replace(MESH, variants=("other", "more")), "it needs ground truth 'mesh-vertices', truth has o"),
    ("replica-retrieval", MESH, None),
]


@pytest.mark.parametrize(("name", "truth", "reason"), TRUTHS)
def test_ground_truth_unfit_for_a_protocol_gives_a_reason(name: str, truth: TruthFacts, reason: str | None) -> None:
    printed = truth_incompatibility(load_protocol(name), truth)
    assert printed == reason if reason is None else str(printed).startswith(reason)


def test_dataset_questions_need_a_dataset_with_questions() -> None:
    rules = load_protocol("rooms-retrieval").model_copy(update={"questions": "dataset"})
    assert "a dataset with questions and answers, which truth does not have" in str(truth_incompatibility(rules, MESH))
    assert truth_incompatibility(rules, replace(MESH, knows_questions=True)) is None


def test_class_ids_up_to_forty_are_nyu40_and_larger_ones_scannet200() -> None:
    assert [list_of_ids(one) for one in (1, 40, 41)] == ["nyu40-vertices"] * 2 + ["scannet200-vertices"]
    facts = {one: ContentFacts("vertex-masks", 2, has_labels=True, class_ids=np.array([3, one])) for one in (40, 41)}
    twenty, two_hundred = load_protocol("scannet-instance"), load_protocol("scannet200-instance")
    assert [class_id_incompatibility(twenty, facts[one]) is None for one in (40, 41)] == [True, False]
    assert [class_id_incompatibility(two_hundred, facts[one]) is None for one in (40, 41)] == [False, True]
    assert "go up to 41, as ids of ScanNet200 do" in str(class_id_incompatibility(twenty, facts[41]))
    assert class_id_incompatibility(load_protocol("rooms-instance"), facts[41]) is None
    assert class_id_incompatibility(load_protocol("class-agnostic-segment3d"), facts[41]) is None
    for without in (None, np.zeros(0, np.int64)):
        assert class_id_incompatibility(two_hundred, replace(facts[40], class_ids=without)) is None


@pytest.mark.parametrize(
    ("form", "labels", "needs_encoder"),
    [
        ("instances", "all", False), ("instances", "some", True), ("instances", "none", True),
        ("vertex-masks", "all", False), ("vertex-masks", "some", False), ("vertex-masks", "none", True),
    ],
)  # fmt: skip
def test_encoder_is_required_if_features_replace_names(form: Form, labels: str, needs_encoder: bool) -> None:
    facts = ContentFacts(form, 3, 512, has_labels=labels != "none", has_every_label=labels == "all")
    rules = load_protocol("rooms-semantic")
    assert n_feature_dimensions(rules, facts) == (512 if needs_encoder else None)
    assert n_feature_dimensions(rules, replace(facts, n=0)) is None
    assert n_feature_dimensions(load_protocol("class-agnostic-open3dis"), facts) is None
    assert n_feature_dimensions(load_protocol("rooms-annotation"), facts) is None
    compares_texts = n_feature_dimensions(load_protocol("query-ap"), facts)
    assert compares_texts == (512 if needs_encoder or form == "instances" else None)


def test_misspelt_name_gives_a_suggestion() -> None:
    with pytest.raises(ConfigError, match="unknown protocol 'rooms-semantics'; did you mean 'rooms-semantic'\\?"):
        load_protocol("rooms-semantics")


def test_names_and_versions_are_no_differences(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    lines = ['extends = "rooms-instance"', 'name = "mine"', "version = 7", "min_region_size = 7", "[transfer]"]
    path.write_text("\n".join([*lines, "cap_m = 0.5"]))
    rules = load_protocol("rooms-instance")
    found = {row["rule"]: (row["first"], row["second"]) for row in rule_differences(rules, load_protocol(str(path)))}
    assert found == {"min_region_size": (rules.min_region_size, 7), "transfer.cap_m": (rules.transfer.cap_m, 0.5)}
    assert rule_differences(rules, rules) == []


def test_protocols_of_two_kinds_give_one_line() -> None:
    with pytest.raises(ConfigError, match="rooms-semantic is of kind 'semantic' and rooms-instance of kind"):
        rule_differences(load_protocol("rooms-semantic"), load_protocol("rooms-instance"))
