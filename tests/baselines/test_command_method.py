"""User programs as methods: their input folder, their output, how they are run, measured and ended."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import ColourPerception, Painted
from painted_runs import see_painted
from places import SCENES

from su3d_bench.baselines.command.folders import FrameFolder, class_names
from su3d_bench.baselines.command.method import Command, CommandConfig
from su3d_bench.baselines.command.placeholders import check_placeholders
from su3d_bench.cli.main import main
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Frame, SceneInfo, Surface
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.predictions.base import vertex_masks
from su3d_bench.runs.frame_loop import no_detections

SCENE = SceneInfo("rooms", "a b", 6, 1, "rendered-rooms", seed=7)
SURFACE = Surface(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [3, 0, 0]], np.float32),
    np.array([[0, 1, 2], [0, 1, 3]], np.int32),
)
# Two masks over five vertices in ScanNet's text format, with the class ids of chair and wall in the rooms.
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


def fed(
    one: Command,
    surface: Surface | None = SURFACE,
    shots: Sequence[Frame] | None = None,
    scene: SceneInfo = SCENE,
) -> Command:
    shots = frames() if shots is None else shots
    one.start(scene if surface is None else replace(scene, read_surface=lambda: surface))
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


def test_exported_folder_reads_back_as_the_same_frames(tmp_path: Path) -> None:
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


def test_prediction_with_points_needs_no_mesh(tmp_path: Path) -> None:
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


def test_ambiguous_class_numbers_need_a_protocol() -> None:
    content = vertex_masks("m", [np.zeros(0, np.int32)], 5, class_numbers=np.array([3], np.int32))
    with pytest.raises(PredictionError, match="its class numbers are ambiguous"):
        class_names(content, "scannet", None)
    assert class_names(content, "scannet", "scannet-instance")[3] == "cabinet"
    places = replace(content, numbering="index")
    assert class_names(places, "scannet", "scannet-instance")[0] == "cabinet"


@pytest.mark.parametrize(
    ("text", "config", "line"),
    [
        (
            "import sys; print('\\x1b[31mno weights\\x07', file=sys.stderr); sys.exit(3)",
            {},
            "rooms/a b: command: exit code 3; its last line: \\x1b[31mno weights\\x07",
        ),
        ("import os; os.kill(os.getpid(), 9)", {}, "terminated by signal 9; it wrote nothing to stderr"),
        ("", {}, "it reports no error but wrote nothing to {output}"),
        ("import sys; open(sys.argv[1] + '/x.bin', 'wb').write(b'?')", {}, "{output}: is in no known format"),
        ("import sys; open(sys.argv[1] + '/p.npz', 'wb').write(b'?')", {"format": "openmask3d"}, "{output}"),
    ],
    ids=["exit-code", "signal", "nothing", "unknown-format", "wrong-format"],
)
def test_each_failure_is_one_line(tmp_path: Path, text: str, config: dict[str, Any], line: str) -> None:
    assert line in refused(method(tmp_path, text, **config))


def test_slow_program_is_terminated_and_its_last_line_reported() -> None:
    # a shell starts at once, however busy the machine is
    one = fed(Command(CommandConfig(command="echo loading >&2; sleep 60", shell=True, timeout_s=2.0)))
    assert "terminated after 2 s (timeout_s); its last line: loading" in refused(one)


def test_only_allowed_variables_reach_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SECRET_TOKEN", "x")
    monkeypatch.setenv("MY_MODEL", "large")
    text = "import os; print(sorted(os.environ))" + MASKS
    one = method(tmp_path, text, pass_variables=("MY_MODEL",))
    one.finish()
    one.close()
    result = next(record.getMessage() for record in caplog.records if record.getMessage().startswith("stdout"))
    assert "MY_MODEL" in result
    assert "SECRET_TOKEN" not in result
    assert "PATH" not in result


def test_placeholders_are_filled_without_a_shell(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = "import sys; print(sys.argv[2:])" + MASKS
    one = method(tmp_path, text, "{output}", "{dataset}/{scene}", "--seed={seed}", "$(id);{}")
    one.finish()
    one.close()
    assert "stdout: ['rooms/a b', '--seed=7', '$(id);{}']" in caplog.text


def test_line_is_split_into_words_and_uses_a_shell_only_on_request(tmp_path: Path) -> None:
    path = program(tmp_path, MASKS)
    for config in (
        CommandConfig(command=f"'{sys.executable}' {path} {{output}}"),
        CommandConfig(command=f"echo {{scene}} | grep 'a b' && '{sys.executable}' {path} {{output}}", shell=True),
    ):
        one = fed(Command(config))
        assert len(one.finish().scores) == 2  # type: ignore[union-attr]
        one.close()
    assert CommandConfig(command="a 'b c' {output}").words == ("a", "b c", "{output}")


HOSTILE = "x$(touch P)`touch P`'; touch P; '\"; touch P #\n&& touch P"
SHOWN = "import sys; open(sys.argv[1] + '/../shown', 'w').write(repr(sys.argv[2:]))"


@pytest.mark.parametrize(
    "line",
    [
        "RUN {output} {scene}",
        'false $SU3D_SCENE; RUN {output} "$SU3D_SCENE"',
        "# don't be afraid of {scene}\nRUN {output} {scene}",
        'RUN "$SU3D_OUTPUT" `true {scene}` {scene} # {scene}',
        """sh -c '"$@" "$SU3D_OUTPUT" "$SU3D_SCENE"' sh RUN""",
        'for s in {scene}; do RUN {output} "$s"; done',
    ],
)
def test_shell_gets_the_scene_name_only_as_a_value(tmp_path: Path, line: str) -> None:
    line = line.replace("RUN", f"'{sys.executable}' '{program(tmp_path, SHOWN)}'")
    one = fed(Command(CommandConfig(command=line, shell=True)), scene=replace(SCENE, scene=HOSTILE))
    with pytest.raises(PredictionError, match="it reports no error but wrote nothing"):
        one.finish()
    assert one._scratch is not None
    assert (one._scratch.path / "shown").read_text() == repr([HOSTILE])
    assert not list((one._scratch.path / "work").iterdir())
    one.close()


@pytest.mark.parametrize(
    "line",
    [
        'a "{scene}"',
        "a '{scene}'",
        'a "x \\" {output}/y"',
        "a 'x \\' {output} 'y {seed}'",
        'a "$(b {scene})"',
        "a ${scene}",
        "a \\{scene}",
        "sh <<E\nb {scene}\nE",
    ],
)
def test_placeholder_read_as_shell_commands_is_rejected(line: str) -> None:
    with pytest.raises(ValueError, match="where a shell would read its value as commands; write "):
        check_placeholders(line, is_shell=True)


def test_finish_midway_gives_the_map_so_far_and_changes_nothing(tmp_path: Path) -> None:
    text = """
import os, sys
out, frames = sys.argv[1:]
assert not os.listdir(out)
names = [name[:-4] for name in os.listdir(frames + "/colour")]
open(out + "/scene.txt", "w").writelines(f"masks/{name}.txt 20 1\\n" for name in names)
os.mkdir(out + "/masks")
for name in names:
    open(out + f"/masks/{name}.txt", "w").write("1\\n" * 5)
"""
    one = method(tmp_path, text, "{output}", "{frames}", format="scannet-text")
    assert [_n_masks(one) for _ in range(2)] == [3, 3]
    late = frames(4)[3]
    one.update(late, no_detections(late, one.needs), Timer())
    assert _n_masks(one) == 4
    assert one.finish_costs["program_s"] > 0
    one.close()


def _n_masks(one: Command) -> int:
    found = one.finish()
    assert isinstance(found, Instances)
    return len(found)


def test_no_files_are_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    one = method(tmp_path, MASKS)
    one.finish()
    assert list((tmp_path / "scratch").iterdir())
    one.close()
    assert not list((tmp_path / "scratch").iterdir())


def test_another_version_of_the_program_is_another_run(tmp_path: Path) -> None:
    path = program(tmp_path, MASKS)
    words = (sys.executable, str(path), "{output}")
    before = Command(CommandConfig(command=words)).inputs
    assert f"file {path}" in before
    path.write_text(MASKS + "# changed")
    after = Command(CommandConfig(command=words)).inputs
    assert [name for name in before if before[name] != after[name]] == [f"file {path}"]


def test_run_scores_a_program_logs_its_output_and_rejects_another_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    see_painted(monkeypatch)
    monkeypatch.setattr(ColourPerception, "regions", lambda self: None, raising=False)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    text = """
import sys
import numpy as np
print("hello from the program", file=sys.stderr)
points = np.array([[1, 1, 2]], "f4")
np.savez(sys.argv[1] + "/prediction.npz", kind="Partition", points=points, instance=np.zeros(1, "i4"),
         features=np.ones((1, 8), "f4"))
"""
    path = program(tmp_path, text)
    out = tmp_path / "run"
    words = ["run", "--scenes", f"{SCENES}/painted.py:Painted/a", "--methods", "command", "--no-pictures"]
    words += ["--protocols", "rooms-semantic", "--out", str(out), "--jobs", "1"]
    words += ["--set", f'command.command=["{sys.executable}", "{path}", "{{output}}"]']
    assert main(words) == 0, capsys.readouterr().err
    result = json.loads((out / "metrics.json").read_text())
    assert result["results"][0]["method"] == "command"
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
