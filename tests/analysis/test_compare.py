"""Comparison of two runs: differences, intervals and tests with hand-computed values, and incomparable runs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted_runs import consistent, painted_run
from scored_room import noisy_scores

from su3d_bench.analysis.comparison import Difference, compare, difference_of
from su3d_bench.analysis.sides import Numbers
from su3d_bench.cli.main import main
from su3d_bench.core.errors import Su3dError
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import metric_of, pack_scores
from su3d_bench.numerics.statistics import SignFlipTest, sign_flip_test
from su3d_bench.reports.tables.comparison import comparison_tables
from su3d_bench.reports.tables.formats import markdown
from su3d_bench.store.run_folder import RunFolder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``a``: all objects found; ``b``: one object dropped; ``few``: as ``b``, two scenes."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for out, scenes, more in (
            ("a", "abc", []),
            ("b", "abc", ["--set", "collector.drop=1"]),
            ("few", "bd", ["--set", "collector.drop=1"]),
            ("other-data", "abc", ["--set", "painted.n_frames=5"]),
        ):
            painted_run(Path(out), "--quiet", *more, scenes=scenes)
        copy_as("a", "other-encoder", "run.json", lambda text: text.replace("words-1", "words-2"))
        consistent(Path("other-encoder"))
        copy_as(
            "a", "other-rules", "run.json", lambda one: one.replace(load_protocol("rooms-instance").digest, "0" * 64)
        )
        copy_as("a", "old-rules", "run.json", lambda text: text.replace('"version": ', '"version": 9'))
    return folder


def copy_as(source: str, target: str, file: str, change: Callable[[str], str]) -> None:
    shutil.copytree(source, target)
    text = Path(target, file).read_text()
    assert change(text) != text
    Path(target, file).write_text(change(text))


@pytest.fixture(autouse=True)
def _in_folder(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)


def metrics(run: str) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(Path(run, "metrics.json").read_text())
    return {one["protocol"]: one["result"] for one in loaded["results"]}


def test_differences_match_the_metrics_of_both_runs() -> None:
    found = compare("a", "b")
    assert [one.protocol for one in found.protocols] == ["rooms-semantic", "rooms-instance"]
    for one in found.protocols:
        before, after = metrics("a")[one.protocol], metrics("b")[one.protocol]
        assert one.scenes == ("painted/a", "painted/b", "painted/c")
        for name, value in one.metrics.items():
            assert (value.left, value.right) == (before["metrics"][name], after["metrics"][name])
            assert value.difference == value.right - value.left
            singles = {s: after["per_scene"][s][name] - before["per_scene"][s][name] for s in one.scenes}
            assert value.per_scene == singles
            assert value.mean_of_scenes == pytest.approx(sum(singles.values()) / 3)
            if value.interval is not None:  # None if all scenes differ equally
                middle = sum(value.interval) / 2
                assert -1 in value.interval or 1 in value.interval or middle == pytest.approx(value.difference)
            assert value.test == sign_flip_test(np.array(list(singles.values())))
    assert found.protocols[1].metrics["AP"].difference < 0
    assert "assuming symmetric differences" in markdown(comparison_tables(found.to_json()))


def test_interval_is_a_jackknife_over_scenes() -> None:
    counts: list[dict[str, dict[str, SceneScore]]] = []
    is_inside = []
    for run, first in (("a", 0), ("b", 3)):  # painted scenes are too similar: these differ, more in one run
        shutil.copytree(run, f"noisy-{run}")
        made = {
            name: list(noisy_scores(name, first + 3).values())[first:] for name in ("rooms-semantic", "rooms-instance")
        }
        counts.append({name: dict(zip("abc", scores, strict=True)) for name, scores in made.items()})
        for k, scene in enumerate("abc"):
            packed = pack_scores({name: scores[k] for name, scores in made.items()})
            RunFolder(Path(f"noisy-{run}")).job(f"painted/{scene}", "collector").counts.write_bytes(packed)
        consistent(Path(f"noisy-{run}"))
    for one in compare("noisy-a", "noisy-b").protocols:
        metric = metric_of(load_protocol(one.protocol))
        for name, value in one.metrics.items():
            pseudo = []
            for left_out in "abc":
                values = [
                    metric.reported([score.counts for scene, score in side[one.protocol].items() if scene != left_out])
                    for side in counts
                ]
                pseudo.append(3 * value.difference - 2 * (values[1][name] - values[0][name]))
            half = 4.302652729911275 * np.std(pseudo, ddof=1) / np.sqrt(3)  # Student's t, 2 degrees of freedom
            expected = (max(-1.0, value.difference - half), min(1.0, value.difference + half))
            assert value.interval == pytest.approx(expected, abs=1e-9)
            is_inside.append(-1 < expected[0] < expected[1] < 1)
    assert any(is_inside)


def test_p_of_all_is_corrected_for_all_differing_metrics() -> None:
    found = [value for one in compare("a", "b").protocols for value in one.metrics.values()]
    differing = [value for value in found if any(value.per_scene.values())]
    assert len(differing) > 1
    assert {value.p_of_all for value in differing} == {min(1.0, 0.25 * len(differing))}  # every p is 0.25
    assert {value.p_of_all for value in found if value not in differing} <= {None}
    classes = compare("a", "b", protocols=["rooms-instance"], per_class=True).protocols[0].classes
    assert classes["chair"]["AP"].p_of_all == pytest.approx(0.75)  # three columns of one class differ
    assert classes["sofa"]["AP"].p_of_all is None


def changed_by(changes: list[float], interval: tuple[float, float] | None) -> Difference:
    each: Float64Array = np.array(changes)
    values = np.zeros(len(each) + 1)
    left, right = Numbers(0.5, 0 * each, values, None), Numbers(0.6, each, values, None)
    return replace(difference_of(left, right, [f"s/{k}" for k in range(len(each))]), interval=interval)


DISAGREEMENTS: list[tuple[list[float], tuple[float, float] | None, str | None]] = [
    ([0.1, 0.1, 0.12], (0.08, 0.13), "smallest possible p with 3 scenes is 0.25: no significant difference"),
    ([0.1] * 8, (0.05, 0.15), None),
    ([0.1, -0.1] * 4, (0.01, 0.1), "the test does not find a difference (p 1)"),
    ([0.1] * 8, (-0.05, 0.15), "the test finds a difference (p 0.0078)"),
    ([0.1] * 8, (-0.15, -0.05), "have opposite signs, both significant (p 0.0078)"),
    ([0.1] * 8, None, None),
]


@pytest.mark.parametrize(("changes", "interval", "words"), DISAGREEMENTS)
def test_interval_that_contradicts_the_test_is_explained(
    changes: list[float], interval: tuple[float, float] | None, words: str | None
) -> None:
    found = changed_by(changes, interval).disagreement
    assert (found is None) == (words is None)
    assert words is None or words in (found or "")


def test_swapping_the_sides_only_changes_signs() -> None:
    forth, back = compare("a", "b"), compare("b", "a")
    for one, other in zip(forth.protocols, back.protocols, strict=True):
        for name in one.metrics:
            left, right = one.metrics[name], other.metrics[name]
            assert left.difference == -right.difference
            assert left.test == right.test
            assert (left.interval is None) == (right.interval is None)
            turned = right.interval and (-right.interval[1], -right.interval[0])
            np.testing.assert_allclose(left.interval or (0, 0), turned or (0, 0), atol=1e-12)
            assert left.p_of_all == right.p_of_all


def test_only_common_scenes_are_compared_with_a_remark() -> None:
    found = compare("a", "few", protocols=["rooms-instance"]).protocols[0]
    assert found.scenes == ("painted/b",)
    assert found.metrics["AP"].interval is None
    assert found.metrics["AP"].test == SignFlipTest(1.0, 1.0, 1, True)
    assert "only common scenes are compared; only a:collector has painted/a, painted/c" in found.remarks
    text = markdown(comparison_tables(compare("a", "few").to_json()))
    assert "only few:collector has painted/d" in text
    assert "a single scene says nothing about other scenes" in text


REFUSED = [
    (
        ("a", "other-data"),
        "a:collector and other-data:collector cannot be compared: data digest of painted/a is ",
    ),
    (("a", "other-rules"), "other-rules: collector / scene painted/a: the rules of rooms-instance in run.json are"),
    (("a", "old-rules"), "was scored under rooms-semantic version 92, now it is version 2"),
    (("a", "other-encoder"), "cannot be compared: encoder is words (words-1) and words (words-2)"),
    (("a", "a"), "a: both sides are the same; name two runs, or two methods of one run as a:METHOD"),
    (("a:oracle", "a:oracle"), "a:oracle: both sides are the same"),
    (("a", "b:colector"), "b: has no scores of the method 'colector'; did you mean 'collector'?"),
    (("a", "b:../../b/scenes/painted.a/collector"), "b: has no scores of the method '../../b/scenes"),
    (("a", "nowhere"), "nowhere: no such folder; give the folder of a run, such as runs/my-run"),
]


@pytest.mark.parametrize(("sides", "message"), REFUSED)
def test_incomparable_runs_are_an_error_naming_the_field(sides: tuple[str, str], message: str) -> None:
    with pytest.raises(Su3dError) as caught:
        compare(*sides)
    assert message in str(caught.value)


def test_compare_command_prints_tables_or_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "a", "b", "--protocols", "rooms-instance", "--per-class"]) == 0
    text = capsys.readouterr().out
    row = next(line for line in text.splitlines() if line.startswith("| AP "))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[0] == "AP"
    assert cells[1:5] == ["0.25", "0.75", "0.25", "0 / 0 / 3"]
    assert cells[5] == "100.0"
    assert "| chair | AP " in text
    assert "values of classes without a difference in any scene are omitted" in text
    assert main(["compare", "a", "b", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == compare("a", "b").to_json()
