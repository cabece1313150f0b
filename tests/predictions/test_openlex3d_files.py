"""OpenLex3D's text files: read as in the original, and one clear line for any damaged file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from open_scene import ENCODER, OBJECTS, PROMPTS, instances_with
from places import CASES
from synthetic_maps import written as written_maps
from test_openlex3d_original import write_visible

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.openlex3d import release
from su3d_bench.datasets.replica.truth import AnnotatedMesh
from su3d_bench.formats.ply import ListColumn
from su3d_bench.metrics.open_vocabulary.score import TextQuery
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

WHERE = "replica/room0: file"
CATEGORIES = {
    "dataset": {
        "name": "room0",
        "samples": [
            {
                "object_id": one,
                "name": f"object {one}",
                "labels": {
                    "image_attributes": {
                        "synonyms": list(labels.synonyms),
                        "depictions": list(labels.depictions),
                        "vis_sim": list(labels.vis_sim),
                        "clutter": [str(other) for other in labels.clutter],
                    }
                },
            }
            for one, labels in OBJECTS.items()
        ],
    }
}
QUERIES = {"level0": {"chair": [7], "pot": [31, "12"]}, "level1": {"chair": [7]}}


def written(tmp_path: Path) -> release.OpenLexFiles:
    scene = tmp_path / "replica/room0"
    scene.mkdir(parents=True)
    (tmp_path / "replica/prompt_list.txt").write_text("\n".join(f" {prompt} " for prompt in PROMPTS) + "\n")
    (scene / "gt_categories.json").write_text(json.dumps(CATEGORIES))
    (scene / "gt_categories_query_to_object_mapping_all.json").write_text(json.dumps(QUERIES))
    return release.OpenLexFiles(tmp_path, "replica", "room0")


# ---- reading


def test_the_three_files_of_a_scene_are_read(tmp_path: Path) -> None:
    files = written(tmp_path)
    assert files.prompts() == PROMPTS
    assert files.objects() == OBJECTS
    assert files.queries("all") == (TextQuery("chair", (7,)), TextQuery("pot", (31, 12)), TextQuery("chair", (7,)))


# ---- from files to a score


def corners() -> release.LabelledPoints:
    """Each object as points of a box."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((50, 3)) * 0.3 + [i, 0, 0] for i in range(len(OBJECTS))]).astype(np.float32)
    return release.LabelledPoints(points, np.repeat(list(OBJECTS), 50), "made for a test")


def test_the_files_with_the_points_of_a_mesh_can_be_scored(tmp_path: Path) -> None:
    files, mesh = written(tmp_path), corners()
    write_visible(tmp_path / "replica/room0", mesh.points[::2] + np.float32(0.001))
    masks = [np.flatnonzero(mesh.object_of_point == one) for one in OBJECTS]
    words = [labels.synonyms[0] for labels in OBJECTS.values()]
    prediction = instances_with(mesh.points, masks, ENCODER.encode_texts(words))
    rules = load_protocol("openlex3d-topn")
    score = score_scene(rules, release.categories_truth(files, mesh), prediction, ENCODER)
    assert combine(rules, {"a": score}).metrics["synonyms"] == 1.0
    rules = load_protocol("openlex3d-queries")
    truth = release.queries_truth(files, mesh, "all")
    assert len(truth.queries) == 3
    assert combine(rules, {"a": score_scene(rules, truth, prediction, ENCODER)}).metrics["AP25"] > 0.5


def test_a_visible_point_far_from_every_corner_has_no_object(tmp_path: Path) -> None:
    mesh = corners()
    files = written(tmp_path)
    write_visible(tmp_path / "replica/room0", np.array([mesh.points[0] + [0.02, 0, 0], mesh.points[0] + [0, 9, 0]]))
    truth = release.categories_truth(files, mesh)
    assert truth.object_of_point.tolist() == [7, -1]


def test_objects_that_the_list_of_a_replica_scene_lacks_are_object_0_for_labels_but_not_for_queries(
    tmp_path: Path,
) -> None:
    vertices = np.arange(12, dtype=np.float32).reshape(4, 3)
    faces = ListColumn(np.array([0, 3, 6]), np.array([0, 1, 2, 1, 2, 3]))
    without_class = np.zeros(2, np.int32)
    mesh = AnnotatedMesh(vertices, faces, np.array([7, 12]), without_class, without_class, {}, np.array([True, False]))
    found = release.face_corners_of(mesh)
    assert found.object_of_point.tolist() == [7, 7, 7, 12, 12, 12]
    assert found.points[3].tolist() == vertices[1].tolist()
    files = written(tmp_path)
    write_visible(tmp_path / "replica/room0", vertices[[0, 3]])
    assert release.categories_truth(files, found).object_of_point.tolist() == [7, 0]
    assert release.queries_truth(files, found, "all").object_of_point.tolist() == [7, 7, 7, 12, 12, 12]


def test_a_mesh_that_changes_within_the_process_is_read_again(tmp_path: Path) -> None:
    scene = json.loads((CASES / "originals_maps.json").read_text())["openlex3d-topn"][0]["scenes"][0]
    for number in (7, 8):
        shutil.rmtree(tmp_path / "root", ignore_errors=True)
        changed = scene | {"owner": [number] * len(scene["faces"]), "listed": {str(number): 1}}
        written_maps(tmp_path / "root", [changed])
        truth = release.truth_below(tmp_path / "root", "replica", "room0", release.VISIBLE)
        assert set(truth.object_of_point.tolist()) - {-1} == {number}


# ---- errors

Reader = Callable[[Path, str], object]


def refusal(tmp_path: Path, read: Reader, content: str) -> str:
    path = tmp_path / "file"
    path.write_text(content)
    with pytest.raises(DataError) as caught:
        read(path, WHERE)
    return str(caught.value)


def edited(**changes: Any) -> str:
    sample = json.loads(json.dumps(CATEGORIES["dataset"]["samples"][0]))
    sample["labels"]["image_attributes"] |= {key: value for key, value in changes.items() if key != "object_id"}
    sample |= {key: value for key, value in changes.items() if key == "object_id"}
    return json.dumps({"dataset": {"samples": [sample]}})


FAULTS = (
    (release.read_prompts, " \n \n", "has no prompts; expected one per line"),
    (release.read_categories, "[]", "expected an object; found []"),
    (release.read_categories, '{"dataset": {}}', "dataset.samples: Field required"),
    (
        release.read_categories,
        edited(object_id=True),
        "samples.0.object_id: Input should be a valid integer; found True",
    ),
    (release.read_categories, edited(synonyms=["\ud800"]), "synonyms.0: "),
    (release.read_categories, "[" * 100_000, "not JSON"),
    (
        release.read_queries,
        '{"level0": {"a\\u001b[31m": 7}}',
        "level0.a\\x1b[31m: Input should be a valid list; found 7",
    ),
    (release.read_queries, '{"level0": {"a": [7, 7]}}', "query 'a': an object is listed twice"),
    (release.read_queries, '{"level0": {"a": [NaN]}}', "level0.a.0: Input should be a finite number; found nan"),
)


@pytest.mark.parametrize(("read", "content", "message"), FAULTS, ids=[fault[2] for fault in FAULTS])
def test_unusable_openlex3d_file_gives_one_line(tmp_path: Path, read: Reader, content: str, message: str) -> None:
    result = refusal(tmp_path, read, content)
    assert result.startswith(WHERE)
    assert message in result
    assert len(result) < 500 and result.isprintable()


@pytest.mark.parametrize("name", ["..", "", "a/b", "a\\b", "a\0b"])
def test_name_outside_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    for dataset, scene in ((name, "room0"), ("replica", name)):
        with pytest.raises(DataError, match="is not a dataset or scene name"):
            release.OpenLexFiles(tmp_path, dataset, scene)
