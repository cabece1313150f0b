"""Headline values of groups of classes, such as "AP novel": hand-worked values, and all commands that show them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from painted_runs import COLLECTOR, painted_page, painted_run, see_painted

from su3d_bench.analysis.comparison import compare
from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances, Masks
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.attribution.arrays import Pool, single_mask_errors, single_point_errors
from su3d_bench.metrics.attribution.masks import LabelledPoints, count_masks
from su3d_bench.metrics.attribution.overlaps import LabelledMasks, ScoringRules, measure_overlaps, true_instances
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, metric_of, score_scene
from su3d_bench.metrics.semantic.confusion import per_scene
from su3d_bench.numerics.statistics import leave_one_out

INSTANCE, SEMANTIC = load_protocol("homes-instance"), load_protocol("homes-semantic")
LABELS = LabelSet("homes", tuple(c.id for c in INSTANCE.classes), tuple(c.name for c in INSTANCE.classes))
ID = {entry.name: entry.id for entry in INSTANCE.classes}
SIZE = 200  # points per object
GROUPS = '[[20, "chair", "base"], [76, "sofa", "novel"], [80, "table", "base"], [93, "wall", "base"]]'


def scene(objects: Sequence[str], found: Mapping[int, str]) -> tuple[GroundTruth, Instances]:
    """Objects in a row of points 1 cm apart; ``found``: the number of a complete mask's object -> its label."""
    n = SIZE * len(objects)
    points = np.column_stack([0.01 * np.arange(n), np.zeros(n), np.zeros(n)]).astype(np.float32)
    semantic = np.repeat([ID[name] for name in objects], SIZE).astype(np.int32)
    instance = np.repeat(np.arange(len(objects)) + 1, SIZE).astype(np.int32)
    truth = GroundTruth(points, semantic, instance, LABELS, "mesh-vertices", "made for a test")
    masks = [np.flatnonzero(instance == k + 1) for k in found]
    return truth, Instances.of(points, masks, np.ones(len(masks)), labels=list(found.values()))


# base: chair and table; novel: kettle and vase
FULL = scene(("chair", "kettle", "vase"), {0: "chair", 2: "vase"})  # the kettle is missed
BASE = scene(("chair", "chair", "table"), {0: "chair", 2: "chair"})  # a chair is missed, the table is called a chair
SCENES = {"full": FULL, "base": BASE, "again": FULL}


def scores(rules: ProtocolRules) -> dict[str, SceneScore]:
    return {name: score_scene(rules, *made, None) for name, made in SCENES.items()}


def test_classes_of_homes_are_in_two_groups() -> None:
    assert {ID[name] for name in ("chair", "table")} <= {INSTANCE.scored[k].id for k in INSTANCE.groups["base"]}
    assert {INSTANCE.scored[k].name for k in INSTANCE.groups["novel"]} >= {"kettle", "vase"}
    assert {"AP base", "AP novel", "AP50 novel"} <= {*INSTANCE.value_names}
    assert {"mAcc base", "mAcc novel", "mIoU novel"} <= {*SEMANTIC.value_names}
    assert not load_protocol("rooms-instance").group_headline


def test_instance_values_of_groups_are_those_worked_by_hand() -> None:
    result = combine(INSTANCE, scores(INSTANCE))
    # of 4 chairs 3 are found among 4 masks of equal score: recall 3/4, (1 + precision 3/4) / 2; the table has no mask
    chair, table, kettle, vase = 3 / 4 * (1 + 3 / 4) / 2, 0.0, 0.0, 1.0
    assert result.metrics["AP base"] == pytest.approx((chair + table) / 2)
    assert result.metrics["AP novel"] == pytest.approx((kettle + vase) / 2)
    assert result.metrics["AP"] == pytest.approx((chair + table + kettle + vase) / 4)
    assert result.groups["novel"]["AP"] == pytest.approx(result.metrics["AP novel"])
    of_scene = result.per_scene
    assert (of_scene["full"]["AP base"], of_scene["full"]["AP novel"]) == (1.0, 0.5)
    assert of_scene["base"]["AP base"] == pytest.approx((1 / 2 * (1 + 1 / 2) / 2 + 0) / 2)
    assert np.isnan(of_scene["base"]["AP novel"])


def test_semantic_values_of_groups_are_those_worked_by_hand() -> None:
    result = combine(SEMANTIC, scores(SEMANTIC))
    # without a cap every point has the class of the nearest mask: in FULL the kettle is half chair, half vase; in BASE
    # the second chair is a chair
    assert result.metrics["mAcc base"] == pytest.approx((1 + 0) / 2)
    assert result.metrics["mAcc novel"] == pytest.approx((0 + 1) / 2)
    assert result.per_scene["full"]["mAcc base"] == 1.0
    assert result.per_scene["base"]["mAcc base"] == pytest.approx(0.5)
    assert result.per_scene["full"]["mAcc novel"] == pytest.approx(0.5)
    assert np.isnan(result.per_scene["base"]["mAcc novel"])


@pytest.mark.parametrize("rules", [INSTANCE, SEMANTIC], ids=lambda rules: rules.kind)
def test_group_values_without_a_scene_are_those_of_the_other_scenes(rules: ProtocolRules) -> None:
    each = scores(rules)
    counts, rows = [one.counts for one in each.values()], list(combine(rules, each).per_scene.values())
    left_out = metric_of(rules).resampled_headline(counts, rows, leave_one_out(len(each)))
    assert tuple(left_out) == rules.headline
    subsets = [each, *({name: one for name, one in each.items() if name != without} for without in each)]
    for name, values in left_out.items():
        expected = [combine(rules, subset).metrics[name] for subset in subsets]
        assert values == pytest.approx(expected, abs=1e-12)
    of_class = metric_of(rules).resampled_classes(counts, np.eye(len(each), dtype=np.int64))
    column = "AP" if rules is INSTANCE else "recall"
    assert np.isnan(of_class["vase"][column][1]) and of_class["vase"][column][0] == 1.0


@pytest.mark.parametrize("rules", [INSTANCE, SEMANTIC], ids=lambda rules: rules.kind)
def test_ground_truth_scores_1_in_both_groups(rules: ProtocolRules) -> None:
    objects = ("chair", "kettle", "table")
    result = combine(rules, {"one": score_scene(rules, *scene(objects, dict(enumerate(objects))), None)})
    assert [result.metrics[name] for name in rules.headline] == [1.0] * len(rules.headline)


def test_a_corrected_mask_raises_its_own_group_only() -> None:
    scoring = ScoringRules((ID["chair"], ID["kettle"]), 100, INSTANCE.thresholds)
    rules = INSTANCE.model_copy(
        update={"classes": tuple(entry for entry in INSTANCE.classes if entry.name in ("chair", "kettle"))}
    )
    truth = np.repeat([1000 * ID["chair"] + 1, 1000 * ID["kettle"] + 2], SIZE)
    masks = LabelledMasks(Masks.of_sets([np.arange(SIZE)]), np.array([ID["chair"]]), np.array([0.8]))
    overlaps = measure_overlaps(true_instances(truth, scoring), masks, scoring)
    pool = Pool(metric_of(rules), count_masks(truth, masks, scoring), [])
    (missed,) = single_mask_errors(truth, overlaps, scoring, pool)
    assert missed.kind == "missed"
    assert missed.gains == {"AP": 0.5, "AP50": 0.5, "AP25": 0.5, "AP base": 0.0, "AP novel": 1.0}


def test_corrected_points_raise_their_own_group_only() -> None:
    chair, kettle = ([entry.name for entry in SEMANTIC.classes].index(name) for name in ("chair", "kettle"))
    true, called = np.repeat([chair, kettle], 10), np.repeat([chair, chair], 10)
    counted = np.isin(np.arange(len(SEMANTIC.classes)), [chair, kettle])
    points = LabelledPoints(true, called, true >= 0, true, np.repeat([0, 1], 10), np.zeros(20), called)
    pool = Pool(metric_of(SEMANTIC), per_scene(true, called, counted), [])
    _, (error,) = single_point_errors(points, counted, pool, has_masks=True, most=9)
    assert error.gains["mAcc novel"] == 1.0 and error.gains["mAcc base"] == 0.0
    assert error.gains["mAcc"] == pytest.approx(0.5)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs under rules with two groups; ``worse`` lacks the chair, a base class."""
    folder = tmp_path_factory.mktemp("groups")
    rules = []
    for kind, headline in (("instance", ("AP", "AP base", "AP novel")), ("semantic", ("mAcc base", "mAcc novel"))):
        rules.append(str(folder / f"grouped-{kind}.toml"))
        lines = [
            f'extends = "rooms-{kind}"',
            f'name = "grouped-{kind}"',
            "version = 1",
            f"classes = {GROUPS}",
            'ignore = ["wall"]',
        ]
        Path(rules[-1]).write_text("\n".join([*lines, f"headline = {json.dumps(headline)}"]))
    for name, settings in (("whole", "drop=0"), ("worse", "drop=1")):
        more = "--quiet", "--set", f"collector.{settings}", "--protocols", *rules
        painted_run(folder / name, *more, methods=(COLLECTOR, "oracle"), scenes="abc")
    return folder


def test_comparison_has_the_values_of_both_groups(runs: Path) -> None:
    found = compare(str(runs / "whole"), str(runs / "worse"), method="collector")
    instance, semantic = (one.metrics for one in found.protocols)
    assert instance["AP base"].difference == pytest.approx(-0.5)  # one of two base classes
    assert instance["AP novel"].difference == 0.0
    assert semantic["mAcc base"].difference < 0.0 == semantic["mAcc novel"].difference


VERBS = {
    "table": ["report", "tables", "{whole}"],
    "latex": ["report", "tables", "{whole}", "--format", "latex"],
    "attribution": ["report", "attribution", "{worse}", "--method", "collector"],
    "compare": ["compare", "{whole}:collector", "{worse}:collector", "--per-class"],
    "power": ["report", "power", "{worse}"],
    "leaderboard": ["report", "leaderboard", "{runs}"],
}


@pytest.mark.parametrize("verb", VERBS)
def test_commands_show_the_values_of_both_groups(
    verb: str, runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    see_painted(monkeypatch)
    places = {"runs": runs, **{name: runs / name for name in ("whole", "worse")}}
    assert main([word.format(**places) for word in VERBS[verb]]) == 0, capsys.readouterr().err
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("AP base", "AP novel", "mAcc base", "mAcc novel")), shown


def test_page_shows_the_values_of_both_groups(runs: Path, tmp_path: Path) -> None:
    page = painted_page(runs / "worse", tmp_path / "page.html")
    assert "AP base" in page and "mAcc novel" in page
