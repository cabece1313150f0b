"""Scene graphs: FROSS' recalls to the last bit, relations by boxes, the annotation of ReplicaSSG, and errors."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES
from recording_files import write_files
from replica_scene import QUADS, TWO_OBJECTS, write_original, write_render
from scored_room import ENCODER, nothing, room, truth_as_prediction

from su3d_bench.baselines.oracle import Oracle
from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import GroundTruth, LabelSet, TrueGraph
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.metrics.protocols.kinds import GEOMETRIC
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ClassEntry
from su3d_bench.metrics.relations import geometric_edges
from su3d_bench.metrics.scoring import combine, pack_scores, plain_json, score_scene, unpack_scores
from su3d_bench.numerics.relations import RELATIONS
from su3d_bench.predictions.formats import recognise
from su3d_bench.predictions.objects import scene_graph
from su3d_bench.store.predictions import read_prediction, write_prediction

MADE = json.loads((CASES / "relations01_replicassg.json").read_text())
RULES = load_protocol("rooms-relations")
REPLICA = load_protocol("replica-relations")
GRID = 4096  # coordinates of the problems are multiples of 1/4096 m, exact in float32
OF_CASES = REPLICA.model_copy(
    update={
        "classes": tuple(ClassEntry(id=number, name=name) for number, name in enumerate(MADE["classes"], 1)),
        "predicates": tuple(MADE["predicates"]),
    }
)


def true_scan(scan: dict[str, Any]) -> GroundTruth:
    names = MADE["classes"]
    meant = {int(row["id"]) + 1: MADE["meant"].get(row["label"]) for row in scan["objects"]}
    class_of = {key: names.index(name) + 1 for key, name in meant.items() if name in names}
    instance = np.array(scan["ids"], np.int32) + 1
    semantic = np.array([class_of.get(key, 0) for key in instance.tolist()], np.int32)
    graph = TrueGraph(class_of, tuple((a + 1, name, b + 1) for a, b, _, name in scan["relations"]))
    points = (np.array(scan["points"]) / GRID).astype(np.float32)
    labels = LabelSet("replica", tuple(range(1, len(names) + 1)), tuple(names))
    return GroundTruth(points, semantic, instance * (semantic > 0), labels, "replicassg", "made", graph=graph)


def predicted_scan(scan: dict[str, Any]) -> Instances:
    k, n_edges = len(scan["pcd"]), len(scan["edge_counts"])
    counts = np.array(scan["edge_counts"], np.float64).reshape(n_edges, len(MADE["predicates"]))
    graph = {
        "pcd": [np.array(cloud, np.float64).reshape(-1, 3) / GRID for cloud in scan["pcd"]],
        "cls": np.array(scan["cls"]).reshape(k, len(MADE["classes"])),
        "edge_index": np.array(scan["edge_index"], np.int64).reshape(2, n_edges),
        "edge_cls": counts / counts.sum(axis=1, keepdims=True),
    }
    return scene_graph(graph, OF_CASES, "here")


@pytest.mark.parametrize("index", range(len(MADE["problems"])))
def test_fross_recalls_are_equal_in_every_bit(index: int) -> None:
    problem = MADE["problems"][index]
    scores = {
        name: score_scene(OF_CASES, true_scan(scan), predicted_scan(scan), None)
        for name, scan in problem["scans"].items()
    }
    found = plain_json(combine(OF_CASES, scores).metrics)
    assert [found[name] for name in OF_CASES.value_names] == problem["answer"]["values"]
    counts: list[Any] = [score.counts for score in scores.values()]
    names = ("n_objects", "n_objects_found", "n_relations", "n_predicates_found")
    sums = [sum(getattr(of_scan, name) for of_scan in counts).tolist() for name in names]
    assert sums == problem["answer"]["counts"]
    assert sum(of_scan.n_triplets_found.sum() for of_scan in counts) == problem["answer"]["triplets"]


def values(truth: GroundTruth, prediction: Prediction, rules: Any = RULES) -> dict[str, Any]:
    score = score_scene(rules, truth, prediction, ENCODER)
    kept = unpack_scores(pack_scores({rules.name: score}))[rules.name]
    found: dict[str, Any] = plain_json(combine(rules, {"a": kept}).metrics)
    return found


def stacked() -> GroundTruth:
    """The synthetic room with its lamp moved onto the table next to it."""
    truth = room()
    points = truth.points.copy()
    points[truth.instance == 5] = points[truth.instance == 5] * [0.5, 0.5, 1] + [1.1, 0.2, 0.8]
    return replace(truth, points=points.astype(np.float32))


def test_oracle_has_every_geometric_relation_and_empty_map_none() -> None:
    truth = stacked()
    perfect = values(truth, truth_as_prediction(truth, with_labels=True))
    assert [perfect[name] for name in RULES.value_names] == [1.0] * 5
    assert perfect["n_predicate R@1"] > 1 and perfect["n_object R@1"] == 7  # the wall is not an object
    assert values(truth, truth_as_prediction(truth, with_labels=False))["relationship R@1"] == 1.0  # by features
    assert [values(truth, nothing(truth))[name] for name in RULES.value_names] == [0.0] * 5


def test_wrong_class_costs_the_triplet_and_own_edges_the_predicate() -> None:
    truth = stacked()
    whole = truth_as_prediction(truth, with_labels=True)
    assert whole.labels is not None
    lamp = whole.labels.index("lamp")
    called = replace(whole, labels=tuple("vase" if row == lamp else name for row, name in enumerate(whole.labels)))
    found = values(truth, called)
    assert found["predicate R@1"] == 1.0 and found["relationship R@1"] < 1.0 and found["object R@1"] == 6 / 7
    edges = np.array([[lamp, whole.labels.index("table")]], np.int32)
    own = replace(whole, edges=edges, edge_scores=np.array([[0.5, 0.5]]), predicates=("on", "in"))
    assert values(truth, own)["predicate R@1"] == 0.0  # the last on ties: in
    own = replace(own, edge_scores=np.array([[0.6, 0.5]]))
    right = values(truth, own)
    assert right["predicate R@1"] == right["relationship R@1"] == 1 / right["n_predicate R@1"]


def test_the_first_relation_of_a_pair_counts_and_a_doubtful_one_is_not_true() -> None:
    boxes = np.array([[[0, 0, 0], [1, 1, 0.7]], [[0.4, 0.4, 0.7], [0.6, 0.6, 1.0]], [[3, 0, 0], [4, 1, 0.7]]])
    names = ("table", "lamp", "table")
    assert geometric_edges(boxes, names, ("under", "on")) == {(1, 0): 1, (0, 1): 0}
    assert geometric_edges(boxes, names, RELATIONS, sure=True) == {(1, 0): RELATIONS.index("on")}  # not also under
    boxes[1, :, 2] += 0.035  # just within reach of the top: with a slightly different threshold it is not
    assert geometric_edges(boxes, names, ("on",)) == {(1, 0): 0}
    assert geometric_edges(boxes, names, ("on",), sure=True) == {}
    assert GEOMETRIC == RELATIONS


def write_scene_graphs(root: Path, objects: list[tuple[int, str]], relations: list[tuple[int, int, str]]) -> Path:
    """ReplicaSSG's annotation of room_0, and of another scan, with the classes of its protocol."""
    rules = load_protocol("replica-relations")
    rows = [{"label": label, "id": str(number)} for number, label in objects]
    triples = [[subject, other, rules.predicates.index(name), name] for subject, other, name in relations]
    files: dict[str, Any] = {
        f"{key}.json": {"scans": [{"scan": "apartment_0", key: []}, {"scan": "room_0", key: content}]}
        for key, content in {"objects": rows, "relationships": triples}.items()
    }
    meant = {"chair": "chair", "sofa": "chair", "table": "table", "wall": "unknown"}
    classes = {"Replica2VisualGenome": meant, "VisualGenome_list": [entry.name for entry in rules.classes]}
    write_files(root / "ReplicaSSG", files | {"replica_to_visual_genome.json": classes})
    return root / "ReplicaSSG"


def written(folder: Path) -> Replica:
    write_render(folder)
    write_original(folder, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    write_scene_graphs(folder, [(0, "chair"), (5, "table"), (7, "sofa"), (8, "wall")], [(0, 5, "near"), (5, 7, "with")])
    return Replica(folder)


def test_replicassg_annotation_is_on_face_centres(tmp_path: Path) -> None:
    truth = written(tmp_path).ground_truth("room0", "replicassg")
    assert truth.points.tolist() == [[0.5, 0.5, 0], [0.5, 1.5, 0], [1.5, 0.5, 0], [1.5, 1.5, 0]]
    chair, table = (next(entry.id for entry in REPLICA.classes if entry.name == name) for name in ("chair", "table"))
    assert truth.instance.tolist() == [1, 1, 6, 6] and truth.semantic.tolist() == [chair, chair, table, table]
    assert truth.graph == TrueGraph({1: chair, 6: table, 8: chair}, ((1, "near", 6), (6, "with", 8)))
    oracle = Oracle(Oracle.Config())
    oracle.receive_ground_truth(truth)
    found = values(truth, oracle.finish(), REPLICA)
    # the sofa has no face: it cannot be found, nor its relations
    assert [found[name] for name in REPLICA.headline] == [2 / 3, 1 / 2, 1 / 2]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("objects.json", '"scan": "room_0"', '"scan": "room_1"', "has 0 entries for room_0; expected one"),
        ("objects.json", '"id": "5"', '"id": "five"', "objects: 1.id: Input should be a valid integer"),
        ("objects.json", '"chair"', '"wall"', "a relation names object 1, which is not in the graph"),
        ("relationships.json", '"near"', "3", "relationships: 0.3: Input should be a valid string"),
        ("relationships.json", '"scans"', '"scan"', "scans: Field required"),
        ("replica_to_visual_genome.json", "VisualGenome_list", "list", "VisualGenome_list: Field required"),
        ("replica_to_visual_genome.json", "{", "[", "not JSON"),
    ],
)
def test_each_invalid_annotation_is_one_line(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    dataset = written(tmp_path)
    path = tmp_path / "ReplicaSSG" / name
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=message) as caught:
        dataset.ground_truth("room0", "replicassg")
    assert str(caught.value).startswith("replica/room0: ") and "\n" not in str(caught.value)


def graph(names: tuple[str, ...] = ("chair", "table")) -> dict[str, Any]:
    """FROSS' output for a scene: both objects at their positions, one near the other."""
    classes = [entry.name for entry in REPLICA.classes]
    return {
        "pcd": [np.array([[0.5, 0.5, 0], [0.5, 1.5, 0]]), np.array([[1.5, 0.5, 0.0]])],
        "cls": np.eye(len(classes), dtype=np.int64)[[classes.index(name) for name in names]],
        "edge_index": np.array([[0], [1]]),
        "edge_cls": np.eye(50)[[REPLICA.predicates.index("near")]],
        "mean": np.zeros((2, 3)),
        "cov": np.zeros((2, 3, 3)),
    }


def write_graphs(path: Path, scenes: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(scenes))
    return path


def test_fross_files_are_evaluated_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    write_graphs(tmp_path / "out/replica/predictions_gaussian_test.pkl", {"room_0": graph()})
    words = ["evaluate", str(tmp_path / "out/replica"), "--dataset", "replica", "--protocols", "replica-relations"]
    assert main([*words, "--json", "--quiet", "--out", str(tmp_path / "run")]) == 0
    found = json.loads(capsys.readouterr().out)["protocols"]["replica-relations"]["metrics"]
    assert [found[name.lower()] for name in REPLICA.headline] == [2 / 3, 0.5, 0.5]
    stored = next((tmp_path / "run").rglob("prediction.npz"))
    kept = read_prediction(stored)
    assert isinstance(kept, Instances) and kept.edges is not None and kept.edges.tolist() == [[0, 1]]
    write_prediction(tmp_path / "again.npz", kept)  # the edges are stored too
    assert read_prediction(tmp_path / "again.npz").predicates == REPLICA.predicates  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pcd": 3}, "'pcd' is 3; expected one list of points per object"),
        ({"cls": np.eye(20)[[1, 2]]}, r"'cls' is .*; expected 2 rows of 150, as in ReplicaSSG"),
        ({"edge_index": np.array([[0], [2]])}, "'edge_index' names object 2; the scene graph has 2"),
        ({"edge_cls": np.full((1, 50), np.nan)}, "'edge_cls' has values that are NaN or infinite"),
        ({"pcd": [np.zeros((1, 3)), np.zeros(3)]}, "object 1: the points are an array of shape"),
    ],
)
def test_each_invalid_scene_graph_is_one_line(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = write_graphs(tmp_path / "predictions_x.pkl", {"room_0": graph() | change})
    reader = recognise(path, None)
    with pytest.raises(PredictionError, match=message) as caught:
        reader.read(path, "room_0")
    assert "predictions_x.pkl: room_0" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"edges": np.zeros((1, 2), np.int32)}, "needs edges, edge_scores and predicates, all three"),
        (
            {"edges": np.full((1, 2), 9, np.int32), "edge_scores": np.ones((1, 1)), "predicates": ("on",)},
            "an edge names instance 9 of 1",
        ),
        (
            {"edges": np.zeros((1, 2), np.int32), "edge_scores": np.ones((2, 1)), "predicates": ("on",)},
            "do not fit 1 predicates",
        ),
    ],
)
def test_map_with_an_invalid_graph_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(PredictionError, match=message):
        replace(Instances.of(np.zeros((1, 3), np.float32), [[0]]), **fields)
