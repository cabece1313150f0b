"""Predictions against the ground truth of datasets and of OpenLex3D's release."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluated_text import printed, write_texts
from painted_runs import PAINTED, painted_run
from test_openlex3d_original import SAMPLED, metres, of_dataset, write_labels, write_objects

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.datasets.openlex3d.release import VISIBLE_NAME
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.formats.ply import PlyElement, write_ply

# ---- datasets


def test_oracle_scores_one_and_scenes_missing_from_a_run_count_as_missed(tmp_path: Path) -> None:
    def found(predictions: Path) -> Any:
        request = Request((predictions,), dataset=PAINTED, protocols=("rooms-instance", "rooms-semantic"))
        return evaluate(request).to_json()["protocols"]

    run = painted_run(tmp_path / "run", methods=("oracle",))
    whole = found(run)
    assert whole["rooms-instance"]["metrics"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
    assert whole["rooms-semantic"]["metrics"] == {"macc": 1.0, "miou": 1.0, "fmiou": 1.0}
    assert whole["rooms-instance"]["coverage"] == {"0.025": 1.0, "0.05": 1.0, "0.1": 1.0}
    assert list(whole["rooms-instance"]["per_scene"]) == ["a", "b"]  # the scenes of the run, not all of the dataset
    (run / "scenes/painted.b/oracle/prediction.npz").unlink()
    lost = found(run)
    assert lost["rooms-instance"]["metrics"]["ap"] == 0.5  # half of the recall, precision 1
    assert lost["rooms-instance"]["missed_scenes"] == ["b"]
    assert lost["rooms-semantic"]["metrics"]["macc"] < 1
    assert printed(lost["rooms-instance"], "1 of 2 scenes have no prediction and count as missed: b")
    for name in ("prediction.npz", "."):  # each has only its scene, a folder of scenes has all
        assert found(run / "scenes/painted.a/oracle" / name)["rooms-instance"]["metrics"]["ap"] == 1.0


# ---- OpenLex3D


def write_release(folder: Path) -> None:
    """OpenLex3D's files of a room with a chair on the left and a table on the right."""
    from replica_scene import QUADS, TWO_OBJECTS, write_original

    write_original(folder / "data", QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    room = folder / "lex/replica/room0"
    room.mkdir(parents=True)
    (room.parent / "prompt_list.txt").write_text("chair\nseat\ntable\nlamp\n")
    samples = [
        {
            "object_id": one,
            "labels": {"image_attributes": {"synonyms": words, "depictions": [], "vis_sim": [], "clutter": []}},
        }
        for one, words in ((0, ["chair", "seat"]), (5, ["table"]))
    ]
    (room / "gt_categories.json").write_text(json.dumps({"dataset": {"samples": samples}}))
    queries = {"level0": {"chair": [0], "table": [5]}}
    (room / "gt_categories_query_to_object_mapping_l0.json").write_text(json.dumps(queries))


def test_openlex3d_queries_are_scored_against_its_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from replica_scene import write_render

    write_release(tmp_path)
    write_render(tmp_path / "data")
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    map_folder = tmp_path / "maps/room0"
    map_folder.mkdir(parents=True)
    left, right = (np.array([(x, y, 0) for x in xs for y in range(3)], np.float64) for xs in ((0.0, 0.97), (1.03, 2.0)))
    points = np.concatenate([left, right])
    header = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    body = "".join(f"{x} {y} {z}\n" for x, y, z in points)
    tail = f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA ascii\n{body}"
    (map_folder / "point_cloud.pcd").write_text(header + tail)
    np.save(map_folder / "index.npy", np.repeat([0, 1], [len(left), len(right)]))
    np.save(map_folder / "embeddings.npy", np.eye(16, dtype=np.float32)[[3, 9]])
    write_texts(tmp_path / "texts.npz", ["chair", "seat", "table", "lamp"], {"chair": 3, "seat": 3, "table": 9})
    request = Request((tmp_path / "maps",), ground_truth=tmp_path / "lex", text_features=tmp_path / "texts.npz")
    found = evaluate(request).to_json()
    one = found["protocols"]["openlex3d-queries"]
    assert one["per_scene"]["room0"]["ap25"] > 0
    assert one["ceiling"] is None
    assert printed(one, "the ground-truth ceiling is unknown: masks grow by the threshold")
    assert found["not_scored"]["replica-openmask3d"] == "is not meant for the labels of OpenLex3D"
    assert "visible" in found["not_scored"]["openlex3d-topn"]  # the cloud of visible points is not in this folder
    (tmp_path / "lex/replica/room0" / VISIBLE_NAME).write_text(header + tail)
    found = evaluate(request).to_json()["protocols"]
    assert found["openlex3d-topn"]["metrics"]["synonyms"] == 1.0
    assert found["openlex3d-topn"]["coverage"]["0.025"] == 1.0
    assert found["openlex3d-ranking"]["metrics"]["overall"] > 0.5
    with pytest.raises(
        PredictionError, match=r"room0: none of 3 protocols can score it: .*needs the encoder 'ViT-H-14"
    ):
        evaluate(Request((tmp_path / "maps",), ground_truth=tmp_path / "lex"))


HM3D, SCANNETPP = "00824", "0a76e06478"


@pytest.fixture
def release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One scene of HM3D and one of ScanNet++ with their own data, a prediction of each and all text features."""
    encoder = "ViT-H-14/laion2b_s32b_b79k"
    for dataset, scene in (("hm3d", HM3D), ("scannetpp", SCANNETPP)):
        problem = of_dataset(dataset)
        problem = problem | {"scenes": {scene: problem["scenes"][scene]}}
        write_labels(tmp_path / "lex", problem)
        write_prediction(tmp_path / "maps" / dataset / scene, problem["scenes"][scene])
        names, features = list(problem["texts"]), np.array([*problem["texts"].values()], np.float32)
        np.savez(tmp_path / f"{dataset}.npz", names=names, features=features, encoder=encoder)
    write_objects(tmp_path / "data/hm3d" / HM3D, of_dataset("hm3d")["scenes"][HM3D])
    (tmp_path / "data/scannetpp/prepared_semantics").mkdir(parents=True)
    (tmp_path / "data/scannetpp/prepared_semantics" / SAMPLED.name).write_bytes(SAMPLED.read_bytes())
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    return tmp_path


def write_prediction(folder: Path, scene: dict[str, Any]) -> None:
    folder.mkdir(parents=True)
    points = metres(scene["cloud"])
    columns = {axis: points[:, column] for column, axis in enumerate("xyz")}
    write_ply(folder / "point_cloud.ply", [PlyElement("vertex", len(points), columns)])
    np.save(folder / "index.npy", np.array(scene["index"]))
    np.save(folder / "embeddings.npy", np.array(scene["features"], np.float32))


def found(release: Path, maps: str, **asked: Any) -> dict[str, Any]:
    texts = release / ("hm3d.npz" if maps == "." else f"{maps}.npz")
    request = Request((release / "maps" / maps,), ground_truth=release / "lex", text_features=texts, **asked)
    return evaluate(request).to_json()


@pytest.mark.parametrize(("dataset", "scene"), [("hm3d", HM3D), ("scannetpp", SCANNETPP)])
def test_dataset_is_inferred_from_scene_names(release: Path, dataset: str, scene: str) -> None:
    protocols = found(release, dataset)["protocols"]
    assert set(protocols) == {"openlex3d-topn", "openlex3d-ranking", "openlex3d-queries"}
    assert list(protocols["openlex3d-topn"]["per_scene"]) == [scene]
    for name in ("openlex3d-topn", "openlex3d-ranking"):
        answer = of_dataset(dataset)["answers"][name][0]
        assert {key: protocols[name]["metrics"][key] for key in answer} == pytest.approx(answer, abs=1e-12)


def test_predictions_of_several_datasets_are_scored_one_dataset_at_a_time(release: Path) -> None:
    with pytest.raises(ConfigError, match=r"lex: has labels for scannetpp, hm3d; choose one with --dataset NAME$"):
        found(release, ".")
    for asked in ({"dataset": "hm3d"}, {"scenes": (HM3D,)}, {"scenes": ("hm3d/*",)}):
        result = found(release, ".", **asked)
        assert list(result["protocols"]["openlex3d-queries"]["per_scene"]) == [HM3D]
    assert any("of another dataset: scannetpp/0a76e06478" in line for line in result["remarks"])
    with pytest.raises(ConfigError, match=r"lex: has no labels for 'replica', only for scannetpp, hm3d"):
        found(release, ".", dataset="replica")


def test_scene_without_its_own_data_states_what_to_download(release: Path) -> None:
    (release / "data/scannetpp/prepared_semantics" / SAMPLED.name).unlink()
    with pytest.raises(PredictionError, match=r"prepare_training_data of github\.com/scannetpp/scannetpp"):
        found(release, "scannetpp")
