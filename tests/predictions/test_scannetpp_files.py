"""Submissions of ScanNet++: recognised, read, written and read back; what is damaged is told in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_room import ID, LABELS, OneHotEncoder, instances

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.predictions import export
from su3d_bench.predictions.base import VertexLabels, VertexMasks, vertex_masks
from su3d_bench.predictions.formats import READERS, recognise
from su3d_bench.predictions.run_predictions import read_stored, write_content

ENCODER = OneHotEncoder()
ROOMS, TOP_K = load_protocol("rooms-instance"), load_protocol("rooms-top-k")
PLACE = {entry.name: place for place, entry in enumerate(ROOMS.classes)}


def room_truth() -> GroundTruth:
    points = np.random.default_rng(1).random((30, 3)).astype(np.float32)
    semantic = np.repeat([ID["chair"], ID["table"], ID["lamp"]], 10).astype(np.int32)
    instance = np.repeat([1, 2, 3], 10).astype(np.int32)
    return GroundTruth(points, semantic, instance, LABELS, "mesh-vertices", "made for a test")


def write_list(folder: Path, lines: str, **masks: Any) -> Path:
    (folder / "predicted_masks").mkdir(parents=True)
    (folder / "0a7cc12c0e.txt").write_text(lines)
    for name, value in masks.items():
        (folder / f"predicted_masks/{name}.json").write_text(value if isinstance(value, str) else json.dumps(value))
    return folder


# ---- reading


def test_a_list_of_run_lengths_is_scannetpps_and_counts_classes_from_0(tmp_path: Path) -> None:
    mask = {"length": 6, "counts": "2 3"}
    write_list(tmp_path, "predicted_masks/a.json 0 0.5\npredicted_masks/b.json 9 1.0\n", a=mask, b=mask)
    reader = recognise(tmp_path)
    assert reader.name == "scannetpp" and list(reader.scenes(tmp_path)) == ["0a7cc12c0e"]
    content = reader.read(tmp_path, "0a7cc12c0e").content
    assert isinstance(content, VertexMasks)
    assert (content.n_points, content.numbering) == (6, "line")
    assert [one.tolist() for one in content.sets()] == [[1, 2, 3], [1, 2, 3]]
    assert content.class_ids(load_protocol("scannetpp-instance")).tolist() == [1, 10]
    first, tenth = ROOMS.classes[0].id, ROOMS.classes[9].id
    assert content.class_ids(ROOMS).tolist() == [first, tenth]


@pytest.mark.parametrize(("text", "rows"), [("3,1,2\n0,0,0\n", [[3, 1, 2], [0, 0, 0]]), ("4, 1,99\r\n", [[4, 1, 99]])])
def test_ranked_classes_are_recognised_by_their_commas(text: str, rows: list[list[int]], tmp_path: Path) -> None:
    (tmp_path / "0a7cc12c0e.txt").write_bytes(text.encode())
    reader = recognise(tmp_path)
    content = reader.read(tmp_path, "0a7cc12c0e").content
    assert reader.name == "scannetpp-semantic" and isinstance(content, VertexLabels) and content.further is not None
    assert np.column_stack([content.class_ids, content.further]).tolist() == rows


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3\n1,2\n", ":2: has 2 classes; expected one in every line, or 3 in each"),
        ("1,2,3\n1,x,3\n", ":2: 'x' is not an integer"),
        ("1,2,3\n1,-1,3\n", ":2: 1,-1,3 is no place in a list of classes; they count from 0"),
        ("1,2,99999999999\n", ":1: 1,2,99999999999 is no place in a list"),
        ("", "is empty; expected one or three classes a line"),
    ],
)
def test_what_is_no_line_of_classes_is_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "0a7cc12c0e.txt").write_text(text)
    with pytest.raises(PredictionError) as raised:
        READERS["scannetpp-semantic"].read(tmp_path, "0a7cc12c0e")
    assert message in str(raised.value)


# ---- writing


@given(members=st.sets(st.integers(0, 40)))
@settings(max_examples=100, deadline=None)
def test_runs_come_back_as_the_points_that_they_were(members: set[int]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        whole = export._runs_json(np.array(sorted(members), np.int32), 41).decode()
        place = write_list(Path(folder) / "s", "predicted_masks/a.json 0 1.0\n", a=whole)
        content = READERS["scannetpp"].read(place, "0a7cc12c0e").content
        assert isinstance(content, VertexMasks)
        assert content.n_points == 41 and content.mask(0).tolist() == sorted(members)


def test_a_map_is_written_with_the_places_of_its_classes_and_read_back(tmp_path: Path) -> None:
    truth = room_truth()
    made = instances(
        truth.points,
        [np.array(one, np.int32) for one in ([0, 1, 5], [10, 11], [], [20])],
        ["chair", "table", "lamp", "no class"],
        scores=[0.1 + 0.2, 0.5, 1, 1],
    )
    labelled = export.masks_on_truth(made, ROOMS, truth, None)
    remarks = export.write_scannetpp(labelled, ROOMS, "room", tmp_path / "s")
    assert len(remarks) == 2
    first = (tmp_path / "s/room.txt").read_text().splitlines()[0]
    assert first == f"predicted_masks/room_000.json {PLACE['chair']} 0.30000000000000004"
    found = recognise(tmp_path / "s").read(tmp_path / "s", "room").content
    assert isinstance(found, VertexMasks)
    assert found.class_ids(ROOMS).tolist() == [ID["chair"], ID["table"]]
    assert [one.tolist() for one in found.sets()] == [[0, 1, 5], [10, 11]]
    assert not export.needs_truth(found, "line") and export.needs_truth(found)
    export.write_scannetpp(export.masks_as_they_are(found), None, "room", tmp_path / "t")
    for file in ("room.txt", "predicted_masks/room_001.json"):
        assert (tmp_path / "s" / file).read_bytes() == (tmp_path / "t" / file).read_bytes()


def test_confidences_that_the_benchmark_refuses_become_ranks_and_it_is_said(tmp_path: Path) -> None:
    masks = vertex_masks("x", [np.array([k], np.int32) for k in range(3)], 3, class_numbers=np.zeros(3, np.int32))
    labelled = export.LabelledMasks(masks, 3, np.full(3, 1), np.array([7.0, -2.0, 7.0]))
    remarks = export.write_scannetpp(labelled, None, "s", tmp_path)
    assert "as their ranks" in remarks[0]
    assert [line.split()[-1] for line in (tmp_path / "s.txt").read_text().splitlines()] == ["1.0", "0.5", "1.0"]


def test_the_three_likeliest_classes_of_every_vertex_are_written_and_read_back(tmp_path: Path) -> None:
    truth = room_truth()
    features = np.stack([ENCODER.feature(f"a {LABELS.name_of(int(one))} in a scene") for one in truth.semantic])
    features += 0.5 * ENCODER.feature("a sofa in a scene") + 0.25 * ENCODER.feature("a plate in a scene")
    dense = DenseFeatures(truth.points, features.astype(np.float16))
    assert export.write_scannetpp_labels(dense, TOP_K, truth, ENCODER, "room", tmp_path) == ()
    line = (tmp_path / "room.txt").read_text().splitlines()[10]
    assert line == ",".join(str(PLACE[name]) for name in ("table", "sofa", "plate"))
    content = recognise(tmp_path).read(tmp_path, "room").content
    assert isinstance(content, VertexLabels)
    export.write_scannetpp_labels(content, TOP_K, truth, None, "again", tmp_path)
    assert (tmp_path / "again.txt").read_bytes() == (tmp_path / "room.txt").read_bytes()


def test_one_class_a_vertex_is_written_as_one_and_none_at_all_is_refused(tmp_path: Path) -> None:
    truth = room_truth()
    labels = VertexLabels(truth.semantic)
    export.write_scannetpp_labels(labels, TOP_K, truth, None, "room", tmp_path)
    assert (tmp_path / "room.txt").read_text().splitlines()[0] == str(PLACE["chair"])
    unknown = VertexLabels(np.where(truth.semantic == ID["lamp"], 5000, truth.semantic).astype(np.int32))
    with pytest.raises(PredictionError, match="10 of 30 vertices have none of the 69 classes"):
        export.write_scannetpp_labels(unknown, TOP_K, truth, None, "room", tmp_path)


def test_ranked_labels_are_kept_in_a_run_as_they_are(tmp_path: Path) -> None:
    made = VertexLabels(np.array([1, 2], np.int32), np.array([[0, 3], [4, 5]], np.int32), "line")
    write_content(tmp_path / "prediction.npz", made)
    found = read_stored(tmp_path / "prediction.npz")
    assert isinstance(found, VertexLabels) and found.further is not None
    assert (found.class_ids.tolist(), found.further.tolist(), found.numbering) == ([1, 2], [[0, 3], [4, 5]], "line")
    as_map = made.on(np.zeros((2, 3), np.float32), TOP_K)
    write_content(tmp_path / "map.npz", as_map)
    assert getattr(read_stored(tmp_path / "map.npz"), "further_labels", None) == as_map.further_labels
