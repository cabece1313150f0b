"""What ``new`` of methods, datasets and protocols writes runs as it stands, in a folder where nothing else is."""

from __future__ import annotations

import json
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
    assert main(["methods", "new", "merge_all.py"]) == 0
    assert "su3d-bench methods check merge_all.py:MergeAll" in capsys.readouterr().out
    assert main(["datasets", "new", "own/my_rooms.py"]) == 0
    assert main(["protocols", "new", "mine.toml"]) == 0
    Path("mine.toml").write_text(Path("mine.toml").read_text().replace("rooms-instance", "replica-openmask3d"))
    scenes, methods = "own/my_rooms.py:MyRooms/*", "merge_all.py:MergeAll"
    assert main(["datasets", "check", scenes]) == 0
    assert capsys.readouterr().out.count("nothing found wrong") == 2
    words = ["run", "--scenes", scenes, "--methods", methods, "--profile", "oracle", "--jobs", "1", "--out", "run"]
    assert main([*words, "--no-pictures", "--protocols", "mine.toml"]) == 0
    assert results("run")["merge-all", "mine"]["AP25"] == 1.0


def test_the_method_runs_on_the_built_in_rooms() -> None:
    assert main(["methods", "new", "my_method.py"]) == 0
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


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["methods", "new", "there.py"], "is there already"),
        (["methods", "new", "my_method.txt"], "must end in .py"),
        (["protocols", "new", "mine.py"], "must end in .toml"),
        (["datasets", "new", "3.py"], "no name can be made"),
    ],
)
def test_nothing_is_overwritten_and_no_file_gets_another_form(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("there.py").write_text("mine")
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert Path("there.py").read_text() == "mine"
    assert len(list(Path().iterdir())) == 1
