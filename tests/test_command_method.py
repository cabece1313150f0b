"""Programs of others as a method: the folder they get, what they leave, how they are run, measured and ended."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from painted import INTRINSICS, ColourPerception, Painted, colour_perception
from pydantic import ValidationError

from su3d_bench import scene_run
from su3d_bench.baselines.command import Command, CommandConfig
from su3d_bench.baselines.command_frames import FrameFolder, write_mesh
from su3d_bench.baselines.command_prediction import ClassNames, as_prediction, class_names
from su3d_bench.baselines.command_process import ContainerWatch, run_program
from su3d_bench.cli.main import main
from su3d_bench.datasets.replica_truth import read_surface
from su3d_bench.datasets.rgbd import Rgbd
from su3d_bench.errors import ConfigError, DataError, PredictionError
from su3d_bench.predictions.base import VertexLabels, VertexMasks
from su3d_bench.scene_tools import no_detections
from su3d_bench.timing import Timer
from su3d_bench.types import Frame, Instances, SceneInfo, SceneTools, Surface

HERE = Path(__file__).parent
SCENE = SceneInfo("rooms", "a b", 6, 1, "rendered-rooms", seed=7)
SURFACE = Surface(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [3, 0, 0]], np.float32),
    np.array([[0, 1, 2], [0, 1, 3]], np.int32),
)
# Two masks over five vertices as ScanNet's text has them, with the class ids of chair and wall in the rooms.
MASKS = """
import os, sys
out = sys.argv[1]
os.mkdir(out + "/masks")
open(out + "/scene.txt", "w").write("masks/0.txt 20 0.9\\nmasks/1.txt 93 0.5\\n")
open(out + "/masks/0.txt", "w").write("1\\n1\\n0\\n0\\n0\\n")
open(out + "/masks/1.txt", "w").write("0\\n0\\n0\\n1\\n1\\n")
"""


def frames(n: int = 3) -> list[Frame]:
    dataset = Painted(Path(), Painted.Options(n_frames=n))
    return list(dataset.frames("a", 1))


def program(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "program.py"
    path.write_text(text)
    return path


def method(tmp_path: Path, text: str, *words: str, surface: Surface | None = SURFACE, **config: Any) -> Command:
    """The method around the Python program ``text``, fed with three frames."""
    command = (sys.executable, str(program(tmp_path, text)), *(words or ("{output}",)))
    return fed(Command(CommandConfig(command=command, **config)), surface)


def fed(one: Command, surface: Surface | None = SURFACE, shots: Sequence[Frame] | None = None) -> Command:
    def give() -> Surface:
        if surface is None:
            raise DataError("rooms/a b: the dataset has no mesh")
        return surface

    shots = frames() if shots is None else shots
    one.receive_tools(SceneTools(shots, None, give))  # type: ignore[arg-type]
    one.start(SCENE)
    for frame in shots:
        one.update(frame, no_detections(frame, one.needs), Timer())
    return one


def refused(one: Command) -> str:
    with pytest.raises(PredictionError) as caught:
        one.finish()
    text = str(caught.value)
    assert "\n" not in text
    assert "\x1b" not in text
    assert len(text) < 700
    one.close()
    return text


def test_the_exported_folder_reads_back_as_the_frames_that_went_in(tmp_path: Path) -> None:
    shots = frames()
    folder = FrameFolder(tmp_path / "rgbd" / "here", SCENE, surface=SURFACE)
    folder.open()
    for frame in shots:
        folder.add(frame)
    folder.close()
    back = Rgbd(tmp_path).frames("here", 1)
    assert len(back) == len(shots)
    for one, other in zip(shots, back, strict=True):
        assert one.index == other.index
        assert np.array_equal(one.rgb, other.rgb)
        assert np.abs(one.depth_m - other.depth_m).max() <= 0.0005 + 1e-6
        assert np.array_equal(one.camera_to_world, other.camera_to_world)
        assert np.array_equal(one.intrinsics, other.intrinsics)


def test_scene_toml_says_all_that_a_program_may_know(tmp_path: Path) -> None:
    folder = FrameFolder(tmp_path, replace(SCENE, scene='a"b\n[x]'), surface=SURFACE)
    folder.open()
    for frame in frames():
        folder.add(frame)
    folder.close()
    told = tomllib.loads((tmp_path / "scene.toml").read_text())
    assert told["scene"] == 'a"b [x]'
    assert (told["frames"], told["n_frames"], told["seed"], told["stride"]) == ([0, 1, 2], 3, 7, 1)
    assert (told["width"], told["height"], told["fx"], told["cy"]) == (32, 24, INTRINSICS[0, 0], INTRINSICS[1, 2])
    assert (told["mesh"], told["n_vertices"], told["depth_unit_m"]) == ("mesh.ply", 5, 0.001)
    assert not told["intrinsics_differ"]
    assert "instance" not in json.dumps(told)


def test_intrinsics_that_change_are_written_for_each_frame(tmp_path: Path) -> None:
    folder = FrameFolder(tmp_path, SCENE)
    folder.open()
    for frame in frames():
        zoom = np.diag([1.0 + frame.index, 1.0, 1.0])
        folder.add(replace(frame, intrinsics=frame.intrinsics @ zoom))
    folder.close()
    assert tomllib.loads((tmp_path / "scene.toml").read_text())["intrinsics_differ"]
    assert np.loadtxt(tmp_path / "intrinsics" / "000002.txt")[0, 0] == 3 * INTRINSICS[0, 0]


def test_depth_beyond_16_bits_of_millimetres_is_written_as_none(tmp_path: Path) -> None:
    frame = frames(1)[0]
    depth_m = np.array([[0.0, 1.2344], [65.535, 65.6]], np.float32)
    depth_m = np.concatenate([depth_m, np.array([[np.nan, np.inf]], np.float32)])
    folder = FrameFolder(tmp_path, SCENE)
    folder.open()
    folder.add(replace(frame, rgb=np.zeros((3, 2, 3), np.uint8), depth_m=depth_m))
    told = cv2.imread(str(tmp_path / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert told is not None
    assert told.tolist() == [[0, 1234], [65535, 0], [0, 0]]


def test_the_mesh_keeps_the_order_of_its_vertices(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", SURFACE)
    back = read_surface(tmp_path / "mesh.ply", "mesh")
    assert np.array_equal(back.vertices, SURFACE.vertices)
    assert np.array_equal(back.triangles, SURFACE.triangles)


def test_masks_over_the_mesh_become_instances_on_its_vertices(tmp_path: Path) -> None:
    one = method(tmp_path, MASKS)
    found = one.finish()
    assert isinstance(found, Instances)
    assert found.labels == ("chair", "wall")
    assert found.scores.tolist() == [0.9, 0.5]
    assert [found.mask(k).tolist() for k in range(2)] == [[0, 1], [3, 4]]
    assert np.array_equal(found.points, SURFACE.vertices)
    assert found.boxes[1].tolist() == [[0, 0, 0], [3, 0, 2]]
    assert found.centroids[0].tolist() == [0.5, 0, 0]
    one.close()


def test_points_of_its_own_need_no_mesh(tmp_path: Path) -> None:
    text = """
import sys, json, tomllib
import numpy as np
frames, out = sys.argv[1:]
scene = tomllib.load(open(frames + "/scene.toml", "rb"))
assert scene["mesh" if False else "n_frames"] == 3 and "mesh" not in scene
points = np.loadtxt(frames + "/pose/000000.txt")[:3].T[:3]
np.savez(out + "/prediction.npz", kind="Partition", points=points.astype("f4"),
         instance=np.zeros(3, "i4"), features=np.ones((1, 4), "f4"))
"""
    one = method(tmp_path, text, "{frames}", "{output}", surface=None)
    found = one.finish()
    assert found.points.tolist() == frames(1)[0].camera_to_world[:3, :3].T.astype(np.float32).tolist()
    one.close()


def test_masks_without_points_are_refused_where_there_is_no_mesh(tmp_path: Path) -> None:
    text = refused(method(tmp_path, MASKS, surface=None))
    assert text.startswith("rooms/a b: command: its masks have no points of their own and the dataset has no mesh")


def test_masks_over_another_number_of_points_are_refused(tmp_path: Path) -> None:
    larger = Surface(np.zeros((6, 3), np.float32), np.zeros((0, 3), np.int32))
    assert "its masks are over 5 points, the mesh has 6 vertices" in refused(method(tmp_path, MASKS, surface=larger))


def test_labels_of_vertices_become_one_mask_a_class_and_none_where_there_is_no_class() -> None:
    names = ClassNames({4: "chair", 9: "wall"}, {})
    found = as_prediction(VertexLabels(np.array([9, 0, 4, 9, -1], np.int32)), SURFACE, names)
    assert isinstance(found, Instances)
    assert found.labels == ("chair", "wall")
    assert [found.mask(k).tolist() for k in range(2)] == [[2], [0, 3]]


def test_class_numbers_that_two_lists_read_differently_ask_for_a_protocol() -> None:
    none = np.zeros(0, np.int32)
    content = VertexMasks(5, np.zeros(2, np.int64), none, np.ones(1), np.array([3], np.int32), "id", None, ("m",))
    with pytest.raises(PredictionError, match="whose are its class numbers"):
        class_names(content, "scannet", None)
    assert class_names(content, "scannet", "scannet-instance").by_id[3] == "cabinet"
    places = replace(content, numbering="index")
    assert class_names(places, "scannet", "scannet-instance").by_place[0] == "cabinet"


@pytest.mark.parametrize(
    ("text", "config", "line"),
    [
        (
            "import sys; print('\\x1b[31mno weights\\x07', file=sys.stderr); sys.exit(3)",
            {},
            "rooms/a b: command: exit code 3; its last line: \\x1b[31mno weights\\x07",
        ),
        ("import os; os.kill(os.getpid(), 9)", {}, "was ended by signal 9; it wrote nothing to stderr"),
        ("", {}, "it ended without an error and left nothing in {output}"),
        ("import sys; open(sys.argv[1] + '/x.bin', 'wb').write(b'?')", {}, "{output}: in none of the known formats"),
        ("import sys; open(sys.argv[1] + '/p.npz', 'wb').write(b'?')", {"format": "openmask3d"}, "{output}"),
        (
            "import sys, time; print('loading', file=sys.stderr, flush=True); time.sleep(60)",
            {"timeout_s": 0.5},
            "was ended after 0.5 s (timeout_s); its last line: loading",
        ),
    ],
    ids=["exit-code", "signal", "nothing", "unknown-format", "wrong-format", "timeout"],
)
def test_what_goes_wrong_is_one_line_that_says_it(tmp_path: Path, text: str, config: dict[str, Any], line: str) -> None:
    assert line in refused(method(tmp_path, text, **config))


def test_a_program_that_is_not_there_is_named(tmp_path: Path) -> None:
    one = fed(Command(CommandConfig(command=("./nowhere", "{output}"))))
    assert "'./nowhere' cannot be started: No such file" in refused(one)


def test_a_timeout_ends_children_too_even_those_that_left_the_group(tmp_path: Path) -> None:
    text = f"""
import subprocess, sys, time
for away in (False, True):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=away)
    print(child.pid, file=open({str(tmp_path)!r} + "/pids", "a"))
time.sleep(60)
"""
    refused(method(tmp_path, text, timeout_s=1.5))
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 2
    deadline = time.monotonic() + 10
    while any(_runs(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_runs(pid) for pid in pids)


def _runs(pid: int) -> bool:
    return bool(psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)


def test_memory_and_time_are_those_of_the_program_and_its_children(tmp_path: Path) -> None:
    child = "import time; held = bytearray(150_000_000); time.sleep(0.6)"
    text = f"import subprocess, sys; held = bytearray(100_000_000); subprocess.run([sys.executable, '-c', {child!r}])"
    done = run_program(
        [sys.executable, "-c", text], folder=tmp_path, environment={"PATH": os.environ["PATH"]}, timeout_s=60
    )
    assert done.exit_code == 0
    assert done.peak_memory_bytes is not None
    assert 250e6 <= done.peak_memory_bytes < 400e6
    assert done.wall_s >= 0.6


def test_a_flood_of_output_is_kept_from_its_end_only(tmp_path: Path) -> None:
    text = "import sys\nfor i in range(40000): print('line', i)\nsys.stderr.write('end')"
    done = run_program([sys.executable, "-c", text], folder=tmp_path, environment={}, timeout_s=60)
    assert len(done.stdout) < 101_000
    assert done.stdout.startswith("[")
    assert done.stdout.endswith("line 39999\n")
    assert done.stderr == "end"


def test_only_the_variables_that_are_allowed_reach_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SECRET_TOKEN", "x")
    monkeypatch.setenv("MY_MODEL", "large")
    text = "import os; print(sorted(os.environ))" + MASKS
    one = method(tmp_path, text, pass_variables=("MY_MODEL",))
    one.finish()
    one.close()
    told = next(record.getMessage() for record in caplog.records if record.getMessage().startswith("stdout"))
    assert "MY_MODEL" in told
    assert "SECRET_TOKEN" not in told
    assert "PATH" not in told


def test_placeholders_are_filled_and_no_shell_reads_them(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = "import sys; print(sys.argv[2:])" + MASKS
    one = method(tmp_path, text, "{output}", "{dataset}/{scene}", "--seed={seed}", "$(id);{}")
    one.finish()
    one.close()
    assert "stdout: ['rooms/a b', '--seed=7', '$(id);{}']" in caplog.text


def test_a_line_is_split_into_words_and_a_shell_reads_it_only_when_asked(tmp_path: Path) -> None:
    path = program(tmp_path, MASKS)
    for config in (
        CommandConfig(command=f"'{sys.executable}' {path} {{output}}"),
        CommandConfig(command=f"echo {{scene}} | grep 'a b' && '{sys.executable}' {path} {{output}}", shell=True),
    ):
        one = fed(Command(config))
        assert len(one.finish().scores) == 2  # type: ignore[union-attr]
        one.close()
    assert CommandConfig(command="a 'b c' {output}").words == ("a", "b c", "{output}")


def test_finish_midway_gives_the_map_of_the_frames_so_far_and_changes_nothing(tmp_path: Path) -> None:
    text = "import sys, os; n = len(os.listdir(sys.argv[2] + '/colour')); assert not os.listdir(sys.argv[1]); " + (
        "import numpy as np; np.savez(sys.argv[1] + '/prediction.npz', kind='Partition', points=np.zeros((n, 3), 'f4'),"
        " instance=np.zeros(n, 'i4'), features=np.ones((1, 4), 'f4'))"
    )
    one = method(tmp_path, text, "{output}", "{frames}")
    assert [len(one.finish().points) for _ in range(2)] == [3, 3]
    late = frames(4)[3]
    one.update(late, no_detections(late, one.needs), Timer())
    assert len(one.finish().points) == 4
    assert one.finish_costs["program_s"] > 0
    one.close()


def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    one = method(tmp_path, MASKS)
    one.finish()
    assert list((tmp_path / "scratch").iterdir())
    one.close()
    assert not list((tmp_path / "scratch").iterdir())


def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, body: str) -> Path:
    """A program called ``name``, first on PATH, that writes down its arguments and then does ``body``."""
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


def test_docker_gets_read_only_frames_no_network_and_the_paths_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert [words[i + 1] for i, word in enumerate(words) if word == "--env"] == ["MY_MODEL"]
    assert words[words.index("--network") + 1] == "none"
    assert words[words.index("--user") + 1] == f"{os.getuid()}:{os.getgid()}"
    assert words[words.index("--gpus") + 1] == "all"


def test_a_container_that_takes_too_long_is_killed_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = fake(tmp_path, monkeypatch, "docker", "import time\nif words[0] == 'run': time.sleep(60)")
    one = fed(Command(CommandConfig(command="x {output}", runner="docker", image="i", timeout_s=1.0)))
    assert "was ended after 1 s" in refused(one)
    started, killed = (json.loads(line) for line in log.read_text().splitlines())
    assert killed == ["kill", started[started.index("--name") + 1]]


@pytest.mark.parametrize("place", ["system.slice/docker-abc123.scope/memory.peak", "docker/abc123/memory.peak"])
def test_a_containers_peak_is_what_its_cgroup_says(tmp_path: Path, place: str) -> None:
    (tmp_path / place).parent.mkdir(parents=True)
    told = []
    for identity, peak in (("abc123", ""), ("../../etc", "99"), ("abc123", "123456\n")):
        (tmp_path / "id").write_text(identity)
        (tmp_path / place).write_text(peak)
        watch = ContainerWatch("name", tmp_path / "id", lambda name: None, cgroups=tmp_path)
        watch.look()
        told.append((watch.peak_bytes, watch.source))
    unread = (None, "not measured: the cgroup cannot be read here")
    assert told == [unread, unread, (123456, "the container's cgroup")]


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


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        ({"command": ["a", "{frame}"]}, "'{frame}' stands for nothing; known: {frames}"),
        ({"command": ["a"], "shell": True}, "shell = true takes the command as one line"),
        ({"command": "a 'b"}, "No closing quotation"),
        ({"command": ["a"], "runner": "docker"}, "runner 'docker' needs image"),
        ({"command": ["a"], "runner": "conda"}, "runner 'conda' needs environment"),
        ({"command": ["a"], "image": "x"}, "belong to runner 'docker'"),
        ({"command": ["a"], "environment": "x"}, "belongs to runner 'conda'"),
        ({"command": ["a"], "runner": "docker", "image": "i", "mounts": ["w:/w"]}, "is not HERE:THERE"),
        ({"command": ["a"], "runner": "docker", "image": "--privileged"}, "String should match pattern"),
        ({"command": ["a"], "format": "zip"}, "unknown format 'zip'"),
        ({"command": ["a"], "pass_variables": ["A=B"]}, "pattern"),
        ({"command": ["a"], "timeout_s": 0}, "greater than 0"),
    ],
)
def test_a_configuration_that_cannot_work_is_refused(config: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError) as caught:
        CommandConfig.model_validate_json(json.dumps(config))
    assert reason in str(caught.value)


def test_without_a_program_there_is_no_method() -> None:
    with pytest.raises(ConfigError, match="method 'command': no program is named"):
        Command(CommandConfig())


def test_another_version_of_the_program_is_another_run(tmp_path: Path) -> None:
    path = program(tmp_path, MASKS)
    words = (sys.executable, str(path), "{output}")
    before = Command(CommandConfig(command=words)).inputs
    assert f"file {path}" in before
    path.write_text(MASKS + "# changed")
    after = Command(CommandConfig(command=words)).inputs
    assert [name for name in before if before[name] != after[name]] == [f"file {path}"]


def test_a_run_scores_a_program_keeps_its_words_and_refuses_another_version_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.setattr(ColourPerception, "regions", lambda self: None, raising=False)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    text = """
import sys
import numpy as np
print("hello from the program", file=sys.stderr)
points = np.zeros((1, 3), "f4")
np.savez(sys.argv[1] + "/prediction.npz", kind="Partition", points=points, instance=np.zeros(1, "i4"),
         features=np.ones((1, 8), "f4"))
"""
    path = program(tmp_path, text)
    out = tmp_path / "run"
    words = ["run", "--scenes", f"{HERE}/painted.py:Painted/a", "--methods", "command", "--no-pictures"]
    words += ["--protocols", "rooms-semantic", "--out", str(out), "--jobs", "1"]
    words += ["--set", f'command.command=["{sys.executable}", "{path}", "{{output}}"]']
    assert main(words) == 0, capsys.readouterr().err
    told = json.loads((out / "metrics.json").read_text())
    assert told["results"][0]["method"] == "command"
    job = out / "scenes" / "painted.a" / "command"
    assert "stderr: hello from the program" in (job / "log.txt").read_text()
    assert "peak memory" in (job / "log.txt").read_text()
    assert "export_ms" in (job / "updates.csv").read_text()
    path.write_text(text + "# changed")
    capsys.readouterr()
    assert main(words) == 2
    error = capsys.readouterr().err
    assert f"input.file {path} was" in error
    path.write_text(text)
    assert main(words) == 0
    shutil.rmtree(out)
