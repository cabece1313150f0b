from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import ray
from places import SCENES
from waiting import wait_until

from su3d_bench.cli.main import main

PAINTED = f"{SCENES}/painted_cli.py:Painted"
COLLECTOR = f"{SCENES}/painted_cli.py:Collector"
NOISE = ("--set", "collector.noise_m=0.02", "painted.frame_ms=50")
WHILE_LOADED_S = 300


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Three single-core machines: the driver's, which runs no job, one with a nominal GPU, and one to be killed."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # no test uses the network
    from ray.cluster_utils import Cluster

    small = {"object_store_memory": 80_000_000, "include_dashboard": False}
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **small})
    made.add_node(num_cpus=1, num_gpus=1, **small)
    made.doomed = made.add_node(num_cpus=1, **small)
    yield made
    made.shutdown()


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


def workers_of(node: Any) -> list[psutil.Process]:
    """Processes of ``node`` that run a job, as soon as there are any."""
    raylet = psutil.Process(node.all_processes["raylet"][0].process.pid)
    return wait_until(
        lambda: [child for child in raylet.children(recursive=True) if "ray::_on_node" in " ".join(child.cmdline())],
        "no job came to the machine",
        WHILE_LOADED_S,
    )


@pytest.mark.proof
def test_run_on_a_cluster_stops_cleanly_on_sigterm(cluster: Any) -> None:
    where = ("--executor", "ray", "--ray-address", cluster.address, "--set", "painted.frame_ms=5000")
    command = [sys.executable, str(SCENES / "painted_cli.py"), *words(*where, out="ended")]
    driver = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    workers_of(cluster.doomed)
    driver.send_signal(signal.SIGTERM)
    _, printed = driver.communicate(timeout=WHILE_LOADED_S)
    assert (driver.returncode, printed) == (143, "su3d-bench: stopped by SIGTERM; the same command resumes\n")
    assert json.loads(Path("ended/run.json").read_text())["status"] == "interrupted"


def test_run_survives_a_machine_that_dies(cluster: Any) -> None:
    assert run("--jobs", "1", out="inline") == 0
    command = [sys.executable, str(SCENES / "painted_cli.py"), *words("--executor", "ray", out="ray")]
    driver = subprocess.Popen([*command, "--ray-address", cluster.address], stdout=subprocess.DEVNULL)
    at_work = workers_of(cluster.doomed)
    os.kill(cluster.doomed.all_processes["raylet"][0].process.pid, signal.SIGKILL)
    assert driver.wait(timeout=WHILE_LOADED_S) == 0
    assert not any(process.is_running() for process in at_work)
    assert_equal_runs("inline", "ray")


@pytest.mark.proof
def test_scene_that_kills_every_worker_fails_alone_after_its_retries(
    cluster: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--executor", "ray", "--ray-address", cluster.address, "--scenes", f"{PAINTED}/[ab]")
    assert run(*where, "--retries", "1", "--set", "painted.fault=kill", out="killed") == 3
    error = capsys.readouterr().err
    assert "painted/b: the worker or its machine was lost, 2 times; see the cluster's logs, or raise --retries" in error
    assert json.loads(Path("killed/metrics.json").read_text())["results"][0]["result"]["scenes"] == ["painted/a"]


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
        (["--executor", "slurm", "--gpus-per-job", "0.5"], "--gpus-per-job 0.5"),
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


@pytest.mark.parametrize(
    ("executor", "line"),
    [
        ("ray", "no Ray cluster on this machine accepts this run (Could not find any running Ray instance"),
        (
            "slurm",
            "no Slurm cluster here (srun not found); run the command on a machine of the cluster, or add --slurm ",
        ),
    ],
)
def test_missing_cluster_is_a_one_line_error_and_writes_nothing(
    executor: str, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nothing_runs(**_: Any) -> None:
        raise ConnectionError("Could not find any running Ray instance. Please specify it by `--address`.")

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(ray, "init", nothing_runs)
    monkeypatch.setenv("PATH", "/nowhere")
    assert run("--executor", executor, out="new/out") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"su3d-bench: {line}")
    assert error.count("\n") == 1
    assert not Path("new").exists()


@pytest.mark.proof
def test_single_machine_cluster_is_started_for_the_run(tmp_path: Path) -> None:
    scenes = ("--scenes", f"{PAINTED}/[ad]")
    assert run(*scenes, "--jobs", "1", out="inline") == 0
    command = [sys.executable, str(SCENES / "painted_cli.py"), *words(*scenes, "--executor", "ray", out="ray")]
    subprocess.run([*command, "--ray-address", "local"], check=True, env={**os.environ, "RAY_USAGE_STATS_ENABLED": "0"})
    assert_equal_runs("inline", "ray")
