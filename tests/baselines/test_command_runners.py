"""How user programs are run, measured and ended: directly, in docker, in conda."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import psutil
import pytest
from test_command_method import MASKS, fed, refused
from waiting import wait_until

from su3d_bench.baselines.command.method import Command, CommandConfig
from su3d_bench.baselines.command.process import run_program


def test_timeout_kills_children_including_those_outside_the_group(tmp_path: Path) -> None:
    line = f"sleep 60 & echo $! >> {tmp_path}/pids; setsid sleep 60 & echo $! >> {tmp_path}/pids; wait"
    refused(fed(Command(CommandConfig(command=line, shell=True, timeout_s=2.0))))
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 2
    wait_until(lambda: not any(_runs(pid) for pid in pids), "a child is still running")


def _runs(pid: int) -> bool:
    return bool(psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)


def test_memory_and_time_include_the_children(tmp_path: Path) -> None:
    child = "import time; held = bytearray(150_000_000); time.sleep(1.5)"
    text = f"import subprocess, sys; held = bytearray(100_000_000); subprocess.run([sys.executable, '-c', {child!r}])"
    done = run_program(
        [sys.executable, "-c", text], folder=tmp_path, environment={"PATH": os.environ["PATH"]}, timeout_s=60
    )
    assert done.exit_code == 0
    assert done.peak_memory_bytes is not None
    assert 250e6 <= done.peak_memory_bytes < 400e6
    assert done.wall_s >= 1.5


def test_only_the_end_of_a_flood_of_output_is_kept(tmp_path: Path) -> None:
    text = "import sys\nfor i in range(40000): print('line', i)\nsys.stderr.write('end')"
    done = run_program([sys.executable, "-c", text], folder=tmp_path, environment={}, timeout_s=60)
    assert len(done.stdout) < 101_000
    assert done.stdout.startswith("[")
    assert done.stdout.endswith("line 39999\n")
    assert done.stderr == "end"


def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, body: str) -> Path:
    """A program called ``name``, first on PATH, that records its arguments and then runs ``body``."""
    folder = tmp_path / "bin"
    folder.mkdir(exist_ok=True)
    log = tmp_path / f"{name}.jsonl"
    (folder / name).write_text(
        f"#!{sys.executable}\nimport json, os, sys\nwords = sys.argv[1:]\n"
        f"print(json.dumps(words), file=open({str(log)!r}, 'a'))\n{body}"
    )
    (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    return log


FAKE_DOCKER = """
if words[0] == "run":
    open(words[words.index("--cidfile") + 1], "w").write("abc123")
    here = next(w.split(":")[0] for w in words if w.endswith(":/su3d/output"))
    sys.argv = ["", here]
"""


def test_docker_gets_read_only_frames_and_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = fake(tmp_path, monkeypatch, "docker", FAKE_DOCKER + MASKS)
    monkeypatch.setenv("MY_MODEL", "large")
    config = CommandConfig(
        command=("run.py", "{frames}", "{output}"),
        runner="docker",
        image="their/image:1",
        gpus="all",
        mounts=("/data/weights:/weights",),
        pass_variables=("PATH", "MY_MODEL"),
    )
    one = fed(Command(config))
    assert len(one.finish().scores) == 2  # type: ignore[union-attr]
    one.close()
    (words,) = [json.loads(line) for line in log.read_text().splitlines()]
    assert words[:3] == ["run", "--rm", "--init"]
    assert words[-4:] == ["their/image:1", "run.py", "/su3d/frames", "/su3d/output"]
    volumes = [words[i + 1] for i, word in enumerate(words) if word == "--volume"]
    assert volumes[0].endswith("/frames:/su3d/frames:ro")
    assert volumes[3] == "/data/weights:/weights:ro"
    result = [words[i + 1] for i, word in enumerate(words) if word == "--env"]
    known = [f"SU3D_{name}" for name in ("FRAMES", "OUTPUT", "WORK", "SCENE", "DATASET", "SEED")]
    assert result == ["MY_MODEL", *known]
    assert words[words.index("--network") + 1] == "none"
    assert words[words.index("--user") + 1] == f"{os.getuid()}:{os.getgid()}"
    assert words[words.index("--gpus") + 1] == "all"


def test_slow_container_is_killed_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake(tmp_path, monkeypatch, "docker", "")
    docker, log = tmp_path / "bin" / "docker", tmp_path / "docker.log"
    docker.write_text(f'#!/bin/sh\necho "$@" >> {log}\nif [ "$1" = run ]; then sleep 60; fi\n')
    one = fed(Command(CommandConfig(command="x {output}", runner="docker", image="i", timeout_s=2.0)))
    assert "terminated after 2 s" in refused(one)
    started, killed = (line.split() for line in log.read_text().splitlines())
    assert killed == ["kill", started[started.index("--name") + 1]]


@pytest.mark.parametrize(("environment", "kind"), [("theirs", "--name"), ("/envs/theirs", "--prefix")])
def test_conda_runs_the_command_in_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: str, kind: str
) -> None:
    log = fake(tmp_path, monkeypatch, "conda", "sys.argv = ['', words[-1]]" + MASKS)
    one = fed(Command(CommandConfig(command="python run.py {output}", runner="conda", environment=environment)))
    assert len(one.finish().scores) == 2  # type: ignore[union-attr]
    one.close()
    (words,) = [json.loads(line) for line in log.read_text().splitlines()]
    assert words[:6] == ["run", "--no-capture-output", kind, environment, "python", "run.py"]
