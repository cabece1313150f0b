"""The command ``runs export``: atomic export of runs and of other programs' predictions."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from painted import colour_perception
from places import SCENES
from prediction_files import TOY, write_open3dis, write_scannet_text

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.predictions.base import VertexMasks
from su3d_bench.predictions.formats import READERS, recognise

PAINTED, COLLECTOR = f"{SCENES}/painted.py:Painted", f"{SCENES}/painted.py:Collector"
RULES = load_protocol("rooms-instance")


def read_text(folder: Path, scene: str) -> VertexMasks:
    content = READERS["scannet-text"].read(folder, scene).content
    assert isinstance(content, VertexMasks)
    return content


@pytest.fixture
def run_folder(painted_place: Path) -> str:
    """A finished run of two scenes by two methods."""
    words = ["run", "--scenes", f"{PAINTED}/a", f"{PAINTED}/b", "--methods", COLLECTOR, "oracle", "--jobs", "1"]
    assert main([*words, "--protocols", "rooms-instance", "--no-pictures", "--quiet", "--out", "r"]) == 0
    return "r"


def error_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["runs", "export", *words, "--out", "never"]) == 2
    answer = capsys.readouterr()
    assert answer.out == "" and not Path("never").exists()
    assert answer.err.count("\n") == 1
    return answer.err


def test_run_is_exported_for_openlex3d(run_folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    words = ["runs", "export", run_folder, "--to", "openlex3d", "--method", "collector"]
    assert main([*words, "--out", "x/collector"]) == 0
    assert capsys.readouterr().out == "2 scenes for openlex3d: x/collector\n"
    for scene in ("a", "b"):
        own = READERS["su3d-bench"].read(Path(f"r/scenes/painted.{scene}/collector/prediction.npz"), f"painted/{scene}")
        found = recognise(Path("x/collector")).read(Path("x/collector"), f"painted/{scene}").content
        assert isinstance(found, Partition) and isinstance(own.content, Instances)
        np.testing.assert_array_equal(found.points, own.content.points)
        np.testing.assert_array_equal(found.features, own.content.features)


def test_run_is_exported_for_scannet(run_folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["runs", "export", run_folder, "--to", "scannet", "--protocol", "rooms-instance"]
    capsys.readouterr()
    assert main([*words, "--method", "collector", "--out", "collector", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["scene"] for row in result["scenes"]] == ["painted/a", "painted/b"]
    assert main([*words, "--method", "oracle", "--out", "oracle", "--scenes", "painted/b"]) == 0
    assert sorted(file.name for file in Path("oracle").glob("*.txt")) == ["b.txt"]
    found = read_text(Path("oracle"), "b")
    ids = set() if found.class_numbers is None else set(found.class_numbers.tolist())
    assert ids == {20, 76, 80, 93}
    collected = read_text(Path("collector"), "b")
    assert collected.class_numbers is not None and set(collected.class_numbers.tolist()) == ids


def test_maps_of_an_interrupted_run_are_exported_too(run_folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("r/metrics.json").unlink()
    record = json.loads(Path("r/run.json").read_text())
    Path("r/run.json").write_text(json.dumps({**record, "status": "running", "data_digests": {}}))
    words = ["runs", "export", run_folder, "--to", "scannet", "--protocol", "rooms-instance", "--method", "oracle"]
    assert main([*words, "--out", "oracle"]) == 0
    assert sorted(file.name for file in Path("oracle").glob("*.txt")) == ["a.txt", "b.txt"]


def test_map_is_not_labelled_with_changed_data(run_folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    mark_complete = Path("r/scenes/painted.b/oracle/done.json")
    record = json.loads(mark_complete.read_text())
    record["steps"]["predict"]["key"]["data"] = "another"
    mark_complete.write_text(json.dumps(record))
    words = ("--to", "scannet", "--protocol", "rooms-instance", "--method", "oracle")
    assert "painted/b: its data have changed since the run; run it again" in error_of(capsys, run_folder, *words)


def test_only_method_of_a_limited_run_is_exported_with_a_partial_warning(
    run_folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "--scenes", f"{PAINTED}/a", "--methods", COLLECTOR, "--jobs", "1", "--limit", "2", "--out", "part"]
    assert main([*words, "--protocols", "rooms-instance", "--no-pictures", "--quiet"]) == 0
    capsys.readouterr()
    assert Path("part/scenes/painted.a/oracle/prediction.npz").is_file()  # the ceiling
    assert main(["runs", "export", "part", "--to", "openlex3d", "--out", "x"]) == 0
    assert len(np.load("x/painted/a/embeddings.npy")) == 4
    assert "painted/a: partial: the map uses only the first 2 updates\n" in capsys.readouterr().err


def test_predictions_of_other_programs_are_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_scannet_text(Path("theirs"), TOY)
    assert main(["runs", "export", "theirs", "--to", "scannet", "--out", "ours"]) == 0
    theirs, ours = (read_text(Path(name), "scene0011_00") for name in ("theirs", "ours"))
    np.testing.assert_array_equal(theirs.indices, ours.indices)
    assert theirs.scores.tolist() == ours.scores.tolist()
    assert "has no points" in error_of(capsys, "theirs", "--to", "openlex3d")
    write_open3dis(Path("indexed"), TOY)
    assert "name it, such as --scenes replica/scene0011_00" in error_of(capsys, "indexed", "--to", "scannet")
    message = error_of(capsys, "indexed", "--to", "scannet", "--scenes", f"{PAINTED}/scene0011_00")
    assert "no scene matches" in message


def test_invalid_request_is_a_one_line_error_and_writes_nothing(
    run_folder: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    r = run_folder
    shutil.copytree("r/scenes/painted.a/oracle", "r/scenes/painted.a/second")
    assert "has maps of collector, second; choose one with --method" in error_of(capsys, r, "--to", "openlex3d")
    shutil.rmtree("r/scenes/painted.a/second")
    message = error_of(capsys, r, "--to", "openlex3d", "--method", "colector")
    assert "no map of method 'colector'; did you mean 'collector'?" in message
    message = error_of(capsys, r, "--to", "openlex3d", "--method", "collector", "--scenes", "painted/z")
    assert "r: no scene matches 'painted/z'; did you mean" in message
    assert "has no features" in error_of(capsys, r, "--to", "openlex3d", "--method", "oracle")
    message = error_of(capsys, r, "--to", "scannet", "--method", "oracle")
    assert "no default protocol; choose one with --protocol" in message
    message = error_of(capsys, r, "--to", "scannet", "--method", "oracle", "--protocol", "rooms-semantic")
    assert "--protocol rooms-semantic: no instance classes" in message
    message = error_of(capsys, r, "--to", "openlex3d", "--protocol", "rooms-instance", "--method", "collector")
    assert "only valid with --to scannet" in message
    assert "r/none: no such file or folder" in error_of(capsys, "r/none", "--to", "scannet")
    assert "only valid for a run folder" in error_of(capsys, "data", "--to", "scannet", "--method", "oracle")
    assert "unknown --to 'openlex'; did you mean 'openlex3d'?" in error_of(capsys, r, "--to", "openlex")
    # the second scene cannot be read: the first is not exported either
    Path("r/scenes/painted.b/collector/prediction.npz").write_bytes(b"PK")
    message = error_of(capsys, r, "--to", "openlex3d", "--method", "collector")
    assert "painted.b/collector/prediction.npz" in message
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".never")]


def test_features_outside_of_a_run_need_text_features(run_folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("a.npz").write_bytes(Path("r/scenes/painted.a/collector/prediction.npz").read_bytes())
    words = ["a.npz", "--to", "scannet", "--protocol", "rooms-instance", "--scenes", f"{PAINTED}/*"]
    assert "--text-features FILE.npz (names, features)" in error_of(capsys, *words)
    names = [entry.name for entry in RULES.classes]
    np.savez("texts.npz", names=np.array(names), features=colour_perception().encoder.encode_texts(names))
    assert main(["runs", "export", *words, "--text-features", "texts.npz", "--out", "by-texts"]) == 0
    of_run = ["runs", "export", "r", *words[1:5], "--method", "collector", "--scenes", "painted/a"]
    assert main([*of_run, "--out", "by-run"]) == 0
    assert Path("by-texts/a.txt").read_text() == Path("by-run/a.txt").read_text() != ""
    Path("a.npz").write_bytes(Path("r/scenes/painted.a/oracle/prediction.npz").read_bytes())
    assert main(["runs", "export", *words, "--out", "named"]) == 0
    assert Path("named/a.txt").read_text().count(" 76 1.0") == 1
