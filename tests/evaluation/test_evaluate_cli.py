"""The command ``evaluate``: output, files and errors."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from evaluated_text import CHAIR, TABLE, scene, write_truth
from prediction_files import write_scannet_text

from su3d_bench.cli import output
from su3d_bench.cli.main import main


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two scenes with a chair and a table in ``gt``, predicted in ``pred``: one correctly, one without the table."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    for name, n in (("scene0001_00", 2), ("scene0001_01", 1)):
        write_truth(Path("gt"), name)
        write_scannet_text(Path("pred"), scene([CHAIR, TABLE][:n], [5, 7][:n], [0.9, 0.8][:n], name=name))


WORDS = ["evaluate", "pred/", "--ground-truth", "gt/", "--protocols", "scannet-instance"]


def test_table_has_values_with_interval_ceiling_and_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*WORDS, "--json", "out/numbers.json"]) == 0
    answer = capsys.readouterr()
    assert answer.out.startswith("**scannet-instance (version 1)**\n")
    rows = {line.split("|")[1].strip(): line for line in answer.out.splitlines() if line.startswith("|")}
    cells = [cell.strip() for cell in rows["predictions"].split("|")[2:-1]]
    assert cells == [*["75.0 [0.0, 100.0]"] * 3, "100.0 / 100.0 / 100.0", "2", "-"]  # of two scenes
    assert "75.0 " in rows["predictions: mean over scenes"] and "predictions: each mask under each class" in rows
    assert "the mean over scenes weights each scene equally" in answer.out
    assert (
        "- predictions per scene: 1.5 (1 to 2); near-duplicate pairs 0, identical pairs 0; confidences 0.8"
        in answer.out
    )
    assert "- coverage: unknown because the ground truth has no coordinates" in answer.out
    assert "format: scannet-text; ground truth: gt\n" in answer.err
    assert "written: out/numbers.json\n" in answer.err


def test_json_file_has_the_documented_form(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*WORDS, "--json", "out.json", "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    value = json.loads(Path("out.json").read_text())
    assert value["schema"] == 1
    one = value["protocols"]["scannet-instance"]
    assert {"version", "metrics", "per_class", "per_scene", "warnings"} <= set(one)
    assert one["metrics"] == {"ap": 0.75, "ap50": 0.75, "ap25": 0.75}
    assert one["per_class"]["table"] == {"ap": 0.5, "ap50": 0.5, "ap25": 0.5}
    assert one["per_class"]["sofa"]["ap"] is None
    assert one["per_scene"]["scene0001_01"]["ap"] == 0.5


def test_long_evaluation_prints_lines_with_the_time_left_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(WORDS) == 0 and "steps" not in capsys.readouterr().err
    monkeypatch.setattr(output, "LINE_EVERY_S", 1e-9)
    assert main(WORDS) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("evaluate: ")]
    assert re.fullmatch(r"evaluate: scene0001_00 done, 1 of 2 steps, about \d+ s left", lines[0])
    assert lines[1:] == ["evaluate: scene0001_01 done, 2 of 2 steps"]


WRONG = {
    "": "evaluate: no predictions given; name a folder or files, or --predictions METHOD=PREDICTIONS",
    "pred --out runs/mine --name ../up --ground-truth gt": "--name: '../up' is not a valid folder name",
    "prde --ground-truth gt": "prde: no such file or folder; give the folder of the predictions",
    "pred": "evaluate: no ground truth given; name it with --dataset scannet or --ground-truth DIR",
    "pred --ground-truth .": ".: has no .txt file; expected <scene>.txt, one value per point",
    "pred --ground-truth gt --protocols scannet-instances": "unknown protocol 'scannet-instances'; did you mean",
    "pred --ground-truth gt --input-format scanet-text": "unknown format 'scanet-text'; did you mean 'scannet-text'?",
    "pred --ground-truth gt --scenes scene0009_00": "no scene of gt matches 'scene0009_00'; did you mean",
    "pred --ground-truth gt --text-features none.npz": "none.npz: cannot be read: No such file or directory",
    "pred --ground-truth gt --protocols replica-mesh-ex6": "pred: scene0001_00: replica-mesh-ex6: needs a class for",
}


def test_invalid_input_gives_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    for words, line in WRONG.items():
        assert main(["evaluate", *words.split(), "--json", "out.json"]) == 2
        answer = capsys.readouterr()
        assert answer.out == ""
        assert answer.err.startswith(f"su3d-bench: {line}") and answer.err.count("\n") == 1
        assert not Path("out.json").exists()


def test_oracle_on_rooms_scores_exactly_one(
    rooms_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    run = ["run", "--scenes", "rooms/bathroom0", "--methods", "oracle", "--no-pictures", "--jobs", "1", "--out", "run"]
    assert main(run) == 0
    ran = capsys.readouterr()
    assert "rooms-semantic" in ran.out and "rooms-instance" not in ran.out
    assert "4 more protocols apply: su3d-bench run --extend --all-protocols --out run\n" in ran.err
    assert main(["run", "--extend", "--all-protocols", "--out", "run", "--quiet"]) == 0
    capsys.readouterr()
    assert main(["evaluate", "run"]) == 0
    evaluated = capsys.readouterr()
    assert "rooms-semantic" in evaluated.out and "rooms-instance" not in evaluated.out
    assert "4 more protocols apply: --all-protocols\n" in evaluated.err
    assert main(["evaluate", "run", "--all-protocols", "--json", "out.json"]) == 0
    protocols = json.loads(Path("out.json").read_text())["protocols"]
    assert {"rooms-instance", "rooms-semantic", "replica-openmask3d", "replica-mesh-ex6"} <= set(protocols)
    for name, one in protocols.items():
        assert set(one["metrics"].values()) == {1.0}, name
        assert set(one["ceiling"].values()) == {1.0}, name
    metrics = json.loads(Path("run/metrics.json").read_text())["results"]
    assert {one["protocol"] for one in metrics} == set(protocols)
