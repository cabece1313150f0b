"""The results of a run, and the files that it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from painted import ColourPerception
from painted_runs import COLLECTOR, PAINTED, job, metrics, run, see_painted, words
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import frame_loop as scene_feeding
from su3d_bench.runs import scene as scene_run

pytestmark = pytest.mark.usefixtures("painted_place")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of all four scenes, which no test changes."""
    out = tmp_path_factory.mktemp("finished") / "out"
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert run(out=str(out)) == 0
    return out


def test_run_writes_the_documented_files(finished: Path) -> None:
    names = {path.relative_to(finished).as_posix() for path in finished.rglob("*") if path.is_file()}
    per_job = ("prediction.npz", "counts.npz", "updates.csv", "log.txt", "done.json")
    expected = {f"scenes/painted.{s}/{m}/{f}" for s in "abcd" for m in ("collector", "oracle") for f in per_job}
    assert names == expected | {"run.toml", "run.json", "metrics.json"}
    record = json.loads((finished / "run.json").read_text())
    assert record["status"] == "complete"
    assert record["encoder_digest"] == "words-1"
    assert set(record["data_digests"]) == {f"painted/{scene}" for scene in "abcd"}


def test_perfect_perception_gives_perfect_scores_and_ceilings(finished: Path) -> None:
    for one in metrics(str(finished))["results"]:
        assert one["method"] == "collector"
        assert one["n_planned"] == one["result"]["n_scenes"] == 4
        for name in one["headline"]:
            assert one["result"]["metrics"][name] == 1.0
            assert one["ceiling"][name] == 1.0


def test_repeated_command_does_nothing_and_gives_the_same_bytes(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (finished / "metrics.json").read_bytes()
    monkeypatch.setattr(scene_feeding, "write_prediction", None)
    monkeypatch.setattr(scene_run, "pack_scores", None)
    assert run(out=str(finished)) == 0
    assert (finished / "metrics.json").read_bytes() == before


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not() -> None:
    noise = ("--set", "collector.noise_m=0.02")
    assert run(*noise, scenes="a", out="one") == 0
    assert run(*noise, scenes="a", out="two") == 0
    assert run(*noise, "--seed", "1", scenes="a", out="three") == 0
    assert (job(out="one") / "prediction.npz").read_bytes() == (job(out="two") / "prediction.npz").read_bytes()
    assert Path("one/metrics.json").read_bytes() == Path("two/metrics.json").read_bytes()
    assert (job(out="one") / "prediction.npz").read_bytes() != (job(out="three") / "prediction.npz").read_bytes()


PLUG_IN = (SCENES / "painted.py").read_text().splitlines()


MADE = 1 + next(k for k, line in enumerate(PLUG_IN) if "return Frame(" in line)


CRASHES = 1 + next(k for k, line in enumerate(PLUG_IN) if "a mistake in a plug-in" in line)


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ("missing-frame", "painted/b: frame 2 is missing; copy it again"),
        (
            "nan-pose",
            f"painted/b: painted.py:{MADE}: frame 2: the pose is not a finite 4x4 matrix; drop the frame or fix the "
            "trajectory",
        ),
        ("crash", f"painted/b: painted.py:{CRASHES}: ZeroDivisionError: a mistake in a plug-in"),
    ],
)
def test_failing_scene_does_not_affect_others(fault: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--set", f"painted.fault={fault}", scenes="[ab]") == 3
    answer = capsys.readouterr()
    assert f"su3d-bench: {line}\n" in answer.err
    assert "su3d-bench: incomplete: 1 of 2 scenes failed" in answer.err
    assert "| 1/2 " in answer.out
    assert "INCOMPLETE: collector failed on painted/b" in answer.out
    assert "Traceback" in (job("b") / "log.txt").read_text()
    assert f"failed: {line}\n" in (job("b") / "log.txt").read_text()
    assert json.loads(Path("out/run.json").read_text())["status"] == "incomplete"
    for one in metrics()["results"]:
        assert one["failed"] == ["painted/b"]
        assert one["result"]["scenes"] == ["painted/a"]


def test_failed_scene_is_resumed_once_it_is_fixed(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(ColourPerception):
        def detect(self, frame: Any, *rest: Any) -> Any:
            if frame.index == 3:
                raise ValueError("no such thing")
            return super().detect(frame, *rest)

    assert run(scenes="a", out="whole") == 0
    with monkeypatch.context() as patch:
        patch.setattr(scene_run, "build_perception", lambda *_, **__: Broken())
        assert run(scenes="a") == 3
    assert run(scenes="a") == 0
    assert Path("out/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()


def test_scenes_whose_names_differ_only_in_a_slash_have_separate_maps(capsys: pytest.CaptureFixture[str]) -> None:
    twins = ["run", "--scenes", f"{SCENES}/painted.py:Twins/*", *words()[3:]]
    assert main(twins) == 0
    folders = sorted(path.name for path in Path("out/scenes").iterdir())
    assert folders == ["twins.a%252Fb", "twins.a%2Fb", "twins.a_b"]
    maps = {path.read_bytes() for path in Path("out/scenes").glob("*/collector/prediction.npz")}
    assert len(maps) == 3
    assert main(twins) == 0
    capsys.readouterr()
    assert (
        main(
            ["runs", "export", "out", "--to", "scannet", "--scenes", "twins/a/b", "--method", "collector", "--out", "x"]
        )
        == 2
    )
    assert "scene 'a/b': is not a valid file name" in capsys.readouterr().err


def test_unscored_maps_are_summarised_instead_of_dashes(capsys: pytest.CaptureFixture[str]) -> None:
    noisy = [*words(scenes="b")[3:], "--methods", COLLECTOR, f"{COLLECTOR}@noise_m=0.3"]
    assert main(["run", "--scenes", f"{PAINTED}/b", *noisy, "--set", "painted.fault=no-truth"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("no protocol applies to these scenes\n\n**Maps without scores**\n")
    rows = [line for line in printed.out.splitlines() if line.startswith("| painted/b")]
    assert [row.split("|")[2].strip() for row in rows] == ["collector", "collector@noise_m=0.3"]
    assert all(" / " in row.split("|")[5] and row.split("|")[8].strip() != "-" for row in rows)
    why = "not scored under rooms-semantic, rooms-instance: painted/b: has no ground truth"
    assert [line for line in printed.err.splitlines() if "not scored" in line] == [
        f"collector, collector@noise_m=0.3: {why}"
    ]
    log = next(Path("out").glob("scenes/*/collector/log.txt")).read_text()
    assert log.count("\n") == 3 and f"collector: {why}\n" in log
