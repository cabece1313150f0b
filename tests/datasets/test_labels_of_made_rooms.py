"""What others released of a dataset, made of rooms in its layout: OpenLex3D's, OpenScan's and ReplicaSSG's files."""

from __future__ import annotations

import doctest
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scanned_stage import Stage, write_scene
from scored_room import instances

from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.errors import GroundTruthMissing, StoreError
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.datasets import openscan
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.openlex3d import release, writing
from su3d_bench.datasets.openlex3d.labels import OpenLexFiles
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.replica.graph_writing import meant_classes
from su3d_bench.datasets.rooms import attributes
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.datasets.scannet.dataset import ScanNet
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

ROOM, SCAN = "bathroom0", "scene9400_00"
LABELLED = {"replica": ROOM, "scannetpp": "0000000400", "hm3dsem": "00000-bathroom000"}
OF_RELEASE = {"replica": "replica", "scannetpp": "scannetpp", "hm3dsem": "hm3d"}
VISIBLE, CORNERS = release.VISIBLE, release.FACE_CORNERS


@dataclass
class AxisEncoder:
    """Each of some texts has an axis of its own."""

    texts: tuple[str, ...]
    name: str = "axes"
    digest: str = "axes"
    dim: int = 0

    def __post_init__(self) -> None:
        self.dim = len(self.texts)

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring looks at no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.stack([self.feature((text,)) for text in texts])

    def feature(self, texts: Sequence[str]) -> Float32Array:
        axes = np.zeros(self.dim, np.float32)
        axes[[self.texts.index(text) for text in texts]] = 1 / max(1, len(texts)) ** 0.5
        return axes


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    options = Rooms.Options(width=80, height=60, n_frames=12, mesh_spacing_m=0.06)
    return Rooms(tmp_path_factory.mktemp("cache"), options)


@pytest.fixture(scope="module")
def made(rooms: Rooms, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with the room in four layouts."""
    root = tmp_path_factory.mktemp("made")
    for name in (*LABELLED, "scannet"):
        write_scene(LAYOUTS[name], rooms, ROOM, root)
    return root


def dataset(made: Path, name: str) -> Any:
    dataset_class = registry.load("dataset", name)
    return dataset_class(made, dataset_class.Options())


# ---- OpenLex3D


@pytest.mark.parametrize("name", LABELLED)
def test_the_truth_as_prediction_has_the_right_labels_of_openlex3d(made: Path, name: str) -> None:
    truth = dataset(made, name).ground_truth(LABELLED[name], VISIBLE)
    asked = dataset(made, name).ground_truth(LABELLED[name], CORNERS)
    encoder = AxisEncoder(tuple(dict.fromkeys((*truth.prompts, *(query.text for query in asked.queries)))))
    ids = [one for one in truth.objects if (asked.object_of_point == one).any()]
    masks = [np.flatnonzero(asked.object_of_point == one) for one in ids]
    features = np.stack([encoder.feature(truth.objects[one].synonyms) for one in ids])
    found = instances(asked.points, masks, None, features)
    rules = [load_protocol(f"openlex3d-{kind}") for kind in ("topn", "ranking", "queries")]
    values = {
        one.name: combine(one, {"a": score_scene(one, truth, found, encoder)}, with_intervals=False).metrics
        for one, truth in zip(rules, (truth, truth, asked), strict=True)
    }
    assert values["openlex3d-topn"]["synonyms"] > 0.93 and values["openlex3d-topn"]["missing"] == 0
    assert values["openlex3d-ranking"]["synonyms"] > 0.93
    assert values["openlex3d-queries"]["AP50"] > 0.6  # masks grow over their neighbours, as the protocol says
    assert len(asked.queries) > 10 and all(query.object_ids for query in asked.queries)
    assert not {"wall", "floor", "ceiling"} & {query.text for query in asked.queries}


@pytest.mark.parametrize("name", LABELLED)
def test_each_scene_has_both_files_of_categories_in_the_form_of_the_release(made: Path, name: str) -> None:
    files = OpenLexFiles(made / release.RELEASE_FOLDER, OF_RELEASE[name], LABELLED[name])
    objects, prompts = files.objects(), set(files.prompts())
    by_level = {level: files.queries(level) for level in ("l0", "l1", "all")}
    assert by_level["l0"] == by_level["all"] and not by_level["l1"]
    assert files.has_visible_points == (name == "replica")
    for one in objects.values():
        assert {*one.synonyms, *one.vis_sim} <= prompts and set(one.clutter) <= set(objects)
    assert any(one.clutter for one in objects.values()) and any(one.vis_sim for one in objects.values())
    said = {query.text: set(query.object_ids) for query in by_level["l0"]}
    assert all(number in said[word] for number, one in objects.items() for word in one.synonyms if word in said)


def test_labels_of_a_release_are_part_of_the_scene_and_without_them_a_line_says_where_they_belong(
    made: Path, tmp_path: Path
) -> None:
    scene = Replica(made)
    key = scene.digest(ROOM)
    labels = made / "gt_openlex3d/replica" / ROOM / "gt_categories.json"
    content = labels.read_bytes()
    labels.write_bytes(content.replace(b"toilet", b"throne"))
    assert Replica(made).digest(ROOM) != key
    labels.write_bytes(content)
    away = made.joinpath("gt_openlex3d").rename(tmp_path / "away")
    try:
        with pytest.raises(GroundTruthMissing, match=r"expected gt_openlex3d/replica/bathroom0/gt_categories\.json of"):
            scene.ground_truth(ROOM, VISIBLE)
    finally:
        away.rename(made / "gt_openlex3d")


# ---- OpenScan


@pytest.mark.parametrize("variant", openscan.KEYS)
def test_attributes_of_a_made_scan_are_those_of_the_room(made: Path, rooms: Rooms, variant: str) -> None:
    ours, theirs = rooms.ground_truth(ROOM, variant), ScanNet(made).ground_truth(SCAN, variant)
    np.testing.assert_array_equal(theirs.points, ours.points)
    np.testing.assert_array_equal(theirs.semantic, ours.semantic)
    np.testing.assert_array_equal(theirs.instance, ours.instance)
    assert len(set(ours.semantic.tolist())) > 1


# ---- ReplicaSSG


def test_the_scene_graph_of_a_made_scene_has_the_objects_and_relations_of_the_room(made: Path, rooms: Rooms) -> None:
    truth = Replica(made).ground_truth(ROOM, "replicassg")
    assert truth.graph is not None
    seen = set(np.unique(rooms.scan(ROOM).object_id).tolist())
    meant = {known.id: meant_classes().get(known.class_name) for known in rooms.objects(ROOM) if known.id in seen}
    names = {key - 1: truth.labels.name_of(class_id) for key, class_id in truth.graph.class_of_object.items()}
    assert names == {key: name for key, name in meant.items() if name is not None}
    expected = {
        (link.subject, "near" if link.relation == "next to" else link.relation, link.object)
        for link in rooms.truth(ROOM).relations
        if {link.subject, link.object} <= set(names)
    }
    found = {(subject - 1, name, other - 1) for subject, name, other in truth.graph.relations}
    assert found == expected and len(found) > 5


# ---- runs


def test_made_scenes_run_from_their_files_to_scores(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(made))
    protocols = ["--protocols", "openlex3d-topn", "replica-relations"]
    words = ["--methods", "oracle", "--out", str(tmp_path / "run"), "--quiet"]
    assert main(["run", "--scenes", f"replica/{ROOM}", *protocols, *words]) == 0
    rows = {row["protocol"]: row for row in json.loads((tmp_path / "run/metrics.json").read_text())["results"]}
    assert rows["openlex3d-topn"]["result"]["metrics"]["synonyms"] > 0.93
    graph = rows["replica-relations"]["result"]["metrics"]
    assert {graph[f"{what} R@1"] for what in ("object", "relationship")} == {1.0}


# ---- files of all scenes


def test_rows_of_a_second_scene_join_those_of_the_first_and_lost_ones_come_back(tmp_path: Path) -> None:
    layout, files = LAYOUTS["scannet"], tmp_path / openscan.RAW_NAME
    for room in ("living7", "office7", "living7"):
        write_scene(layout, Stage(), room, tmp_path)
    both = files.read_bytes()
    assert set(openscan.read_attributes(files)) == {"scene9007_00", "scene9307_00"}
    files.unlink()
    for room in ("office7", "living7"):
        write_scene(layout, Stage(), room, tmp_path)
    assert files.read_bytes() == both


@pytest.mark.parametrize(
    ("layout", "name", "content"),
    [
        ("scannet", openscan.RAW_NAME, [{"scene_id": "scene0011_00", "object_id": "0"}]),
        ("replica", "ReplicaSSG/objects.json", {"scans": [{"scan": "room_0", "objects": []}]}),
    ],
)
def test_files_of_others_in_their_place_are_refused_and_left_alone(
    layout: str, name: str, content: Any, tmp_path: Path
) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(StoreError, match="and was made elsewhere; choose another folder with --out"):
        write_scene(LAYOUTS[layout], Stage(), "living7", tmp_path)
    assert json.loads((tmp_path / name).read_text()) == content
    for damaged in ("", "[1]", "{", '{"scans": 3}', "[[]]"):
        (tmp_path / name).write_text(damaged)
        with pytest.raises(StoreError, match="is no list of scenes"):
            write_scene(LAYOUTS[layout], Stage(), "living7", tmp_path)


def test_the_examples_hold() -> None:
    for module in (writing, attributes):
        assert not doctest.testmod(module).failed
