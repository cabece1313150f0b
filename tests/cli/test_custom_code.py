"""A mistake in a user-defined method or dataset is a one-line error with file, line and what is expected.

The examples of docs/own-code.md run unchanged.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from places import ROOT

from su3d_bench.cli.main import main

METHOD, DATASET = "my_method.py:MyMethod", "my_dataset.py:MyDataset/near"
FEW = ("rooms.n_frames=8", "rooms.mesh_spacing_m=0.05")


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))


def written(what: str, as_it_is: str, wrong: str) -> str:
    """The template with a mistake in it."""
    assert main([f"{what}s", "new", f"my_{what}.py"]) == 0
    text = Path(f"my_{what}.py").read_text()
    assert as_it_is in text
    Path(f"my_{what}.py").write_text(text.replace(as_it_is, wrong, 1))
    return text


def answer(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The only line on stderr of a call with exit code 2."""
    capsys.readouterr()
    assert main(words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "internal" not in line
    return line


# The change to the template, and the message in addition to file and line.
METHODS = {
    "no Python": ("    def start(", "    def start", "SyntaxError"),
    "an end": ("class MyMethod:", "raise SystemExit(0)\n\n\nclass MyMethod:", "SystemExit: 0"),
    "no update": ("    def update(", "    def _update(", "'update' is missing; a method has Config, finish, name"),
    "unknown masks": (
        'masks="grounded"',
        'masks="boxes"',
        "needs: masks is 'boxes'; expected one of 'grounded', 'class-agnostic', 'none'",
    ),
    "no map": ("return Instances.of", "Instances.of", "MyMethod.finish returned None; expected Instances or Partition"),
    "undefined scores": (
        "np.ones(len(kept))",
        "np.full(len(kept), np.nan)",
        "finish: 'scores' has values that are NaN",
    ),
}


@pytest.mark.parametrize("mistake", METHODS)
def test_mistake_in_a_method_is_a_one_line_error(mistake: str, capsys: pytest.CaptureFixture[str]) -> None:
    as_it_is, wrong, printed = METHODS[mistake]
    written("method", as_it_is, wrong)
    line = answer(["methods", "check", METHOD], capsys)
    assert printed in line
    assert re.search(r"my_method\.py:\d+: ", line)


DATASETS = {
    "no info": ("return SceneInfo(", "SceneInfo(", "MyDataset.info returned None; expected SceneInfo"),
    "a stride that counts for nothing": (
        "for index in range(0, self._options.n_frames, stride)]",
        "for index in range(0, self._options.n_frames)]",
        "MyDataset.frames returned 80 frames at stride 2, but its info has n_frames 40",
    ),
    "millimetres": (
        "rgb, depth_m, camera",
        "rgb, (depth_m * 1000).astype(np.uint16), camera",
        "depth is uint16; expected",
    ),
    "a pose that scales": ("camera_to_world, INTR", "2 * camera_to_world, INTR", "the pose is not a rigid motion"),
    "unknown classes": (
        "[0, *LABELS.ids]",
        "[0, 7, 8, 9]",
        "ground_truth: semantic has the class id 7, which is not in its labels",
    ),
    "another space": (
        'label_space = "replica"',
        'label_space = "mine"',
        "its labels are of 'replica', but the class has",
    ),
    "a corner beyond": (
        "np.arange(3 * len(points)",
        "1 + np.arange(3 * len(points)",
        "instance_mesh: triangles has indices 1 to",
    ),
    "an exception": ("points, instance = self._surface(scene)", "points = {}[scene]", "KeyError: 'near'"),
}


@pytest.mark.parametrize("mistake", DATASETS)
def test_mistake_in_a_dataset_is_a_one_line_error(mistake: str, capsys: pytest.CaptureFixture[str]) -> None:
    as_it_is, wrong, printed = DATASETS[mistake]
    written("dataset", as_it_is, wrong)
    line = answer(["datasets", "check", DATASET, "--quick"], capsys)
    assert printed in line
    assert re.search(r"my_dataset\.py:\d+: ", line)


def test_run_reports_mistakes_in_a_dataset(capsys: pytest.CaptureFixture[str]) -> None:
    as_it_is, wrong, printed = DATASETS["unknown classes"]
    written("dataset", as_it_is, wrong)
    words = ["run", "--scenes", DATASET, "--profile", "oracle", "--protocols", "rooms-instance", "--limit", "1"]
    assert main([*words, "--methods", "oracle", "opensu3d", "--jobs", "1", "--out", "out", "--no-pictures"]) in (2, 3)
    error = capsys.readouterr().err
    assert printed in error and re.search(r"my_dataset\.py:\d+: ", error)


def test_missing_file_of_a_dataset_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    written("dataset", "        return ()", '        return (Path("gone.png"),)')
    capsys.readouterr()
    assert main(["datasets", "check", DATASET, "--quick"]) == 1
    assert "gone.png is missing" in capsys.readouterr().out


def test_file_may_contain_dataclasses_and_is_reloaded_after_a_change(capsys: pytest.CaptureFixture[str]) -> None:
    text = written("method", "class MyMethod:", "@dataclass\nclass Mine:\n    a: int = 1\n\n\nclass MyMethod:")
    mine = Path("my_method.py")
    mine.write_text(
        mine.read_text().replace("import itertools\n", "import itertools\nfrom dataclasses import dataclass\n")
    )
    assert main(["methods", "show", METHOD]) == 0
    mine.write_text(text.replace("stride: int = 40", "stride: int = 7"))
    capsys.readouterr()
    assert main(["methods", "show", METHOD]) == 0
    assert "stride = 7" in capsys.readouterr().out


def test_run_of_a_changed_file_is_not_resumed(capsys: pytest.CaptureFixture[str]) -> None:
    text = written("method", "", "")
    words = ["run", "--scenes", "rooms/bathroom0", "--set", *FEW, "--profile", "oracle", "--limit", "1"]
    words += ["--methods", METHOD, "--protocols", "rooms-instance", "--jobs", "1", "--no-pictures", "--out", "out"]
    assert main(words) == 0
    assert main(words) == 0
    Path("my_method.py").write_text(
        text.replace("least_points: int = 20", "least_points: int = 21").replace("< 0.5", "< 0.6")
    )
    assert "contains a different run" in answer(words, capsys)


def test_custom_dataset_is_scored_under_all_fitting_protocols(capsys: pytest.CaptureFixture[str]) -> None:
    written("dataset", "", "")
    words = ["run", "--scenes", DATASET, "--methods", "oracle", "--limit", "1", "--jobs", "1", "--no-pictures"]
    assert main([*words, "--profile", "oracle", "--out", "out"]) == 0
    assert "my-dataset: scored under all protocols that fit its ground truth; choose with" in capsys.readouterr().err
    found = json.loads(Path("out/metrics.json").read_text())["results"]
    assert {"rooms-instance", "rooms-semantic", "replica-openmask3d"} <= {one["protocol"] for one in found}
    assert all(one["result"]["metrics"][one["headline"][0]] == 1 for one in found)


def test_ground_truth_without_a_fitting_protocol_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    text = written("dataset", "", "")
    Path("my_dataset.py").write_text(text.replace('"replica"', '"mine"'))
    words = ["run", "--scenes", DATASET, "--methods", "opensu3d", "--limit", "1", "--jobs", "1", "--no-pictures"]
    assert main([*words, "--profile", "oracle", "--out", "out"]) == 0
    printed = "my-dataset: no protocol fits its ground truth mesh-vertices with labels of 'mine'; create a custom one"
    assert printed in capsys.readouterr().err


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


def test_method_of_the_page_runs_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    (text,) = [block for block in blocks("docs/own-code.md", "python") if "class " in block]
    Path("my_method.py").write_text(text)
    assert main(["methods", "check", METHOD]) == 0
    assert "instances, with features: OK" in capsys.readouterr().out


def results(folder: str) -> dict[tuple[str, str], dict[str, float]]:
    found = json.loads((Path(folder) / "metrics.json").read_text())["results"]
    return {(one["method"], one["protocol"]): one["result"]["metrics"] for one in found}


def test_templates_of_method_dataset_and_protocol_run_together(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods", "new", "merge_all.py"]) == 0
    assert "su3d-bench methods check merge_all.py:MergeAll" in capsys.readouterr().out
    assert main(["datasets", "new", "own/my_rooms.py"]) == 0
    assert main(["protocols", "new", "mine.toml"]) == 0
    Path("mine.toml").write_text(Path("mine.toml").read_text().replace("rooms-instance", "replica-openmask3d"))
    scenes, methods = "own/my_rooms.py:MyRooms/*", "merge_all.py:MergeAll"
    assert main(["datasets", "check", scenes]) == 0
    assert capsys.readouterr().out.count(" s: OK\n") == 2
    for command in (["datasets", "check"], ["datasets", "show"], ["run"]):
        assert main([*command, scenes.removesuffix("/*")]) == 2
        assert f"is a dataset; name its scenes, such as '{scenes}'" in capsys.readouterr().err
    words = ["run", "--scenes", scenes, "--methods", methods, "--profile", "oracle", "--jobs", "1", "--out", "run"]
    assert main([*words, "--no-pictures", "--protocols", "mine.toml"]) == 0
    assert results("run")["merge-all", "mine"]["AP25"] == 1.0


def test_method_template_runs_on_the_built_in_rooms() -> None:
    assert main(["methods", "new", "my_method.py"]) == 0
    words = "--scenes rooms/bathroom0 --profile oracle --jobs 1 --out r --no-pictures"
    words += f" --protocols rooms-instance --set {' '.join(FEW)}"
    assert main(["run", "--methods", "my_method.py:MyMethod", *words.split()]) == 0
    assert results("r")["my-method", "rooms-instance"]["AP25"] > 0


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        (["methods", "new", "there.py"], "exists; choose another name"),
        (["methods", "new", "my_method.txt"], "must end in .py"),
        (["protocols", "new", "mine.py"], "must end in .toml"),
        (["datasets", "new", "3.py"], "is not a valid name"),
    ],
)
def test_new_overwrites_nothing_and_checks_the_suffix(
    words: list[str], printed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("there.py").write_text("mine")
    assert main(words) == 2
    assert printed in capsys.readouterr().err
    assert Path("there.py").read_text() == "mine"
    assert len(list(Path().iterdir())) == 1
