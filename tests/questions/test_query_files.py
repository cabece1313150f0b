"""Files of text queries: both forms, each fault once, damaged copies, and a map scored under query-ap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from damage import damages, outcomes, truncations
from replica_scene import QUADS, TWO_OBJECTS, write_original, write_render

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.types import GroundTruth
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.open_vocabulary.query_ap import TextQuery
from su3d_bench.questions.files.queries import read_query_file

TOML = """[[query]]
scene = "replica/room0"
text = "a place to sit"
objects = [1]

[[query]]
scene = "room0"
text = "something to eat at"
objects = [6]
"""
CSV = 'scene,text,objects\nroom0,a place to sit,1\nreplica/room0,"something to eat at",6\n'
QUERIES = {"room0": (TextQuery("a place to sit", (1,)), TextQuery("something to eat at", (6,)))}


@pytest.mark.parametrize(("name", "content"), [("q.toml", TOML), ("q.csv", CSV)])
def test_both_forms_give_the_queries_of_each_scene(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    assert read_query_file(tmp_path / name) == QUERIES


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("q.toml", "query = 3", r"q\.toml: expected tables \[\[query\]\]"),
        ("q.toml", TOML.replace("text", "words"), "q.toml: query 1: expected the keys scene, text, objects"),
        ("q.toml", TOML.replace("[1]", '["1"]'), "q.toml: query 1: 'objects' must be a list of instance ids"),
        ("q.toml", TOML.replace("[1]", "[]"), "q.toml: query 1: 'objects' must name at least one"),
        ("q.toml", TOML.replace("[1]", "[4, 4]"), "q.toml: query 1: an object stands there twice"),
        ("q.toml", TOML + TOML, "q.toml: query 3: the query 'a place to sit' stands there twice for replica/room0"),
        ("q.toml", TOML.replace('"a place', '"\\u001b[2Ja place'), "q.toml: query 1: 'scene' and 'text' must be words"),
        ("q.csv", CSV.replace("text", "words"), "q.csv: the first line must be scene,text,objects"),
        ("q.csv", CSV.replace(",1\n", ",one\n"), "q.csv: row 2: 'objects' must be instance ids"),
        ("q.csv", CSV.replace(",1\n", "\n"), "q.csv: row 2: has 2 columns"),
        ("q.csv", "scene,text,objects\n", "q.csv: holds no query"),
    ],
)
def test_what_is_no_query_is_one_line(tmp_path: Path, name: str, content: str, line: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match=line):
        read_query_file(tmp_path / name)


@pytest.mark.parametrize(("name", "content"), [("q.toml", TOML), ("q.csv", CSV)])
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name

    def read(damaged: bytes) -> object:
        path.write_bytes(damaged)
        return read_query_file(path)

    for copies in (truncations(content.encode()), damages(content.encode())):
        _, n_refused = outcomes(read, copies, must_name=name)
        assert n_refused > 20


def write_map(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two objects of a made scene as a map of an instance each, and features of the texts that ask for them."""
    write_render(folder / "data")
    write_original(folder / "data", QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    monkeypatch.setenv("SU3D_DATA", str(folder / "data"))
    truth = Replica(folder / "data").ground_truth("room0", "mesh-vertices")
    room = folder / "maps/room0"
    room.mkdir(parents=True)
    body = "".join(f"{x} {y} {z}\n" for x, y, z in truth.points.tolist())
    n = len(truth.points)
    (room / "point_cloud.pcd").write_text(
        f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA ascii\n{body}"
    )
    np.save(room / "index.npy", np.where(truth.instance == 1, 0, 1))
    np.save(room / "embeddings.npy", np.eye(8, dtype=np.float32)[[2, 5]])
    texts = np.full((2, 8), 0.01, np.float32)
    texts[[0, 1], [2, 5]] = 1
    np.savez(folder / "texts.npz", names=np.array(["a place to sit", "something to eat at"]), features=texts)


def request(folder: Path, queries: str) -> Request:
    (folder / "q.toml").write_text(queries)
    return Request(
        (folder / "maps",),
        dataset="replica",
        text_features=folder / "texts.npz",
        protocols=("query-ap",),
        queries=folder / "q.toml",
    )


def test_a_map_answers_queries_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_map(tmp_path, monkeypatch)
    found = evaluate(request(tmp_path, TOML)).to_json()["protocols"]["query-ap"]
    assert found["metrics"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
    swapped = TOML.replace("[1]", "[0]").replace("[6]", "[1]").replace("[0]", "[6]")
    found = evaluate(request(tmp_path, swapped)).to_json()["protocols"]["query-ap"]
    # each right mask ranks behind the wrong one of its query: recall 1 at precision a half
    assert found["metrics"]["ap"] == pytest.approx(0.25)
    assert any("what the truth itself would score is not known: how well" in line for line in found["warnings"])


def test_queries_need_a_dataset_its_objects_and_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_map(tmp_path, monkeypatch)
    with pytest.raises(DataError, match=r"room0: query 'something to eat at' names object 7; the ground truth has 2"):
        evaluate(request(tmp_path, TOML.replace("[6]", "[7]")))
    missing = Request((tmp_path / "maps",), dataset="replica", protocols=("query-ap",))
    with pytest.raises(ConfigError, match="needs --queries FILE"):
        evaluate(missing)
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt/room0.txt").write_text("20001\n" * 9)
    with pytest.raises(ConfigError, match="--queries needs the objects of a dataset"):
        evaluate(Request((tmp_path / "maps",), ground_truth=tmp_path / "gt", protocols=("replica-openmask3d",),
                         queries=tmp_path / "q.toml"))  # fmt: skip


def test_the_command_line_takes_a_file_of_queries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path, monkeypatch)
    (tmp_path / "q.csv").write_text(CSV)
    words = ["evaluate", str(tmp_path / "maps"), "--dataset", "replica", "--protocol", "query-ap"]
    files = ["--queries", str(tmp_path / "q.csv"), "--text-features", str(tmp_path / "texts.npz")]
    assert main([*words, *files]) == 0
    assert "100.0" in capsys.readouterr().out


def test_sentences_of_scanrefer_and_nr3d_are_held_against_boxes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = Replica.ground_truth

    def tilted(dataset: Replica, scene: str, variant: str) -> GroundTruth:
        truth = flat(dataset, scene, variant)
        return replace(truth, points=truth.points + truth.points[:, 1:2] * np.array([[0.1, 0, 1]], np.float32))

    monkeypatch.setattr(Replica, "ground_truth", tilted)  # what is flat has no volume, and no overlap in ScanRefer
    write_map(tmp_path, monkeypatch)
    rows = [
        ("a place to sit", 0),
        ("something to eat at", 5),
        ("something to eat at", 0),
    ]  # ids from 0; the last is not
    ref = [{"scene_id": "room0", "object_id": str(number), "description": text} for text, number in rows]
    (tmp_path / "ScanRefer_filtered_val.json").write_text(json.dumps(ref))
    lines = "".join(f"room0,{number},{text}\n" for text, number in rows)
    (tmp_path / "nr3d.csv").write_text(f"scan_id,target_id,utterance\n{lines}")
    for name in ("ScanRefer_filtered_val.json", "nr3d.csv"):
        words = ["evaluate", str(tmp_path / "maps"), "--dataset", "replica", "--queries", str(tmp_path / name)]
        files = ["--text-features", str(tmp_path / "texts.npz"), "--protocols", "grounding", "--json", "--quiet"]
        assert main([*words, *files]) == 0
        scored = json.loads(capsys.readouterr().out)["protocols"]["grounding"]
        assert {value for value in scored["metrics"].values() if value is not None} == {2 / 3}  # unique alone
    (tmp_path / "broken.json").write_text('[{"scene_id": "room0"}]')
    words = ["evaluate", str(tmp_path / "maps"), "--dataset", "replica", "--queries", str(tmp_path / "broken.json")]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "has no 'description'" in told
