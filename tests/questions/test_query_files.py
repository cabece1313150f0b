"""Files of text queries: both formats, each error once, damaged copies, and a map scored under query-ap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from damage import damages, outcomes, truncations
from prediction_files import Tensor, write_torch
from replica_scene import QUADS, TWO_OBJECTS, write_original, write_render

from su3d_bench.cli.main import main
from su3d_bench.core.types import GroundTruth
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.metrics.open_vocabulary.score import TextQuery
from su3d_bench.questions.query_files import read_query_file

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


def write_map(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two objects of a synthetic scene as a map with one instance each, with the features of their query texts."""
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


@pytest.mark.parametrize(("name", "content"), [("q.toml", TOML), ("q.csv", CSV)])
def test_toml_and_csv_give_the_same_queries(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    assert read_query_file(tmp_path / name) == QUERIES


@pytest.mark.parametrize(("name", "content"), [("q.toml", TOML), ("q.csv", CSV)])
def test_damaged_files_are_read_or_give_one_line_error(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name

    def read(damaged: bytes) -> object:
        path.write_bytes(damaged)
        return read_query_file(path)

    for copies in (truncations(content.encode()), damages(content.encode())):
        _, n_refused = outcomes(read, copies, must_name=name)
        assert n_refused > 20


def objects_of(folder: Path) -> np.ndarray:
    """The masks (points, 2) of the two objects."""
    instance = Replica(folder / "data").ground_truth("room0", "mesh-vertices").instance
    return np.stack([instance == 1, instance == 6], axis=1)


def write_masks(folder: Path, masks: np.ndarray) -> Path:
    """The masks (points, masks) of a scene as OpenMask3D writes them, with the features of ``write_map``."""
    folder.mkdir()
    write_torch(folder / "room0_masks.pt", Tensor(masks))
    np.save(folder / "room0_openmask3d_features.npy", np.eye(8, dtype=np.float32)[[2, 5]])
    return folder


def test_masks_over_vertices_are_kept_as_the_map_that_was_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path, monkeypatch)
    (tmp_path / "q.csv").write_text(CSV)
    masks = write_masks(tmp_path / "masks", objects_of(tmp_path))
    words = ["--dataset", "replica", "--queries", str(tmp_path / "q.csv"), "--protocols", "query-ap", "--json"]
    words += ["--text-features", str(tmp_path / "texts.npz")]
    for predictions, out in ((masks, ["--out", str(tmp_path / "run")]), (tmp_path / "run", [])):
        assert main(["evaluate", str(predictions), *words, *out]) == 0
        assert json.loads(capsys.readouterr().out)["protocols"]["query-ap"]["metrics"]["ap"] == 1


def test_every_reason_is_printed_and_faults_of_the_data_come_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path, monkeypatch)
    (tmp_path / "q.csv").write_text(CSV)
    masks = write_masks(tmp_path / "short", np.ones((3, 2), bool))
    assert main(["evaluate", str(masks), "--dataset", "replica", "--queries", str(tmp_path / "q.csv")]) == 2
    first, *others = capsys.readouterr().err.splitlines()
    n = len(Replica(tmp_path / "data").ground_truth("room0", "mesh-vertices").points)
    assert f"can score it: the masks are of 3 points, the ground truth has {n}; " in f"{first} {others}"
    kinds = [any(word in line for word in ("the masks are of", "no ground truth")) for line in (first, *others)]
    assert kinds == sorted(kinds, reverse=True) and not kinds[-1] and len({*others, first}) == len(kinds)
    assert all(line.startswith("  ") for line in others)


def test_scanrefer_and_nr3d_sentences_are_scored_by_boxes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = Replica.ground_truth

    def tilted(dataset: Replica, scene: str, variant: str) -> GroundTruth:
        truth = flat(dataset, scene, variant)
        return replace(truth, points=truth.points + truth.points[:, 1:2] * np.array([[0.1, 0, 1]], np.float32))

    monkeypatch.setattr(Replica, "ground_truth", tilted)  # flat objects have no volume, and no overlap in ScanRefer
    write_map(tmp_path, monkeypatch)
    masks = write_masks(tmp_path / "masks", objects_of(tmp_path))
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
        for predictions in (tmp_path / "maps", masks):
            words = ["evaluate", str(predictions), "--dataset", "replica", "--queries", str(tmp_path / name)]
            files = ["--text-features", str(tmp_path / "texts.npz"), "--protocols", "grounding", "--json", "--quiet"]
            assert main([*words, *files]) == 0
            scored = json.loads(capsys.readouterr().out)["protocols"]["grounding"]
            assert {value for value in scored["metrics"].values() if value is not None} == {2 / 3}  # unique alone
    (tmp_path / "broken.json").write_text('[{"scene_id": "room0"}]')
    words = ["evaluate", str(tmp_path / "maps"), "--dataset", "replica", "--queries", str(tmp_path / "broken.json")]
    assert main(words) == 2
    result = capsys.readouterr().err
    assert result.count("\n") == 1 and "broken.json: entry 1" in result
