"""Predictions in the formats of other programs survive a round trip, and each format is recognized uniquely."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import prediction_files as made
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import CASES, ROOT

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.formats.arrays import integer_lines, run_members
from su3d_bench.metrics.instance.average_precision import last_line_of_each_mask_file
from su3d_bench.predictions.base import ScenePrediction, VertexLabels, VertexMasks
from su3d_bench.predictions.formats import READERS, recognise
from su3d_bench.store.predictions import write_prediction

MASK_CASES = sorted(p.stem for kind in ("inst", "replica", "scannet200") for p in CASES.glob(f"{kind}*.npz"))
LABEL_CASES = sorted(p.stem for p in CASES.glob("sem*.npz"))


def read(path: Path, scene: str, format: str | None = None) -> ScenePrediction:
    return recognise(path, format).read(path, scene)


def masks_of(prediction: ScenePrediction) -> VertexMasks:
    assert isinstance(prediction.content, VertexMasks)
    return prediction.content


def assert_masks(content: VertexMasks, masks: Any, labels: Any = None, scores: Any = None) -> None:
    assert len(content) == len(masks)
    assert content.n_points == (masks.shape[1] if len(masks) else content.n_points)
    for k, mask in enumerate(masks):
        np.testing.assert_array_equal(content.mask(k), np.flatnonzero(mask))
    np.testing.assert_array_equal(content.scores, np.ones(len(masks)) if scores is None else scores)
    if labels is None:
        assert content.class_numbers is None
    else:
        np.testing.assert_array_equal(content.class_numbers, labels)


# ---- the reference cases in every format that supports them


@pytest.mark.parametrize("case", MASK_CASES)
def test_reference_cases_survive_a_round_trip_through_scannet_text_files(tmp_path: Path, case: str) -> None:
    scenes = made.scenes_of(case)
    for scene in scenes:
        made.write_scannet_text(tmp_path, scene)
    reader = recognise(tmp_path)
    assert reader.name == "scannet-text"
    assert sorted(reader.scenes(tmp_path)) == sorted(scene["name"] for scene in scenes)
    for scene in scenes:
        lines = last_line_of_each_mask_file(scene["files"])
        first, last = [a for a, _ in lines], [b for _, b in lines]
        prediction = reader.read(tmp_path, scene["name"])
        # With two lines for one file, the file itself is that of the last writer.
        assert_masks(masks_of(prediction), scene["masks"][last], scene["labels"][last], scene["scores"][last])
        assert masks_of(prediction).keys == tuple(scene["files"][line] for line in first)
        assert masks_of(prediction).numbering == "id"
        assert len(prediction.remarks) == (len(lines) < len(scene["files"]))


@pytest.mark.parametrize("case", MASK_CASES)
def test_reference_cases_survive_a_round_trip_through_mask_archives(tmp_path: Path, case: str) -> None:
    for scene in made.scenes_of(case):
        masks, labels, scores = scene["masks"], scene["labels"], scene["scores"]
        made.write_maskclustering(tmp_path / "maskclustering", scene)
        assert_masks(masks_of(read(tmp_path / "maskclustering", scene["name"])), masks, labels, scores)
        made.write_open3dis(tmp_path / "open3dis", scene)
        content = masks_of(read(tmp_path / "open3dis", scene["name"]))
        assert_masks(content, masks, labels, scores)
        assert content.numbering == "index"
        features = np.random.default_rng(1).normal(size=(len(masks), 8))
        made.write_openmask3d(tmp_path / "openmask3d", scene, features)
        content = masks_of(read(tmp_path / "openmask3d", scene["name"]))
        assert_masks(content, masks)
        np.testing.assert_array_equal(content.features, features.astype(np.float32))
        made.write_openyolo3d(tmp_path / "openyolo3d", scene)
        assert_masks(masks_of(read(tmp_path / "openyolo3d", scene["name"])), masks, scores=scores.astype(np.float32))
        made.write_openins3d(tmp_path / "openins3d", scene)
        assert_masks(masks_of(read(tmp_path / "openins3d", scene["name"])), masks)


@pytest.mark.parametrize("case", LABEL_CASES)
def test_reference_labels_survive_a_round_trip_through_text_files(tmp_path: Path, case: str) -> None:
    with np.load(CASES / f"{case}.npz") as archive:
        labels = {key: archive[key] for key in archive.files if key.startswith("pred_")}
    for key, values in labels.items():
        np.savetxt(tmp_path / f"{key}.txt", values, fmt="%d")
    for key, values in labels.items():
        prediction = read(tmp_path, key)
        assert prediction.format == "scannet-semantic-text"
        assert isinstance(prediction.content, VertexLabels)
        np.testing.assert_array_equal(prediction.content.class_ids, values)


# ---- each format


def test_a_folder_as_mask3d_and_segment3d_export_it_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "instance_evaluation_exp_0" / "decoder_-1"
    folder.mkdir(parents=True)
    (folder / "pred_mask").mkdir()
    for k, mask in enumerate(made.TOY["masks"]):
        np.savetxt(folder / f"pred_mask/scene0011_00_{k}.txt", mask, fmt="%d")
    lines = [f"pred_mask/scene0011_00_{k}.txt 0.0 1.0\n" for k in range(3)]
    (folder / "scene0011_00.txt").write_text("".join(lines))
    for path in (folder.parent, folder, folder / "scene0011_00.txt"):
        assert_masks(masks_of(read(path, "scene0011_00")), made.TOY["masks"], [0, 0, 0])


def test_masks_of_scannetpp_are_read_from_run_lengths(tmp_path: Path) -> None:
    made.write_scannetpp_json(tmp_path, made.TOY)
    assert_masks(masks_of(read(tmp_path, made.TOY["name"])), made.TOY["masks"], made.TOY["labels"], made.TOY["scores"])


def test_official_result_file_in_the_folder_is_not_a_scene(tmp_path: Path) -> None:
    made.write_scannet_text(tmp_path, made.TOY)
    (tmp_path / "semantic_instance_evaluation.txt").write_text("class,class id,ap,ap50,ap25\n")
    assert list(recognise(tmp_path).scenes(tmp_path)) == ["scene0011_00"]


def test_mask_file_listed_under_two_spellings_is_one_mask(tmp_path: Path) -> None:
    made.write_scannet_text(tmp_path, made.TOY)
    list_file = tmp_path / "scene0011_00.txt"
    list_file.write_text(list_file.read_text() + "pred_mask/../pred_mask/./scene0011_00_0.txt 3 0.125\n")
    prediction = read(tmp_path, "scene0011_00")
    assert_masks(masks_of(prediction), made.TOY["masks"], [3, 7, 39], [0.125, 0.25, 0.75])
    assert prediction.remarks[0].startswith("1 lines repeat a mask file: class and confidence of its last line")


def test_maskclustering_and_mask3d_name_the_scores_differently(tmp_path: Path) -> None:
    masks, scores, labels = made.TOY["masks"].T, made.TOY["scores"], made.TOY["labels"]
    for folder, arrays, remarks in (
        ("a", {"pred_score": scores, "pred_classes": labels}, 0),
        ("b", {"pred_scores": scores, "pred_classes": labels.astype(np.float32)}, 0),
        ("c", {"pred_score": np.ones(3), "pred_classes": np.zeros(3, np.int32)}, 1),
        ("d", {}, 1),
    ):
        (tmp_path / folder).mkdir()
        np.savez_compressed(tmp_path / folder / "s.npz", pred_masks=masks, **arrays)
        prediction = read(tmp_path / folder, "s")
        expected = (None, None) if folder == "d" else (arrays["pred_classes"], next(iter(arrays.values())))
        assert_masks(masks_of(prediction), made.TOY["masks"], *expected)
        assert len(prediction.remarks) == remarks


def test_open3dis_tensors_have_masks_in_rows_unless_the_number_of_scores_differs(tmp_path: Path) -> None:
    made.write_open3dis(tmp_path, made.TOY, as_tensor=True)
    assert_masks(masks_of(read(tmp_path, made.TOY["name"])), made.TOY["masks"], made.TOY["labels"], made.TOY["scores"])
    turned = {"ins": made.Tensor(made.TOY["masks"].T), "conf": made.Tensor(made.TOY["scores"])}
    made.write_torch(tmp_path / "turned.pth", turned)
    prediction = read(tmp_path, "turned")
    assert_masks(masks_of(prediction), made.TOY["masks"], None, made.TOY["scores"])
    assert any("class-agnostic" in remark for remark in prediction.remarks)
    made.write_torch(tmp_path / "alone.pth", {"ins": made.Tensor(made.TOY["masks"]), "conf": None})
    assert_masks(masks_of(read(tmp_path, "alone")), made.TOY["masks"])


def test_labelled_masks_of_openyolo3d_are_distinguished_from_proposals(tmp_path: Path) -> None:
    made.write_openyolo3d(tmp_path, made.TOY, has_labels=True)
    prediction = read(tmp_path, made.TOY["name"])
    assert prediction.format == "openyolo3d" and masks_of(prediction).numbering == "index"
    assert_masks(masks_of(prediction), made.TOY["masks"], made.TOY["labels"], made.TOY["scores"].astype(np.float32))
    assert prediction.remarks == ("Open-YOLO 3D's own evaluator uses 1 for every score",)


def test_open3dis_scores_of_all_classes_give_the_score_of_the_masks_class(tmp_path: Path) -> None:
    table = np.random.default_rng(2).random((3, 50))
    made.write_open3dis(tmp_path, made.TOY | {"scores": table.ravel()})
    own = table[np.arange(3), made.TOY["labels"]]
    assert_masks(masks_of(read(tmp_path, made.TOY["name"])), made.TOY["masks"], made.TOY["labels"], own)


def test_run_lengths_may_be_a_list_of_numbers() -> None:
    (mask, *_) = made.TOY["masks"]
    np.testing.assert_array_equal(run_members(40, made.runs(mask).tolist(), "x"), np.flatnonzero(mask))


def test_openmask3d_masks_without_a_feature_keep_a_row_of_zeros(tmp_path: Path) -> None:
    features = made.FEATURES.copy()
    features[0], features[1, 5] = 0, np.nan
    made.write_openmask3d(tmp_path, made.TOY, features)
    prediction = read(tmp_path, made.TOY["name"])
    stored = masks_of(prediction).features
    assert stored is not None and not stored[:2].any()
    np.testing.assert_array_equal(stored[2], made.FEATURES[2].astype(np.float32))
    assert prediction.remarks == (
        "the file has no scores: 1 for every mask",
        "2 masks have no feature (a row of zeros or NaN)",
    )


def test_openmask3d_short_names_tensors_and_missing_features_are_read(tmp_path: Path) -> None:
    made.write_torch(tmp_path / "room0.pt", made.Tensor(made.TOY["masks"].T))
    prediction = read(tmp_path, "room0")
    assert_masks(masks_of(prediction), made.TOY["masks"])
    assert masks_of(prediction).features is None and "no features" in prediction.remarks[1]
    np.save(tmp_path / "room0.npy", made.FEATURES)
    prediction = read(tmp_path, "room0")
    np.testing.assert_array_equal(masks_of(prediction).features, made.FEATURES.astype(np.float32))


@pytest.mark.parametrize("suffix", [".pth", ".npy"])
def test_groups_of_sam3d_become_masks_without_classes(tmp_path: Path, suffix: str) -> None:
    groups = np.array([4, -1, 0, 0, 4, -1, 2, 0])
    if suffix == ".npy":
        np.save(tmp_path / "s.npy", groups)
    else:
        made.write_torch(tmp_path / "s.pth", groups)
    prediction = read(tmp_path, "s")
    assert_masks(masks_of(prediction), np.stack([groups == 0, groups == 2, groups == 4]))
    assert prediction.format == "sam3d" and masks_of(prediction).keys == ("group 0", "group 2", "group 4")
    np.save(tmp_path / "none.npy", np.full(5, -1))
    none = masks_of(READERS["sam3d"].read(tmp_path, "none"))
    assert (len(none), none.n_points) == (0, 5)


def test_colours_of_sam3d_are_groups_and_black_is_none(tmp_path: Path) -> None:
    groups = np.repeat([1, -1, 0, 1, 2], [30, 25, 40, 15, 50])
    made.write_sam3d_colours(tmp_path / "s.ply", groups)
    prediction = read(tmp_path, "s")
    sizes = sorted(masks_of(prediction).sizes.tolist())
    assert (prediction.format, sizes, masks_of(prediction).n_points) == ("sam3d-colours", [40, 45, 50], len(groups))
    members = {tuple(masks_of(prediction).mask(k).tolist()) for k in range(3)}
    assert members == {tuple(np.flatnonzero(groups == group).tolist()) for group in range(3)}
    made.write_sam3d_colours(tmp_path / "photograph.ply", np.arange(200))
    assert READERS["sam3d-colours"].recognise(tmp_path / "photograph.ply") is None
    (tmp_path / "plain.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    with pytest.raises(PredictionError, match=r"plain.ply: its points have no colours red, green, blue of one byte"):
        read(tmp_path / "plain.ply", "plain", "sam3d-colours")


def test_run_folders_and_prediction_files_are_read(tmp_path: Path) -> None:
    dense = DenseFeatures(np.zeros((4, 3), np.float32), np.ones((4, 8), np.float16))
    parts = Partition(np.zeros((4, 3), np.float32), np.zeros(4, np.int32), np.ones((1, 8), np.float32))
    contents: dict[str, Prediction] = {
        "replica.room0": made.own_instances(),
        "replica.room1": dense,
        "rooms.a.b": parts,
    }
    for name, content in contents.items():
        (tmp_path / "run/scenes" / name / "opensu3d").mkdir(parents=True)
        write_prediction(tmp_path / "run/scenes" / name / "opensu3d/prediction.npz", content)
    reader = recognise(tmp_path / "run")
    scenes = ["replica/room0", "replica/room1", "rooms/a.b"]
    assert (reader.name, sorted(reader.scenes(tmp_path / "run"))) == ("su3d-bench", scenes)
    for scene, content in zip(scenes, contents.values(), strict=True):
        ours = reader.read(tmp_path / "run", scene).content
        assert type(ours) is type(content)
        np.testing.assert_array_equal(ours.points, content.points)
    one = tmp_path / "run/scenes/replica.room0/opensu3d"
    for path in (one / "prediction.npz", one, one.parent):
        ours = read(path, "replica/room0").content
        assert isinstance(ours, Instances) and ours.indices.tolist() == [0, 1, 2, 3, 5]
    (one.parent / "other").mkdir()
    write_prediction(one.parent / "other/prediction.npz", made.own_instances())
    for path, advice in ((tmp_path / "run", "/scenes/*/opensu3d"), (one.parent, "/opensu3d")):
        with pytest.raises(PredictionError) as caught:
            recognise(path).scenes(path)
        assert "contains predictions of 2 methods (opensu3d, other)" in str(caught.value)
        assert str(caught.value).endswith(f"give the folders of one: {path}{advice}")


# ---- which format a path is in


@pytest.mark.parametrize("format", made.OURS)
def test_each_format_is_recognized_uniquely(tmp_path: Path, format: str) -> None:
    folder = made.written_in(tmp_path, format)
    assert recognise(folder).name == format
    assert [name for name in READERS if READERS[name].recognise(folder) is not None] == [format]
    (file,) = recognise(folder).scenes(folder).values()
    assert recognise(file).name == format
    assert recognise(folder, format).name == format


def test_path_in_no_format_or_in_two_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(PredictionError, match="no such file or folder"):
        recognise(tmp_path / "none")
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8")
    for path in (tmp_path, tmp_path / "photo.jpg"):
        with pytest.raises(PredictionError, match="is in no known format"):
            recognise(path)
    made.write_scannet_text(tmp_path, made.TOY)
    made.write_maskclustering(tmp_path, made.TOY)
    with pytest.raises(
        PredictionError, match=r"could be in 2 formats \(scannet-text: .*; maskclustering: .*--input-format"
    ):
        recognise(tmp_path)
    with pytest.raises(ConfigError, match=r"unknown format 'maskclusterin'; did you mean 'maskclustering'"):
        recognise(tmp_path, "maskclusterin")


# ---- one integer per line


@settings(max_examples=300, deadline=None)
@given(content=st.text("019-+ \n\r.x", max_size=12).map(str.encode))
def test_integer_lines_reject_what_python_rejects(content: bytes) -> None:
    try:
        expected: list[int] | None = [int(line) for line in content.splitlines()]
    except ValueError:
        expected = None
    try:
        ours: list[int] | None = integer_lines(content, "x").tolist()
    except PredictionError:
        ours = None
    assert ours == expected


PAGE = (ROOT / "docs/formats.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## `([^`]+)`\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))


def test_docs_page_has_one_section_per_format() -> None:
    assert list(SECTIONS) == list(READERS)


@pytest.mark.parametrize("name", READERS)
def test_a_format_has_its_files_and_a_command(name: str) -> None:
    assert "```text\n" in SECTIONS[name] and "```sh\nsu3d-bench evaluate " in SECTIONS[name]
    suffixes = getattr(READERS[name], "suffixes", ())
    assert any(suffix in SECTIONS[name] for suffix in suffixes) or not suffixes
