"""Measures of what the paper claims in words: hand-worked values, missing inputs, and the table of a run."""

from __future__ import annotations

import csv
import io
import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from painted_runs import painted_run, see_painted
from scored_room import ENCODER, OneHotEncoder, instances, room, truth_as_prediction

from su3d_bench.analysis import claims
from su3d_bench.analysis.claims import MEASURES, Claims, claims_table, correlation, largest_first, map_bytes, relevance
from su3d_bench.analysis.claims import spread as spread_of
from su3d_bench.cli.main import main
from su3d_bench.cli.report import QUERY_KINDS
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.score import RefinedNames, RetrievalTruth, TextTarget
from su3d_bench.questions.model import KINDS

TRUTH = room()
CHAIRS = TextTarget("instance", "chair", (2, 3))  # of eight objects
OTHER = TextTarget("relative", "lamp on table", (5,))  # of a kind that is not asked for


def measured(prediction: Prediction, refined: RefinedNames | None = None) -> Claims:
    """The measures of one map with the query "chair"."""
    source: Any = SimpleNamespace(
        prediction=lambda *_: prediction,
        refined=lambda *_: refined,
        rules=lambda *_: load_protocol("rooms-retrieval"),
        truth=lambda *_: TRUTH,
        run=SimpleNamespace(dataset=lambda scene: None),
    )
    one = Claims("run", "method")
    queries = partial(claims._add_queries, kinds=["instance"], encoder=lambda: ENCODER)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(claims, "question_truth", lambda *_: RetrievalTruth(TRUTH, (CHAIRS, OTHER)))
        for add in (claims._add_labels, claims._add_sizes, queries):
            try:
                add(one, source, "a/b")
            except PredictionError as error:
                one.reasons[str(error)] = ["a/b"]
    return one


def test_command_offers_every_kind_of_query() -> None:
    assert QUERY_KINDS == KINDS


@pytest.mark.parametrize("n_rows", [1, 2, 4])
def test_spread_does_not_depend_on_the_blocks(n_rows: int) -> None:
    similarity = np.array([[0.0, 0.3], [0.2, 0.3], [0.4, 0.3], [0.6, 0.3]])
    deviation, extent = spread_of(similarity[k : k + n_rows] for k in range(0, 4, n_rows))
    np.testing.assert_allclose(deviation, [np.sqrt(0.05), 0.0], atol=1e-8)  # (0.3^2 + 0.1^2 + 0.1^2 + 0.3^2) / 4
    np.testing.assert_allclose(extent, [0.6, 0.0], atol=1e-12)


def test_perfect_map_separates_the_chairs_from_six_others() -> None:
    means = measured(truth_as_prediction(TRUTH, with_labels=False)).means
    assert means["similarity SD"] == pytest.approx(np.sqrt(0.25 * 0.75))  # two cosines of 1, six of 0
    assert (means["similarity range"], means["relevant - others"]) == (1.0, 1.0)
    # All have 150 points, so the first instance, the wall, counts as the largest.
    assert (means["largest first"], means["largest first, wrong"], means["largest first by chance"]) == (0, 0, 1 / 8)


def test_largest_instance_that_wins_counts_as_wrong_unless_it_answers() -> None:
    everything, chair = np.arange(450), np.arange(150, 300)  # wall and both chairs, and the first chair
    features = np.stack([OneHotEncoder().feature("chair")] * 2)
    both = measured(instances(TRUTH.points, [everything, chair], None, features)).means
    assert (both["largest first"], both["largest first, wrong"], both["largest first by chance"]) == (1.0, 1.0, 0.5)
    assert both["similarity SD"] == 0.0  # saturated
    alone = measured(instances(TRUTH.points, [chair], None, features[:1])).means
    assert (alone["largest first"], alone["largest first, wrong"], alone["relevant - others"]) == (1.0, 0.0, None)


def test_points_without_feature_do_not_count_for_the_spread() -> None:
    chair, table = (OneHotEncoder().feature(name) for name in ("chair", "table"))
    features = np.stack([chair, table, np.zeros_like(chair)]).astype(np.float16)
    found = measured(DenseFeatures(TRUTH.points[:3], features))
    assert found.means["similarity SD"] == 0.5
    assert found.means["largest first"] is None and found.means["size per instance"] is None
    assert [reason for reason in found.reasons if "largest instance" in reason]
    assert found.means["size per point"] == 12 + 2 * features.shape[1]


def test_partition_has_instances_and_empty_maps_have_reasons() -> None:
    perfect = truth_as_prediction(TRUTH, with_labels=False)
    assert perfect.features is not None
    owner = (TRUTH.instance - 1).astype(np.int32)
    parted = measured(Partition(TRUTH.points, owner, perfect.features))
    assert parted.means["relevant - others"] == 1.0
    assert parted.means["size per point"] == 12 + 4
    assert parted.means["size per instance"] == 4 * perfect.features.shape[1]
    empty = measured(instances(TRUTH.points[:0], [], None, np.zeros((0, ENCODER.dim), np.float32)))
    assert empty.means["similarity SD"] is None and "the map is empty" in empty.reasons
    assert measured(truth_as_prediction(TRUTH, with_labels=True)).means["similarity SD"] is None


def test_lengths_compare_instances_that_have_both_labels() -> None:
    names = ["a red office chair", "table-lamp", "", "wall"]  # articles do not count
    a_map = Instances.of(TRUTH.points, [[k] for k in range(4)], names=names)
    found = measured(a_map, RefinedNames(("office chair", "lamp", "box", "wall"), "the vote", ("", "", "", "big")))
    assert (found.means["length of n"], found.means["length of n'"]) == (2.5, 1.5)
    assert measured(a_map).means["length of n"] is None


def test_ranking_and_relevance_by_hand() -> None:
    similarity = np.array([[0.8, 0.1], [0.2, 0.1], [0.4, 0.7]])
    is_right = np.array([[True, False], [False, False], [True, True]])
    np.testing.assert_allclose(relevance(similarity, is_right), [0.6 - 0.2, 0.7 - 0.1])
    first, wrong = largest_first(similarity, np.array([9, 5, 1]), is_right)
    assert (first.tolist(), wrong.tolist()) == ([True, False], [False, False])


@pytest.mark.parametrize("pairs", [[], [(0.1, 0.2), (0.3, 0.4)], [(0.1, 0.2), (0.3, 0.2), (0.5, 0.2)]])
def test_undefined_correlation_has_a_reason(pairs: list[tuple[float, float]]) -> None:
    with pytest.raises(PredictionError, match="no correlation"):
        correlation(pairs)


def test_correlation_of_opposite_values_is_minus_one() -> None:
    assert correlation([(0.2, 0.9), (0.4, 0.7), (0.6, 0.5)]) == pytest.approx(-1.0)


def test_size_counts_captions_as_long_as_they_are() -> None:
    short, long = (
        map_bytes(Instances.of(TRUTH.points[:2], [[0], [1]], captions=["a", text])) for text in ("b", "c" * 101)
    )
    assert (long[0] - short[0], long[1]) == (100, short[1])


def test_pairs_of_scenes_join_protocols_of_both_datasets() -> None:
    def result(kind: str, **scenes: dict[str, float | None]) -> Any:
        return SimpleNamespace(kind=kind, result=SimpleNamespace(per_scene=scenes))

    results = {
        ("m", "x-reasoning"): result("reasoning", a={"answer": 0.5}, b={"answer": None}, c={"answer": 1.0}),
        ("m", "y-reasoning"): result("reasoning", d={"answer": 0.0}),
        ("m", "x-annotation"): result("annotation", a={"well-merged": 0.8, "label n": 0.1}, b={"well-merged": 0.9}),
        ("m", "y-annotation"): result("annotation", d={"well-merged": 0.6}),
        ("other", "x-annotation"): result("annotation", c={"well-merged": 0.6}),
        ("m", "unscored"): SimpleNamespace(kind="reasoning", result=None),
        ("m", "chains"): result("object-chains", b={"answer": 0.3}),
    }
    run: Any = SimpleNamespace(results=results)
    assert claims._pairs_of(run, "m") == [(0.5, 0.8), (0.0, 0.6)]


def test_table_names_runs_only_if_there_are_several() -> None:
    one, other = Claims("runs/a", "m"), Claims("runs/b", "m")
    one.add("similarity SD", np.array([0.1, np.nan, 0.3]))
    table = claims_table([one])
    assert table.columns == ("unit", "section", "m")
    assert [row.cells[2].text for row in table.rows[:2]] == ["0.200", "-"]
    assert [row.label for row in table.rows] == list(MEASURES)
    one.reasons = other.reasons = {"the map is empty": ["a"]}
    both = claims_table([one, other])
    assert both.columns[2:] == ("m (runs/a)", "m (runs/b)")
    assert both.notes[-1] == "m (runs/a), m (runs/b): the map is empty (a)"


@pytest.mark.parametrize("form", ["text", "latex", "csv"])
def test_run_without_questions_gives_sizes_and_reasons(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = painted_run(tmp_path / "run")
    see_painted(monkeypatch)
    capsys.readouterr()
    assert main(["report", "claims", str(run), "--format", form, "--question-kinds", "relative"]) == 0
    out = capsys.readouterr().out
    assert "size per instance" in out and "no queries" in out and "no correlation" in out
    if form == "csv":
        assert len(list(csv.reader(io.StringIO(out)))) > len(MEASURES)
    if form == "text":
        assert main(["report", "claims", str(run), "--json"]) == 0
        (value,) = json.loads(capsys.readouterr().out)
        assert value["means"].keys() == MEASURES.keys() and value["means"]["similarity SD"] is None
        assert value["counts"]["size of map"] == 2
