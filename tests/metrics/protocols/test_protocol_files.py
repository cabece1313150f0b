"""Protocol files: comments on rules, inheritance, and one clear line for an unusable file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.loading import (
    HEADING,
    load_protocol,
    not_comparable_with,
    protocol_names,
    read_remarks,
    remarks_of,
    rules_file,
)


def edited(tmp_path: Path, base: str, old: str, new: str) -> str:
    text = rules_file(base).read_text().replace(f'name = "{base}"', 'name = "mine"')
    text = re.sub(r"^version = \d+$", "version = 1", text, flags=re.MULTILINE)
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new))
    return str(path)


def test_a_protocol_may_be_a_file(tmp_path: Path) -> None:
    assert load_protocol(edited(tmp_path, "rooms-semantic", "version = 1", "version = 7")).version == 7


def test_protocol_file_is_reread_when_it_changes_or_its_path_resolves_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, base in (("first", "rooms-instance"), ("second", "replica-openmask3d")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.toml").write_text(f'extends = "{base}"\nname = "mine"\n')
        monkeypatch.chdir(tmp_path / folder)
        assert load_protocol("mine.toml").datasets == load_protocol(base).datasets
    Path("mine.toml").write_text('extends = "rooms-semantic"\nname = "mine"\n')
    assert load_protocol("mine.toml").kind == "semantic"


def test_a_file_may_list_its_own_classes(tmp_path: Path) -> None:
    rows = '[[40, "floor"], [93, "wall"], [31, "ceiling"], [20, "chair"]]'
    path = edited(tmp_path, "rooms-semantic", 'classes = "rooms"', f"classes = {rows}")
    assert [entry.name for entry in load_protocol(path).scored] == ["chair"]


FAULTS = [
    ("rooms-semantic", 'vocabluary = "all"', "mine.toml:3: unknown key 'vocabluary'; did you mean 'vocabulary'?"),
    ("rooms-semantic", "[transfer]\ncandidate = 1", "unknown key 'transfer.candidate'; did you mean 'candidates'?"),
    ("rooms-semantic", 'colour = "red"', "mine.toml:3: unknown key 'colour'"),
    ("rooms-semantic", 'version = "1"', "mine.toml:3: version: input should be a valid integer, not '1'"),
    ("rooms-semantic", "version = ", "mine.toml: is not valid TOML"),
    ("rooms-semantic", 'classes = "room"', "unknown class table 'room'; did you mean 'rooms'?"),
    ("rooms-semantic", 'classes = [[1, "a"], [2]]', "classes must be a table's name or rows of [id, name]"),
    ("rooms-semantic", 'classes = [[1, "a"], [1, "b"]]', "classes: ids and names must not repeat"),
    ("rooms-semantic", 'prompt = "an image"', "prompt: 'an image' has no {} for the class name"),
    ("rooms-semantic", 'prompts = ["{}"]', "prompt: give either prompt or prompts"),
    ("rooms-semantic", 'ignore = ["flor"]', "'flor' is not a class; did you mean 'floor'?"),
    ("rooms-semantic", 'unnamed = "flor"', "unnamed: 'flor' is not a class; did you mean 'floor'?"),
    ("rooms-semantic", 'headline = ["AP"]', "a protocol of kind 'semantic' has mAcc, mIoU, F-mIoU"),
    ("rooms-semantic", 'metric = "query-ap"', "metric: kind 'semantic' takes 'conceptgraphs' or"),
    ("rooms-semantic", "top_k = 5", "top_k: kind 'semantic' does not take it"),
    ("rooms-semantic", '[transfer]\ncandidates = "map-points"', "kind 'semantic' takes 'object-points'"),
    ("rooms-semantic", "[transfer]\nneighbours = 2\nevaluation_voxel_m = 0.02", "transfer.evaluation_voxel_m: "),
    ("rooms-semantic", '[transfer]\nvotes = "masks"', "transfer.votes: needs more than one neighbour"),
    ("rooms-instance", 'class_agnostic = "scored"', "prompt: these rules compare no features"),
    ("class-agnostic-open3dis", 'labels = "one"', "labels: not allowed if labels are not scored"),
    ("rooms-instance", "thresholds = [0.5]", "thresholds: 0.25 and 0.5 must be among them"),
    ("rooms-instance", 'confidence = "similarity"', "confidence: kind 'instance' takes 'ones' or 'prediction'"),
    ("rooms-instance", "[transfer]\nneighbours = 2", "transfer.neighbours: only for kind 'semantic'"),
    ("opensun3d-queries", "top_k = 5", "top_k: metric 'opensun3d' counts every mask"),
    ("openlex3d-queries", "[transfer]\nevaluation_voxel_m = 0.02", "transfer.evaluation_voxel_m: "),
    ("replica-boxes", "thresholds = [0.25, 0.5, 0.75]", "kind 'boxes' takes (0.25, 0.5)"),
    ("grounding", 'box_axes = "truth"', "box_axes: kind 'grounding' takes 'world' or 'aligned'"),
    ("grounding", "[transfer]\ncap_m = 0.05", "transfer.cap_m: kind 'grounding' has no transfer"),
    ("rooms-presence", "[presence]\nrelevancy = 1.5", "presence.relevancy: input should be less than 1, not 1.5"),
    ("rooms-presence", "[presence]\ncanonicals = []", "key 'presence.canonicals'; did you mean 'canonical'?"),
    ("rooms-presence", 'questions = "dataset"', "questions: kind 'presence' takes 'generated'"),
    ("rooms-relations", 'predicates = ["on", "on"]', "predicates: must not repeat"),
    ("rooms-relations", 'predicates = ["beside"]', "predicates: 'beside' needs more than boxes; use on, under"),
    ("rooms-panoptic", 'stuff = ["walls"]', "stuff: 'walls' is not a scored class; did you mean 'wall'?"),
    ("rooms-reasoning", 'prompt = "{}"', "prompt: these rules compare no features"),
    ("mine.toml", "", "extends itself: mine.toml -> mine.toml"),
    ("other.toml", "", "extends itself: mine.toml -> other.toml -> mine.toml"),
    ("rooms-semantics", "", "mine.toml:1: extends the unknown protocol 'rooms-semantics'; did you mean"),
    ("none.toml", "", "none.toml: cannot be read"),
]


@pytest.mark.parametrize(("base", "rest", "message"), FAULTS, ids=[f"{fault[0]}: {fault[2]}" for fault in FAULTS])
def test_unusable_protocol_file_gives_one_line(tmp_path: Path, base: str, rest: str, message: str) -> None:
    extending(tmp_path, "other", "mine.toml")
    with pytest.raises(ConfigError) as caught:
        load_protocol(extending(tmp_path, "mine", base, rest))
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("base", "old", "message"),
    [
        ("rooms-semantic", "version = 1", "mine.toml: the key 'version' is missing"),
        ("rooms-semantic", 'vocabulary = "scored"', "vocabulary: is missing; kind 'semantic' needs it"),
        ("rooms-instance", "min_region_size = 100", "min_region_size: is missing; kind 'instance' needs it"),
        ("openlex3d-topn", "top_k = 5", "top_k: is missing; kind 'categories' needs it"),
        ("openlex3d-queries", "cap_m = 0.03162277660168379", "transfer.cap_m: kind 'queries' needs one"),
    ],
)
def test_missing_rule_is_reported(tmp_path: Path, base: str, old: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_protocol(edited(tmp_path, base, old, ""))
    assert message in str(caught.value)


def test_comments_of_a_file_are_assigned_to_their_rules(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        '# Heading.\nname = "a # b"  # the name\n# above\nversion = 1  # [X]\n# no encoder: any\nthresholds = [\n'
        "    0.5,\n]\n# of the section\n[transfer]\ncap_m = 1.0\n# no neighbours\n# at the end\n"
    )
    assert read_remarks(path) == {
        "": ["Heading."],
        "name": ["the name"],
        "version": ["above", "[X]"],
        "encoder": ["no encoder: any"],
        "thresholds": [],
        "transfer": ["of the section", "at the end"],
        "transfer.cap_m": [],
        "transfer.neighbours": ["no neighbours"],
    }


@pytest.mark.parametrize("name", {load_protocol(name).kind: name for name in protocol_names()}.values())
def test_show_prints_every_rule_with_its_comment(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["protocols", "show", name]) == 0
    text = capsys.readouterr().out
    rules = load_protocol(name)
    for key in rules.model_dump(exclude={"transfer", "prompt_names", "classes", "merging", "answers", "presence"}):
        assert f"\n{key} " in text
    for line in rules_file(name).read_text().splitlines():
        comment = line.partition("  # ")[2] or line.partition("# ")[2] * line.startswith("#")
        assert comment in text
    assert all(other in text for other in not_comparable_with(rules))


# what a file extends


def extending(folder: Path, name: str, parent: str, rest: str = "") -> str:
    path = folder / f"{name}.toml"
    path.write_text(f'extends = "{parent}"\nname = "{name}"\n{rest}')
    return str(path)


def test_file_cannot_use_the_name_of_a_built_in_protocol(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the protocol name 'rooms-instance' is built in"):
        load_protocol(extending(tmp_path, "rooms-instance", "rooms-semantic"))


def test_a_file_that_extends_another_sets_only_what_differs(tmp_path: Path) -> None:
    rest = 'ignore = ["other"]\n[transfer]\ncap_m = 0.5\n'
    mine = load_protocol(extending(tmp_path, "mine", "replica-conceptgraphs-ex6", rest))
    base = load_protocol("replica-conceptgraphs-ex6")
    assert (mine.ignore, mine.transfer.cap_m, mine.transfer.candidates) == (("other",), 0.5, "object-points")
    assert mine.model_copy(update={"name": base.name, "ignore": base.ignore, "transfer": base.transfer}) == base


def test_files_extend_each_other_by_path_and_the_nearest_has_priority(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    extending(tmp_path, "first", "rooms-semantic", 'version = 3\nprompt = "{}"\n')
    extending(tmp_path / "below", "second", "../first.toml", "version = 4\n")
    third = load_protocol(extending(tmp_path, "third", "below/second.toml"))
    assert (third.name, third.version, third.prompt, third.kind) == ("third", 4, "{}", "semantic")


def test_file_without_a_heading_does_not_inherit_one(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text('# Of the base.\nname = "base"\nversion = 1  # the first\n')
    (tmp_path / "mine.toml").write_text('extends = "base.toml"\nname = "mine"\n# no colour of its own\nversion = 2\n')
    remarks = remarks_of([tmp_path / "mine.toml", tmp_path / "base.toml"])
    assert remarks[HEADING] == ["extends base:", "Of the base."]
    assert remarks["version"] == ["no colour of its own"]  # no rule is called colour
    assert "colour" not in remarks


def test_extends_takes_a_name_or_a_path(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('extends = 3\nname = "mine"\n')
    with pytest.raises(ConfigError, match=r"extends must be a protocol's name or the path of a \.toml file, not 3"):
        load_protocol(str(tmp_path / "mine.toml"))
