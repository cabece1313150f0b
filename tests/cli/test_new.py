"""What ``su3d-bench new`` writes runs as it stands, in a folder where nothing else is."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from su3d_bench.cli.main import main


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))


def results(folder: str) -> dict[tuple[str, str], dict[str, float]]:
    found = json.loads((Path(folder) / "metrics.json").read_text())["results"]
    return {(one["method"], one["protocol"]): one["result"]["metrics"] for one in found}


def test_method_dataset_and_protocol_run_together_as_they_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "method", "merge_all.py"]) == 0
    assert "su3d-bench methods check merge_all.py:MergeAll" in capsys.readouterr().out
    assert main(["new", "dataset", "own/my_rooms.py"]) == 0
    assert main(["new", "protocol", "mine.toml"]) == 0
    Path("mine.toml").write_text(Path("mine.toml").read_text().replace("rooms-instance", "replica-openmask3d"))
    scenes, methods = "own/my_rooms.py:MyRooms/*", "merge_all.py:MergeAll"
    assert main(["datasets", "check", scenes]) == 0
    assert capsys.readouterr().out.count("nothing found wrong") == 2
    words = ["run", "--scenes", scenes, "--methods", methods, "--profile", "oracle", "--jobs", "1", "--out", "run"]
    assert main([*words, "--no-pictures", "--protocols", "mine.toml"]) == 0
    assert results("run")["merge-all", "mine"]["AP25"] == 1.0


def test_the_method_runs_on_the_built_in_rooms() -> None:
    assert main(["new", "method", "my_method.py"]) == 0
    words = [
        "--scenes",
        "rooms/living0",
        "--set",
        "rooms.n_frames=8",
        "--profile",
        "oracle",
        "--jobs",
        "1",
        "--out",
        "r",
    ]
    protocols = ["--protocols", "rooms-instance", "rooms-semantic", "--no-pictures"]
    assert main(["run", "--methods", "my_method.py:MyMethod", *words, *protocols]) == 0
    assert results("r")["my-method", "rooms-instance"]["AP25"] > 0


# What is made of the method, and what is said of it: the file, the line, what was expected.
MISTAKES = {
    "no import": ("import pydantic\n", "", "NameError: name 'pydantic' is not defined"),
    "no needs": (
        "return PerceptionNeeds",
        "PerceptionNeeds",
        "MyMethod.needs gave None; a PerceptionNeeds is expected",
    ),
    "no map": ("return Instances.of", "Instances.of", "MyMethod.finish gave None; an Instances or"),
    "a word": ("clouds = [", "clouds = [None for _ in known] + [", "NameError: name 'known' is not defined"),
    "whole scores": ("np.ones(len(kept))", "np.ones(len(kept), int)", "'scores' is an array"),
    "no Python": ("    def start(", "    def start", "SyntaxError"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_method_is_one_line_with_its_file_and_line(
    mistake: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "method", "my_method.py"]) == 0
    as_it_is, wrong, said = MISTAKES[mistake]
    text = Path("my_method.py").read_text()
    assert as_it_is in text
    Path("my_method.py").write_text(text.replace(as_it_is, wrong, 1))
    capsys.readouterr()
    assert main(["methods", "check", "my_method.py:MyMethod"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line
    assert re.search(r"my_method\.py:\d+: ", line)


def test_a_method_that_is_right_is_said_to_be(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "method", "my_method.py"]) == 0
    assert main(["methods", "check", "my_method.py:MyMethod"]) == 0
    assert "instances, with features: nothing found wrong" in capsys.readouterr().out
    assert main(["methods", "check"]) == 2
    assert main(["methods", "opensu3d", "sam3d"]) == 2


WRONG_DATASETS = {
    "info": ("return SceneInfo(", "SceneInfo(", "MyDataset.info gave None; a SceneInfo is expected"),
    "frames": ("return [self._frame", "return [None and self._frame", "MyDataset.frames(...)[k] gave None; a Frame"),
    "scenes": ('return ("near", "far")', "pass", "MyDataset.scenes gave None; a sequence is expected"),
    "truth": ("return GroundTruth(", "GroundTruth(", "MyDataset.ground_truth gave None; a GroundTruth is expected"),
}


@pytest.mark.parametrize("mistake", WRONG_DATASETS)
@pytest.mark.parametrize("verb", [["run", "--profile", "oracle", "--scenes"], ["datasets", "check"]])
def test_a_mistake_in_a_dataset_is_told_with_its_file_and_line(
    mistake: str, verb: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "dataset", "my_dataset.py"]) == 0
    as_it_is, wrong, said = WRONG_DATASETS[mistake]
    text = Path("my_dataset.py").read_text()
    Path("my_dataset.py").write_text(text.replace(as_it_is, wrong, 1))
    protocols = ["--protocols", "replica-openmask3d", "--out", "out", "--jobs", "1"] if verb[0] == "run" else []
    assert main([*verb, "my_dataset.py:MyDataset/near", *protocols]) in (1, 2, 3)
    told = capsys.readouterr()
    assert re.search(r"my_dataset\.py:\d+: ", told.out + told.err)
    assert said in told.out + told.err
    assert "internal" not in told.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["method", "there.py"], "is there already"),
        (["method", "my_method.txt"], "must end in .py"),
        (["protocol", "mine.py"], "must end in .toml"),
        (["dataset", "3.py"], "no name can be made"),
    ],
)
def test_nothing_is_overwritten_and_no_file_gets_another_form(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("there.py").write_text("mine")
    assert main(["new", *words]) == 2
    assert said in capsys.readouterr().err
    assert Path("there.py").read_text() == "mine"
    assert len(list(Path().iterdir())) == 1
