"""Programs that get a scene frame by frame: clients in Python and C++, sessions, live runs, and every way to fail."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from painted_runs import see_painted
from places import SCENES
from test_command_method import SCENE, SURFACE, fed, frames
from test_command_runners import fake
from test_sessions import assert_same
from waiting import wait_until

import su3d_bench as su3d
from su3d_bench.baselines.command.method import Command, CommandConfig
from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.errors import ConfigError, PredictionError, Su3dError
from su3d_bench.core.maps import Instances
from su3d_bench.predictions.formats import recognise
from su3d_bench.store.run_folder import RunFolder

ROOM = "rooms/bathroom0"
SMALL = {"n_frames": 60, "width": 160, "height": 120, "mesh_spacing_m": 0.05}
STRIDE = 10


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clients and examples, as a user gets them."""
    folder = tmp_path_factory.mktemp("programs") / "mine"
    assert main(["methods", "new", str(folder)]) == 0
    return folder


def command_of(programs: Path, language: str) -> list[str]:
    """The example in one language, compiled if necessary."""
    if language == "python":
        return [sys.executable, str(programs / "voxels.py")]
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    if not (programs / "voxels").exists():
        flags = ["-std=c++17", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
        subprocess.run([compiler, *flags, programs / "voxels.cpp", "-o", programs / "voxels"], check=True)
    return [str(programs / "voxels")]


@pytest.fixture(scope="module")
def expected(programs: Path, rooms_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The map of a run of the example in Python."""
    return run_of(command_of(programs, "python"), rooms_data, tmp_path_factory.mktemp("run"))


def run_of(command: list[str], data: Path, out: Path) -> Any:
    settings = {f"rooms.{key}": value for key, value in SMALL.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(data))
        run = su3d.run(
            ROOM, "command", protocols="rooms-instance", stride=STRIDE, pictures=False, jobs=1, out=out / "run",
            settings=settings | {"command.command": command, "command.frame_by_frame": True},
        )  # fmt: skip
    return run.prediction(ROOM, "command")


def test_program_in_c_plus_plus_gives_the_same_map_as_in_python(
    programs: Path, expected: Instances, rooms_data: Path, tmp_path: Path
) -> None:
    assert len(expected) > 10 and set(expected.labels or ()) == {"wall", "floor", "cabinet"}
    assert_same(run_of(command_of(programs, "c++"), rooms_data, tmp_path), expected)


@pytest.mark.parametrize("language", ["python", "c++"])
def test_session_equals_run_also_saved_and_continued(
    language: str, programs: Path, expected: Instances, rooms_data: Path, tmp_path: Path
) -> None:
    dataset_class = registry.load("dataset", "rooms")
    dataset = dataset_class(rooms_data, dataset_class.Options(**SMALL))
    info, shots = dataset.info("bathroom0", STRIDE), list(dataset.frames("bathroom0", STRIDE))
    settings = {"command": command_of(programs, language), "frame_by_frame": True}
    with su3d.session("command", replace(info, read_surface=lambda: SURFACE), settings=settings) as s:
        list(map(s.push, shots[:3]))
        s.save(tmp_path / "half")
        with pytest.raises(ConfigError, match="refuses: it has no revise"):
            s.revise({0: np.eye(4)})
        list(map(s.push, shots[3:]))
        assert_same(s.snapshot().prediction, expected)
    with su3d.session(load=tmp_path / "half") as s:
        assert s.snapshot().as_of.geometry == shots[2].index
        list(map(s.push, shots[3:]))
        assert_same(s.snapshot(wait=False).result().prediction, expected)


# A program with the client; it prints, is one frame behind, and can revise.
BEHIND = """
import os, sys
sys.path.insert(0, sys.argv[1])
import numpy as np, su3d_client

class Mapper:
    def start(self, scene):
        assert scene["dataset"] == os.environ["SU3D_DATASET"] and (not scene["mesh"] or os.path.isfile(scene["mesh"]))
        print("a print of", scene["scene"], "with mesh" if scene["mesh"] else "", flush=True)
        self.frames = []

    def frame(self, frame):
        self.frames.append((frame.number, frame.camera_to_world[:3, 3]))

    def snapshot(self, folder):
        points = np.array([(1, 1, 2), *(pose for _, pose in self.frames[:-1] or self.frames)], "f4")
        instance = np.zeros(len(points), "i4")
        np.savez(folder + "/prediction.npz", kind="Instances", points=points, instance=instance, labels=["chair"])
        return self.frames[max(len(self.frames) - 2, 0)][0]

    def revise(self, poses):
        if 99 in poses:
            raise su3d_client.Refused("no frame 99")
        self.frames = [(number, poses[number][:3, 3] if number in poses else pose) for number, pose in self.frames]

su3d_client.serve(Mapper())
"""


def test_snapshot_names_its_last_frame_and_poses_can_be_revised(
    programs: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "behind.py").write_text(BEHIND)
    settings = {"command": [sys.executable, str(tmp_path / "behind.py"), str(programs)], "frame_by_frame": True}
    with su3d.session("command", replace(SCENE, read_surface=lambda: SURFACE), settings=settings) as s:
        list(map(s.push, frames()))
        assert (s.as_of.geometry, s.snapshot().as_of.geometry, s.snapshot(wait=False).as_of.geometry) == (2, 1, 1)
        with pytest.raises(ConfigError, match="revise: the program refuses: no frame 99"):
            s.revise({99: np.eye(4)})
        s.revise({1: 3 * np.eye(4) + np.eye(4, k=3)})
        assert s.snapshot().prediction.points[2].tolist() == [1, 0, 0]
        with pytest.raises(ConfigError, match="save: the program refuses: it has no save"):
            s.save(tmp_path / "saved")
    assert "stdout: a print of a b with mesh" in caplog.text


def test_program_runs_live_in_real_time_and_midway_maps_are_its_snapshots(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    see_painted(monkeypatch)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    (tmp_path / "behind.py").write_text(BEHIND)
    command = f'command.command=["{sys.executable}", "{tmp_path}/behind.py", "{programs}"]'
    words = ["run", "--scenes", f"{SCENES}/painted.py:Painted/a", "--methods", "command", "--no-pictures"]
    words += ["--protocols", "rooms-instance", "--jobs", "1", "--set", command, "command.frame_by_frame=true"]
    for name, options in (("every", ["--anytime-every", "2"]), ("live", ["--realtime", "10", "--memory", "1G"])):
        assert main([*words, *options, "--out", str(tmp_path / name)]) == 0, capsys.readouterr().err
    job = RunFolder(tmp_path / "every").job("painted/a", "command")
    maps = job.remarks("predict")["costs"]["maps"]
    assert [one["n_updates"] for one in maps] == [2, 4, 6]
    assert maps[-1]["program_s"] >= maps[0]["program_s"] > 0 and maps[-1]["program_peak_bytes"] > 1e6
    assert [len(np.load(file)["points"]) for file in sorted(job.path.glob("anytime-*[0-9].npz"))] == [2, 4]
    assert "program_ms" in job.updates.read_text().splitlines()[0]
    live = RunFolder(tmp_path / "live").job("painted/a", "command")
    assert live.remarks("predict")["costs"]["realtime"]["n_processed"] > 0


# A program without the client, which does one thing wrong with the third frame (or with another request).
WRONG = """
import os, signal, struct, sys
how, pids = sys.argv[1:]
open(pids, "a").write(f"{os.getpid()} ")
requests = open(os.environ["SU3D_PIPES"] + "/requests", "rb")
answers = open(os.environ["SU3D_PIPES"] + "/answers", "wb", buffering=0)
def answer(kind, number, text=b"", n_bytes=None):
    answers.write(struct.pack("<4sIQQ", b"SU3D", kind, number, len(text) if n_bytes is None else n_bytes) + text)
while True:
    _, kind, number, n_bytes = struct.unpack("<4sIQQ", requests.read(24))
    requests.read(n_bytes)
    print("a print", flush=True)
    print("request", number, file=sys.stderr, flush=True)
    if number == 4:
        exec(how)
    answer(100, number, b"1" if kind == 1 else b"")
    assert kind != 7
"""
HANG = "signal.pause()"
AT_2 = "rooms/a b: command: frame 2: "


@pytest.mark.parametrize(
    ("how", "line"),
    [
        ("raise RuntimeError('no')", f"{AT_2}exit code 1 before its answer; its last line: RuntimeError: no"),
        ("os.kill(os.getpid(), 9)", f"{AT_2}terminated by signal 9 before its answer; its last line: request 4"),
        ("answer(102, number, b'no \\x1b[31mGPU\\n'); sys.exit(3)", f"{AT_2}error of the program: no \\x1b[31mGPU"),
        ("answer(100, number, b'', 1 << 62)", f"{AT_2}its answer has {1 << 62} bytes; at most 4096; its last line"),
        (f"answer(100, number, b'', 5); {HANG}", f"{AT_2}no complete answer within 4 s (timeout_s); its last line: "),
        ("answer(100, number, b'x' * 40, 2)", "map: its answer begins with b'xxxx' and kind 2021161080, which is no"),
        ("answer(100, number)", "map: it answers request 4; the last one was 5; its last line: request 5"),
        (HANG, f"{AT_2}no complete answer within 4 s (timeout_s); its last line: request 4"),
        (f"answers.close(); {HANG}", f"{AT_2}it closed its pipe before its answer; its last line: request 4"),
        (
            f"os.fork() or open(pids, 'a').write(f'{{os.getpid()}}') and {HANG}; sys.exit(5)",
            f"{AT_2}exit code 5 before its answer",
        ),
        ("pass", "it reports no error but wrote nothing to {output}"),
        ("$ no-such-interpreter,x.py", "command: 'no-such-interpreter' cannot be started: No such file"),
        ("$ sh,-c,echo hi; echo no licence >&2", "start: exit code 0 before its answer; its last line: no licence"),
        ("$ sleep,60", "start: no complete answer within 4 s (timeout_s); it wrote nothing to stderr"),
    ],
)
def test_every_failure_is_one_line_and_leaves_no_process(how: str, line: str, tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    pids.touch()
    (tmp_path / "wrong.py").write_text(WRONG)
    words = tuple(how[2:].split(",")) if how[:2] == "$ " else (sys.executable, f"{tmp_path}/wrong.py", how, str(pids))
    one = Command(CommandConfig(command=words, frame_by_frame=True, timeout_s=4.0))
    with pytest.raises(Su3dError) as caught:
        fed(one, None).finish()
    assert line in str(caught.value)
    scratch = one._scratch
    one.close()
    assert scratch is not None and not scratch.path.exists()
    wait_until(lambda: not any(psutil.pid_exists(int(pid)) for pid in pids.read_text().split()), "it still runs")


def test_container_gets_the_pipes_read_only(programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = """
folders = dict(reversed(w.split(":")[:2]) for w in words if w.count(":/su3d/"))
os.environ["SU3D_PIPES"] = folders["/su3d/pipes"]
sys.argv = ["", os.environ["CLIENT"]]
""" + BEHIND.replace('folder + "/p', 'folder.replace("/su3d/output", folders["/su3d/output"]) + "/p')
    log = fake(tmp_path, monkeypatch, "docker", body)
    monkeypatch.setenv("CLIENT", str(programs))
    container = CommandConfig(command="mine", runner="docker", image="i", pass_variables=("PATH", "CLIENT"))
    one = fed(Command(container.model_copy(update={"frame_by_frame": True})), None)
    assert len(one.finish().points) == 3
    one.close()
    words = json.loads(log.read_text().splitlines()[0])
    assert any(word.endswith("/pipes:/su3d/pipes:ro") for word in words)


def test_instances_without_all_arrays_are_read_and_checked(tmp_path: Path) -> None:
    file, points = tmp_path / "prediction.npz", np.eye(3, dtype=np.float32)
    np.savez(file, kind="Instances", points=points, instance=[1, -1, 0], labels=["a", "b"], scores=[0.5, 1.0])
    found = recognise(file).read(file, "prediction").content
    assert isinstance(found, Instances) and found.labels == ("a", "b")
    assert [mask.tolist() for mask in found.sets()] == [[2], [0]] and found.scores.tolist() == [0.5, 1.0]
    np.savez(file, kind="Instances", points=points, instance=[2, -1, 0])
    with pytest.raises(PredictionError, match="without gaps"):
        recognise(file).read(file, "prediction")
