"""Results and warnings of ``evaluate`` for external predictions, by format and by scene."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluated_text import CHAIR, TABLE, document, feature_scene, numbers, printed, scene, write_texts, write_truth
from prediction_files import write_maskclustering, write_open3dis, write_scannet_text

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request, ValuesForm
from su3d_bench.metrics.instance.average_precision import THRESHOLDS, combine
from su3d_bench.metrics.instance.scene_counts import per_scene
from su3d_bench.metrics.protocols.loading import load_protocol

# ---- values and warnings


def test_perfect_masks_score_exactly_one_and_classes_without_ground_truth_are_null(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7], [0.9, 0.8]))
    found = numbers(tmp_path)
    assert found["version"] == load_protocol("scannet-instance").version
    assert found["metrics"] == found["ceiling"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
    assert found["per_class"]["chair"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
    assert found["per_class"]["bed"] == {"ap": None, "ap50": None, "ap25": None}
    assert found["per_scene"] == {"scene0001_00": {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}}
    assert found["intervals"] == {"ap": None, "ap50": None, "ap25": None}  # one scene
    assert found["coverage"] is None
    assert found["n_predictions"] == {"scene0001_00": 2}
    assert found["confidences"] == {"min": 0.8, "max": 0.9, "constant": False}
    assert found["warnings"] == []


def test_upper_bound_equals_listing_every_mask_under_every_class() -> None:
    rng = np.random.default_rng(3)
    truth = np.repeat([5001, 5002, 7001, 0, 1001, 12003], [300, 60, 250, 200, 100, 190])
    masks = [np.flatnonzero(rng.random(len(truth)) < share) for share in (0.05, 0.3, 0.6)]
    masks += [np.arange(20, 330), np.arange(340, 640), np.arange(880, 1100)]
    scores = rng.random(len(masks))
    class_ids = [5, 7, 12, 14]
    indptr = np.concatenate([[0], np.cumsum([len(one) for one in masks])])
    indices = np.concatenate(masks).astype(np.int32)
    bound = per_scene(truth, indptr, indices, None, scores, class_ids, 100, THRESHOLDS)
    listed = [one for _ in class_ids for one in masks]
    listed_ptr = np.concatenate([[0], np.cumsum([len(one) for one in listed])])
    labels = np.repeat(class_ids, len(masks))
    whole = per_scene(truth, listed_ptr, np.concatenate(listed), labels, np.tile(scores, len(class_ids)), class_ids)
    assert np.array_equal(combine([bound]).table, combine([whole]).table, equal_nan=True)
    assert np.array_equal(bound.n_missed, whole.n_missed)
    assert combine([bound]).ap > 0


def test_all_fitting_protocols_are_scored_and_the_others_have_a_reason(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([5001, 7002, 1163003], 200))  # 1163 is not an id of NYU40
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    found = document(tmp_path, None)
    assert set(found["protocols"]) == {
        "scannet200-instance",
        "class-agnostic-maskclustering",
        "class-agnostic-open3dis",
        "class-agnostic-segment3d",
    }
    reasons = found["not_scored"]
    assert reasons["scannet-instance"] == "the labels of the ground truth go up to 1163, as ids of ScanNet200 do"
    assert reasons["scannet200-semantic"].startswith("needs a class for every point")
    assert reasons["replica-openmask3d"] == "is not meant for scannet"
    annotated = found["protocols"]["class-agnostic-segment3d"]
    assert annotated["metrics"]["ap50"] == pytest.approx(2 / 3)  # two of three objects, all predictions right
    assert annotated["every_mask_every_class"] is None


FORMS: tuple[tuple[ValuesForm, float], ...] = (("classes", 0.5), ("instances", 0.0))


def test_ambiguous_values_need_truth_values_option(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([1001, 1357, 0], 200))
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [1, 1]))
    either = r"may be class ids only, or class id \* 1000 \+ instance of class 1; choose with --ground-truth-values"
    with pytest.raises(ConfigError, match=rf"1001 to 1357, {either}"):
        numbers(tmp_path, "class-agnostic-segment3d")
    named = Request((tmp_path / "pred",), ground_truth=tmp_path / "gt", protocols=("class-agnostic-segment3d",))
    found = evaluate(replace(named, ground_truth_values="instances")).to_json()["protocols"]["class-agnostic-segment3d"]
    assert found["metrics"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
    write_truth(tmp_path / "labels", values=np.repeat([1163, 1170, 0], 200))  # object, bottle: ids of ScanNet200
    (tmp_path / "points").mkdir()
    (tmp_path / "points/scene0001_00.txt").write_text("1163\n" * 400 + "0\n" * 200)
    request = Request((tmp_path / "points",), ground_truth=tmp_path / "labels", protocols=("scannet200-semantic",))
    with pytest.raises(ConfigError, match=rf"1163 to 1170, {either}"):
        evaluate(request)
    for form, recall in FORMS:
        scored = evaluate(replace(request, ground_truth_values=form)).to_json()["protocols"]["scannet200-semantic"]
        assert scored["metrics"]["macc"] == recall
    write_truth(tmp_path / "labels", values=np.repeat([2, 1163, 0], 200))  # as an instance value, 2 would have no class
    assert evaluate(request).to_json()["protocols"]["scannet200-semantic"]["metrics"]["macc"] == 0.5


# ---- formats


def test_masks_in_other_formats_score_like_the_text_format(tmp_path: Path) -> None:
    one = scene([CHAIR, TABLE[:120], np.arange(380, 560)], [5, 7, 5])
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", one)
    expected = numbers(tmp_path)["metrics"]
    for name, write in (("mc", write_maskclustering), ("o3", write_open3dis)):
        places = {5: 2, 7: 4}  # chair and table in the list of the 18 scored classes
        other = one if name == "mc" else one | {"labels": np.array([places[int(label)] for label in one["labels"]])}
        (tmp_path / name).mkdir()
        write(tmp_path / name / "pred", other)
        write_truth(tmp_path / name / "gt")
        assert numbers(tmp_path / name)["metrics"] == expected


def test_scores_of_maskclustering_rank_its_masks_as_in_the_text_format(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    wrong_first = scene([CHAIR, np.arange(120, 320)], [5, 5], [0.5, 0.9])
    write_scannet_text(tmp_path / "pred", wrong_first)
    of_text = numbers(tmp_path, "class-agnostic-segment3d")
    shutil.rmtree(tmp_path / "pred")
    write_maskclustering(tmp_path / "pred", wrong_first)
    found = {
        form: numbers(tmp_path, "class-agnostic-segment3d", confidences=form) for form in (None, "file", "protocol")
    }
    assert found[None]["metrics"] == found["file"]["metrics"] == of_text["metrics"] != found["protocol"]["metrics"]
    assert printed(found[None], "the confidences in the files are used") and "are ignored" in str(found["protocol"])
    write_maskclustering(tmp_path / "pred", wrong_first | {"scores": np.ones(2)})
    assert printed(numbers(tmp_path, "class-agnostic-segment3d"), "all confidences are 1")


@pytest.mark.parametrize("is_named", [True, False])
def test_scene_whose_masks_all_have_class_0_is_scored(tmp_path: Path, is_named: bool) -> None:
    for name, labels in (("scene0001_00", [0, 0]), ("scene0002_00", [5, 7])):
        write_truth(tmp_path / "gt", name)
        write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], labels) | {"name": name})
    found = numbers(tmp_path) if is_named else document(tmp_path, None)["protocols"]["scannet-instance"]
    assert found["per_scene"]["scene0001_00"]["ap"] == 0 and found["per_scene"]["scene0002_00"]["ap"] == 1
    assert printed(found, "scene0001_00: 2 of 2 masks have a class that is not scored")


def test_instance_numbers_that_restart_with_each_class_stay_separate_objects_as_in_the_original(
    tmp_path: Path,
) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([4001, 5001, 6001], 200))
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE, np.arange(400, 600)], [5, 5, 5]))
    for name in ("class-agnostic-open3dis", "class-agnostic-segment3d"):
        found = numbers(tmp_path, name)
        assert found["metrics"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
        assert not [line for line in found["warnings"] if "restart with each class" in line]
    melted = numbers(tmp_path, "class-agnostic-maskclustering")
    assert melted["metrics"]["ap50"] == 0.0
    assert "so 2 of 3 objects merge with another" in printed(melted, "scene0001_00: instance numbers restart")


def test_features_need_the_protocols_encoder_or_a_text_feature_file(tmp_path: Path) -> None:
    feature_scene(tmp_path)
    with pytest.raises(PredictionError, match=r"needs the encoder 'ViT-L-14-336/openai'.*--text-features FILE.npz"):
        numbers(tmp_path)
    names = [entry.name for entry in load_protocol("scannet-instance").classes]
    write_texts(tmp_path / "texts.npz", names, {"chair": 3, "table": 9})
    found = numbers(tmp_path, text_features=tmp_path / "texts.npz")
    assert found["metrics"]["ap"] == 1.0  # the mask without a feature is classified as wall, which is not scored
    assert printed(found, "labels come from the encoder 'of texts.npz', the protocol's is 'ViT-L-14-336")
    write_texts(tmp_path / "texts.npz", names, {"chair": 3, "table": 9}, encoder="ViT-L-14-336/openai")
    named = numbers(tmp_path, text_features=tmp_path / "texts.npz")
    assert named["metrics"] == found["metrics"]
    assert not [line for line in named["warnings"] if "encoder" in line]
    write_texts(
        tmp_path / "texts.npz", [f"a {name} in a scene".replace("otherfurniture", "other") for name in names], {}
    )
    assert numbers(tmp_path, text_features=tmp_path / "texts.npz")["metrics"]["ap"] is not None
    write_texts(tmp_path / "texts.npz", names[:-1], {})
    with pytest.raises(
        PredictionError, match=r"texts.npz has no feature for 1 of its classes, such as 'otherfurniture'"
    ):
        numbers(tmp_path, text_features=tmp_path / "texts.npz")


# ---- scenes


def test_missing_scenes_are_skipped_with_a_warning_under_the_original_protocol(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0001_01", "scene0002_00"):
        write_truth(tmp_path / "gt", name)
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    found = numbers(tmp_path)
    assert found["metrics"]["ap"] == 1.0
    assert found["skipped_scenes"] == ["scene0001_01", "scene0002_00"]
    assert printed(found, "2 of 3 scenes have no prediction and are skipped, as in the original evaluator")


def test_custom_protocol_counts_missing_scenes(tmp_path: Path) -> None:
    from su3d_bench.metrics.protocols.loading import rules_file

    text = rules_file("scannet-instance").read_text().replace('name = "scannet-instance"', 'name = "mine"')
    (tmp_path / "mine.toml").write_text(text)
    for name in ("scene0001_00", "scene0001_01"):
        write_truth(tmp_path / "gt", name)
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    request = Request((tmp_path / "pred",), ground_truth=tmp_path / "gt", protocols=(str(tmp_path / "mine.toml"),))
    found = evaluate(request).to_json()["protocols"]["mine"]
    assert found["metrics"]["ap"] == 0.5
    assert found["missed_scenes"] == ["scene0001_01"]


def test_last_attribute_of_openscan_type_is_void(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([1001, 96001, 2001], 200))
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [1, 96]))
    found = numbers(tmp_path, "openscan-type")
    assert (found["metrics"]["ap"], found["per_class"]["This term is a baggage"]["ap"]) == (0.5, 1.0)
    assert "This term is a a container for letters" not in found["per_class"]
