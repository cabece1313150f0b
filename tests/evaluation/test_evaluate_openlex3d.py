"""``evaluate`` against a release of OpenLex3D that has the labels of several datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_openlex3d_original import SAMPLED, metres, of_dataset, write_labels, write_objects

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.formats.ply import PlyElement, write_ply

HM3D, SCANNETPP = "00824", "0a76e06478"


@pytest.fixture
def release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One scene of HM3D and one of ScanNet++ with their own data, a prediction of each and features of all texts."""
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
def test_the_dataset_is_told_from_the_names_of_the_scenes(release: Path, dataset: str, scene: str) -> None:
    protocols = found(release, dataset)["protocols"]
    assert set(protocols) == {"openlex3d-topn", "openlex3d-ranking", "openlex3d-queries"}
    assert list(protocols["openlex3d-topn"]["per_scene"]) == [scene]
    for name in ("openlex3d-topn", "openlex3d-ranking"):
        answer = of_dataset(dataset)["answers"][name][0]
        assert {key: protocols[name]["metrics"][key] for key in answer} == pytest.approx(answer, abs=1e-12)


def test_predictions_of_several_datasets_are_scored_one_dataset_at_a_time(release: Path) -> None:
    with pytest.raises(ConfigError, match=r"lex: has labels of scannetpp, hm3d; say of which with --dataset NAME$"):
        found(release, ".")
    for asked in ({"dataset": "hm3d"}, {"scenes": (HM3D,)}, {"scenes": ("hm3d/*",)}):
        result = found(release, ".", **asked)
        assert list(result["protocols"]["openlex3d-queries"]["per_scene"]) == [HM3D]
    assert any("of another dataset: scannetpp/0a76e06478" in line for line in result["remarks"])
    with pytest.raises(ConfigError, match=r"lex: has no labels of 'replica', only of scannetpp, hm3d"):
        found(release, ".", dataset="replica")


def test_a_scene_without_its_own_data_says_what_to_get(release: Path) -> None:
    (release / "data/scannetpp/prepared_semantics" / SAMPLED.name).unlink()
    with pytest.raises(PredictionError, match=r"prepare_training_data of github\.com/scannetpp/scannetpp"):
        found(release, "scannetpp")
