from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from places import SCENES

from su3d_bench.cli.main import main

PAINTED = f"{SCENES}/painted_cli.py:Painted"
COLLECTOR = f"{SCENES}/painted_cli.py:Collector"
NOISE = ("--set", "collector.noise_m=0.02", "painted.frame_ms=50")


pytestmark = pytest.mark.usefixtures("painted_place")


def words(*more: str, out: str) -> list[str]:
    base = ["run", "--scenes", f"{PAINTED}/*", "--methods", COLLECTOR, "--protocols", "rooms-semantic"]
    return [*base, "--no-pictures", "--quiet", "--out", out, *NOISE, *more]


def run(*more: str, out: str) -> int:
    return main(words(*more, out=out))


def deterministic_files(out: Path) -> dict[str, Any]:
    """All parts of a run without times or machine names, by name: files, and the keys of completed jobs."""
    paths = [path for path in out.rglob("*") if path.is_file()]
    kept = [path for path in paths if path.name not in ("run.json", "run.toml", "updates.csv", "done.json")]
    found: dict[str, Any] = {path.relative_to(out).as_posix(): path.read_bytes() for path in kept}
    for path in out.rglob("done.json"):
        steps = json.loads(path.read_text())["steps"]
        found[path.relative_to(out).as_posix()] = {name: one["key"] for name, one in steps.items()}
    return found


def assert_equal_runs(one: Path | str, other: Path | str) -> None:
    first, second = deterministic_files(Path(one)), deterministic_files(Path(other))
    assert sorted(first) == sorted(second)
    assert {"metrics.json", "scenes/painted.d/collector/prediction.npz"} <= set(first)
    assert [name for name in first if first[name] != second[name]] == []


def test_submitit_gives_the_same_bytes_as_inline_execution() -> None:
    scenes = ("--scenes", f"{PAINTED}/[ad]")
    assert run(*scenes, "--jobs", "1", out="inline") == 0
    assert run(*scenes, "--executor", "slurm", "--slurm", "cluster=local", "timeout_min=20", out="slurm") == 0
    assert_equal_runs("inline", "slurm")


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--retries", "3"], "--retries 3: has no effect with the executor 'auto'"),
        (["--executor", "inline", "--jobs", "3"], "--jobs 3: the executor 'inline' runs one job"),
        (["--executor", "slurm", "--slurm", "x"], "--slurm x: expected KEY=VALUE"),
        (["--executor", "slurm", "--slurm", "cluster=local", "timeout_mni=1"], "--slurm: submitit rejects the options"),
    ],
)
def test_option_without_effect_is_a_one_line_error(
    more: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*more, out="out") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"su3d-bench: {named}") and error.count("\n") == 1
    assert not Path("out").exists()


def test_missing_cluster_is_a_one_line_error_and_writes_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert run("--executor", "slurm", out="new/out") == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "su3d-bench: no Slurm cluster here (srun not found); run the command on a machine of the cluster"
    )
    assert error.count("\n") == 1
    assert not Path("new").exists()


@pytest.mark.proof
def test_scene_that_kills_every_job_fails_alone_after_its_retries(capsys: pytest.CaptureFixture[str]) -> None:
    where = ("--executor", "slurm", "--slurm", "cluster=local", "timeout_min=20", "--scenes", f"{PAINTED}/[ab]")
    assert run(*where, "--retries", "1", "--set", "painted.fault=kill", out="killed") == 3
    assert "painted/b: its job failed 2 times: " in capsys.readouterr().err
    assert json.loads(Path("killed/metrics.json").read_text())["results"][0]["result"]["scenes"] == ["painted/a"]
