"""One label per mask or point, or the most likely of several: detected, reported with values, never mixed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from evaluated_text import CHAIR, TABLE, document, numbers, scene, write_truth
from painted import WordEncoder
from prediction_files import write_scannet_text

import su3d_bench.evaluation.evaluate
from su3d_bench.analysis.leaderboard import leaderboard
from su3d_bench.cli.main import main
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances, Masks
from su3d_bench.evaluation.evaluate import Scoring
from su3d_bench.metrics.compatibility import ContentFacts, labels_counted, under_several_labels
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.predictions.base import ScenePrediction

if TYPE_CHECKING:
    from su3d_bench.evaluation.ground_truth import SceneTruths

ONE = scene([CHAIR, TABLE], [5, 7])
PAIRS = scene([CHAIR, CHAIR, TABLE, TABLE], [5, 6, 7, 4], [0.9, 0.4, 0.8, 0.3])


def evaluated(folder: Path, name: str, written: dict[str, Any], *more: str) -> None:
    """A run ``name`` in ``folder`` with masks over the small scene."""
    write_truth(folder / "gt")
    write_scannet_text(folder / f"pred-{name}", written)
    words = ["evaluate", str(folder / f"pred-{name}"), "--ground-truth", str(folder / "gt"), "--quiet"]
    words += ["--protocols", *(more or ("scannet-instance",)), "--out", str(folder / "runs" / name), "--name", name]
    assert main(words) == 0


def test_mask_has_several_labels_only_with_a_different_label() -> None:
    masks = Masks.of_sets([np.array(one) for one in ([0, 1], [0, 1], [0, 1, 2], [], [], [3], [3])])
    found = under_several_labels(masks, [5, 6, 5, 1, 2, 8, 8])
    assert found.tolist() == [True, True, False, False, False, False, False]


@pytest.mark.parametrize(
    ("name", "by_features", "are_several", "printed"),
    [
        ("scannet-instance", False, False, "one label"),
        ("scannet-instance", False, True, "the top labels of a mask"),
        ("scannet-semantic", True, True, "one label"),
        ("openlex3d-topn", True, False, "the top 5 labels"),
        ("openlex3d-topn", False, False, "one label"),
        ("openlex3d-ranking", True, False, None),
        ("class-agnostic-open3dis", False, True, None),
        ("query-ap", True, False, None),
        ("rooms-retrieval", True, False, None),
    ],
)
def test_each_kind_of_protocol_states_its_number_of_labels(
    name: str, by_features: bool, are_several: bool, printed: str | None
) -> None:
    assert labels_counted(load_protocol(name), by_features=by_features, are_several=are_several) == printed


def test_masks_with_several_labels_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_truth(tmp_path / "gt")
    for written, expected in ((ONE, "one label"), (PAIRS, "the top labels of a mask")):
        write_scannet_text(tmp_path / "pred", written)
        assert numbers(tmp_path)["labels"] == expected
        assert main(["evaluate", str(tmp_path / "pred"), "--ground-truth", str(tmp_path / "gt"), "--quiet"]) == 0
        assert f"counted per mask or point: {expected}" in capsys.readouterr().out
    assert numbers(tmp_path, "class-agnostic-open3dis")["labels"] is None


def test_ranking_has_one_number_of_labels_and_lists_the_excluded_entries(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, written in (("a", ONE), ("b", PAIRS), ("c", ONE)):
        evaluated(tmp_path, name, written)
    found = leaderboard(tmp_path / "runs")
    assert [[one.run for one in board] for board in found.boards] == [["a", "c"]]
    assert {one.labels for one in found.boards[0]} == {"one label"}
    (refused,) = found.refused
    assert (refused.run, refused.what) == ("b", "b / scannet-instance")
    assert refused.reason == "uses the top labels of a mask; 2 of 3 entries use one label"
    capsys.readouterr()
    assert main(["report", "leaderboard", str(tmp_path / "runs")]) == 0
    shown = capsys.readouterr().out
    assert "Labels: one label." in shown and "Excluded: b, b / scannet-instance: uses the top labels" in shown


def test_comparison_of_one_label_with_several_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, written in (("a", ONE), ("b", PAIRS)):
        evaluated(tmp_path, name, written, "scannet-instance", "class-agnostic-open3dis")
    capsys.readouterr()
    runs = [str(tmp_path / "runs/a:a"), str(tmp_path / "runs/b:b")]
    assert main(["compare", *runs, "--protocols", "scannet-instance"]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "scannet-instance uses one label and the top labels of a mask; give both predictions the same number" in line
    assert main(["compare", *runs, "--protocols", "class-agnostic-open3dis"]) == 0
    capsys.readouterr()
    assert main(["report", "tables", str(tmp_path / "runs/a"), str(tmp_path / "runs/b")]) == 2
    assert "uses one label and the top labels of a mask" in capsys.readouterr().err


@pytest.mark.parametrize(("labels", "fits", "fails"), [("one", ONE, PAIRS), ("top-k", PAIRS, ONE)])
def test_custom_rules_may_accept_only_one_of_the_two(
    tmp_path: Path, labels: str, fits: dict[str, Any], fails: dict[str, Any]
) -> None:
    rules = tmp_path / "mine.toml"
    rules.write_text(f'extends = "scannet-instance"\nname = "mine"\nlabels = "{labels}"\n')
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", fits)
    assert document(tmp_path, str(rules))["protocols"]["mine"]["metrics"]["ap"] is not None
    write_scannet_text(tmp_path / "pred", fails)
    with pytest.raises(PredictionError, match=r"mine: takes .* of a mask, and (the same masks|each mask)"):
        document(tmp_path, str(rules))


def test_scenes_with_one_label_mixed_with_five_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = load_protocol("openlex3d-topn")
    truths = cast("SceneTruths", SimpleNamespace(has_points=True, incompatibility=lambda *_, **__: None))
    scoring = Scoring(truths, [rules.name], None, file_confidences=False)
    monkeypatch.setattr(scoring, "_score_content", lambda *_: None)
    monkeypatch.setattr(su3d_bench.evaluation.evaluate, "encoder_for", lambda *_, **__: WordEncoder())
    points = np.zeros((4, 3), np.float32)
    ranked = Instances.of(points, [[0, 1], [2]], features=np.ones((2, 4)))
    named = Instances.of(points, [[0, 1], [2]], labels=["chair", "lamp"], features=np.ones((2, 4)))

    def scored(name: str, content: Instances) -> str | None:
        return scoring._score(rules, name, ScenePrediction(name, "x", Path("x"), content), ContentFacts.of(content))

    assert [scored("a", ranked), scored("b", ranked)] == [None, None]
    assert (
        scored("c", named)
        == "gives one label per point, but earlier scenes the top 5 labels; use the same number in all scenes"
    )
