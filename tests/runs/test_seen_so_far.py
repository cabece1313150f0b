"""Maps scored against what the frames so far have shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from painted_runs import COLLECTOR, PAINTED, painted_run, see_painted
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, unpack_scores
from su3d_bench.runs.finished import read_run
from su3d_bench.runs.verify import examine
from su3d_bench.store.run_folder import RunFolder

NOISY = f"{SCENES}/painted.py:Noisy"
PROTOCOLS = ("rooms-semantic", "rooms-instance", "rooms-panoptic", "rooms-retrieval", "rooms-reasoning")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seen") / "run"
    more = ("--anytime", "0.5", "0.1", "--seen-so-far", "--protocols", *PROTOCOLS)
    return painted_run(folder, *more, methods=(COLLECTOR, "oracle"))


def results(run: Path) -> dict[tuple[str, str], Any]:
    return {(one["method"], one["protocol"]): one for one in json.loads((run / "metrics.json").read_text())["results"]}


def headline(metrics: dict[str, Any], result: Any) -> list[float | None]:
    return [metrics[name] for name in result["headline"]]


def assert_perfect(of_run: dict[tuple[str, str], Any]) -> None:
    for protocol in PROTOCOLS[:3]:
        own, perfect = of_run["collector", protocol], of_run["oracle", protocol]
        assert [point["share"] for point in perfect["seen"]] == [point["share"] for point in own["seen"]]
        for point, of_map in zip(perfect["seen"], own["seen"], strict=True):
            assert headline(point["metrics"], perfect) == [1.0] * len(perfect["headline"])
            assert headline(of_map["ceiling"], own) == [1.0] * len(own["headline"])
        assert set(perfect["areas"]["seen"].values()) == {1.0}


def test_oracle_scores_one_at_every_point(run: Path) -> None:
    of_run = results(run)
    assert [point["share"] for point in of_run["oracle", "rooms-instance"]["seen"]] == [0.1, 0.5, 1.0]
    assert_perfect(of_run)


def test_oracle_scores_one_at_every_point_of_a_recording(tmp_path: Path) -> None:
    """A home in ScanNet's format: compressed colour, depth in millimetres, rounded poses, annotated segments."""
    data, run = tmp_path / "data", tmp_path / "run"
    small = "--set n_frames=24 width=160 height=120 mesh_spacing_m=0.05"
    assert main(f"datasets make homes --layout scannet --out {data} --scenes seed0 {small}".split()) == 0
    words = f"run scannet/* --data {data} --methods oracle opensu3d --profile oracle --stride 4 --anytime-every 2"
    assert main(f"{words} --seen-so-far --no-pictures --jobs 1 --out {run}".split()) == 0
    perfect = results(run)["oracle", "scannet200-instance"]
    assert [point["n_updates"] for point in perfect["seen"]] == [2, 4, 0]
    assert all(headline(point["metrics"], perfect) == [1.0, 1.0, 1.0] for point in perfect["seen"])


def test_areas_are_those_under_the_curves(run: Path) -> None:
    result = results(run)["collector", "rooms-semantic"]
    assert result["areas"]["anytime"].keys() == result["areas"]["seen"].keys() == set(result["headline"])
    shares = [0.1, 0.5, 1.0]
    values = [point["metrics"]["mAcc"] for point in result["seen"]]
    area = sum((b - a) * (x + y) / 2 for a, b, x, y in zip(shares, shares[1:], values, values[1:], strict=False)) / 0.9
    assert result["areas"]["seen"]["mAcc"] == pytest.approx(area)


def test_questions_about_the_whole_scene_are_not_scored_against_a_part(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of_run = results(run)
    retrieval = of_run["collector", "rooms-retrieval"]
    n_asked = [point["metrics"]["n_all"] for point in retrieval["seen"]]
    assert n_asked == sorted(n_asked) and 0 < n_asked[-1] <= retrieval["result"]["metrics"]["n_all"]
    assert of_run["collector", "rooms-reasoning"]["seen"] == []
    capsys.readouterr()
    again = ["run", *(f"{PAINTED}/{scene}" for scene in "ab"), "--methods", COLLECTOR, "oracle", "--jobs", "1"]
    before = (run / "metrics.json").read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        more = ["--anytime", "0.1", "0.5", "--seen-so-far", "--protocols", *PROTOCOLS, "--no-pictures"]
        assert main([*again, *more, "--out", str(run)]) == 0
    line = "rooms-reasoning: not scored against what was seen: kind 'reasoning' needs the complete scene"
    assert line in capsys.readouterr().err
    assert (run / "metrics.json").read_bytes() == before


@pytest.mark.parametrize("changed", ["metrics", "ceiling", "areas"])
def test_changed_value_of_a_curve_contradicts_the_counts(run: Path, tmp_path: Path, changed: str) -> None:
    assert examine(read_run(run))[1] == ()
    copy = shutil.copytree(run, tmp_path / "copy")
    metrics = json.loads((copy / "metrics.json").read_text())
    result = next(one for one in metrics["results"] if one["protocol"] == "rooms-semantic")
    (result["areas"]["seen"] if changed == "areas" else result["seen"][1][changed])["mAcc"] = 0.125
    (copy / "metrics.json").write_text(json.dumps(metrics))
    (fault,) = (fault for _, fault in examine(read_run(copy))[1])
    place = {"metrics": "seen.0.5.map", "ceiling": "seen.0.5.ceiling", "areas": "areas.seen"}[changed]
    assert f"{place}.mAcc is 0.125, the counts give" in fault


def test_map_of_every_few_updates_is_scored_and_a_shorter_scene_counts_with_its_last(tmp_path: Path) -> None:
    """With noisy depth that has holes: scene a has 6 frames, b has 3."""
    names = ["run", f"{NOISY}/a", f"{NOISY}/b", "--methods", COLLECTOR, "oracle", "--protocols", *PROTOCOLS[:3]]
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        more = ["--anytime-every", "2", "--seen-so-far", "--no-pictures", "--jobs", "1", "--quiet"]
        assert main([*names, *more, "--out", str(tmp_path / "run")]) == 0
    of_run = results(tmp_path / "run")
    assert_perfect(of_run)
    result = of_run["collector", "rooms-semantic"]
    whole, seen = (result[curve][0]["metrics"] for curve in ("anytime", "seen"))
    assert seen["mAcc"] == 1 > whole["mAcc"]  # the chair was not shown yet
    assert seen["n_classes"] == 2 and result["seen"][-1]["metrics"]["n_classes"] == whole["n_classes"] == 3
    assert [(point["n_updates"], round(point["share"], 3)) for point in result["anytime"]] == [(2, 0.333), (4, 0.667)]
    assert [point["n_updates"] for point in result["seen"]] == [2, 4, 0]
    jobs = {scene: RunFolder(tmp_path / "run").job(f"noisy/{scene}", "collector") for scene in "ab"}
    assert sorted(file.name for file in jobs["b"].path.glob("*-counts.npz")) == [
        "anytime-2-counts.npz", "ceiling-2-counts.npz", "ceiling-counts.npz", "seen-2-counts.npz", "seen-counts.npz"
    ]  # fmt: skip
    for curve, last in (("anytime", "counts.npz"), ("seen", "seen-counts.npz")):
        files = {"a": jobs["a"].path / f"{curve}-4-counts.npz", "b": jobs["b"].path / last}
        counts = {scene: unpack_scores(file.read_bytes())["rooms-semantic"] for scene, file in files.items()}
        expected = combine(load_protocol("rooms-semantic"), counts).metrics["mAcc"]
        assert result[curve][1]["metrics"]["mAcc"] == expected
    assert examine(read_run(tmp_path / "run"))[1] == ()
    assert main(["report", "timing", str(tmp_path / "run"), "--out", str(tmp_path / "timing"), "--quiet"]) == 0


def test_fractions_and_a_number_of_updates_exclude_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", f"{PAINTED}/a", "--anytime", "0.5", "--anytime-every", "2"]) == 2
    assert "--anytime-every: anytime_every = 2: not together with anytime" in capsys.readouterr().err
