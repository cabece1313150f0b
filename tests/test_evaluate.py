"""What ``evaluate`` checks and says beside the numbers of predictions made elsewhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import damages, outcomes, truncations
from prediction_files import (
    write_maskclustering,
    write_open3dis,
    write_openmask3d,
    write_sam3d,
    write_scannet_text,
)

from su3d_bench.cli.main import main
from su3d_bench.datasets.openlex3d import VISIBLE_NAME
from su3d_bench.errors import ConfigError, DataError, PredictionError
from su3d_bench.evaluation import Request, evaluate
from su3d_bench.evaluation_bound import every_class_counts
from su3d_bench.evaluation_checks import check_cloud, mask_facts
from su3d_bench.evaluation_scenes import Source, match_scenes
from su3d_bench.evaluation_texts import read_text_features
from su3d_bench.evaluation_truth import read_text_truth
from su3d_bench.metrics.instance_ap import THRESHOLDS, combine, per_scene
from su3d_bench.metrics.transfer import Masks
from su3d_bench.predictions.formats import READERS
from su3d_bench.protocols import load_protocol

HERE = Path(__file__).parent
PAINTED = f"{HERE}/painted.py:Painted"
N = 600
CHAIR, TABLE = np.arange(200), np.arange(200, 400)  # the objects of the small scene; the other points are void
TRUTH = np.repeat([5001, 7002, 1003], 200)


def write_truth(folder: Path, name: str = "scene0001_00", values: Any = TRUTH) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.txt").write_text("".join(f"{value}\n" for value in values))


def scene(
    masks: list[Any], labels: list[int], scores: list[float] | None = None, name: str = "scene0001_00", n: int = N
) -> dict[str, Any]:
    full = np.zeros((len(masks), n), bool)
    for row, members in zip(full, masks, strict=True):
        row[members] = True
    return {
        "name": name,
        "masks": full,
        "labels": np.array(labels),
        "scores": np.array(scores or [1.0] * len(masks)),
        "files": [f"masks/{name}_{k}.txt" for k in range(len(masks))],
    }


def document(folder: Path, protocol: str | None = "scannet-instance", **more: Any) -> dict[str, Any]:
    """The JSON value of ``pred`` against ``gt`` in ``folder``."""
    protocols = () if protocol is None else (protocol,)
    request = Request((folder / "pred",), ground_truth=folder / "gt", protocols=protocols, **more)
    value: dict[str, Any] = json.loads(json.dumps(evaluate(request).to_json(), allow_nan=False))
    return value


def numbers(folder: Path, protocol: str = "scannet-instance", **more: Any) -> dict[str, Any]:
    found: dict[str, Any] = document(folder, protocol, **more)["protocols"][protocol]
    return found


def said(found: dict[str, Any], beginning: str) -> str:
    """The only warning that begins so."""
    (line,) = [line for line in found["warnings"] if line.startswith(beginning)]
    return str(line)


# ---- numbers and what stands beside them


def test_perfect_masks_score_exactly_one_and_classes_without_truth_are_null(tmp_path: Path) -> None:
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


def test_points_that_several_masks_claim_are_counted(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR, np.arange(150, 350)], [5, 7]))
    assert numbers(tmp_path)["contested_points"] == 50 / 350


def test_the_bound_equals_every_mask_listed_under_every_class() -> None:
    rng = np.random.default_rng(3)
    truth = np.repeat([5001, 5002, 7001, 0, 1001, 12003], [300, 60, 250, 200, 100, 190])
    masks = [np.flatnonzero(rng.random(len(truth)) < share) for share in (0.05, 0.3, 0.6)]
    masks += [np.arange(20, 330), np.arange(340, 640), np.arange(880, 1100)]
    scores = rng.random(len(masks))
    class_ids = [5, 7, 12, 14]
    indptr = np.concatenate([[0], np.cumsum([len(one) for one in masks])])
    bound = every_class_counts(
        truth, Masks(indptr, np.concatenate(masks).astype(np.int32)), scores, class_ids, 100, THRESHOLDS
    )
    listed = [one for _ in class_ids for one in masks]
    listed_ptr = np.concatenate([[0], np.cumsum([len(one) for one in listed])])
    labels = np.repeat(class_ids, len(masks))
    whole = per_scene(truth, listed_ptr, np.concatenate(listed), labels, np.tile(scores, len(class_ids)), class_ids)
    assert np.array_equal(combine([bound]).table, combine([whole]).table, equal_nan=True)
    assert np.array_equal(bound.n_missed, whole.n_missed)
    assert combine([bound]).ap > 0


def test_all_protocols_that_fit_are_scored_at_once_and_the_others_have_a_reason(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([5001, 7002, 1163003], 200))  # 1163 is no id of NYU40
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    found = document(tmp_path, None)
    assert set(found["protocols"]) == {
        "scannet200-instance",
        "class-agnostic-maskclustering",
        "class-agnostic-open3dis",
        "class-agnostic-segment3d",
    }
    reasons = found["not_scored"]
    assert reasons["scannet-instance"] == "the labels of the ground truth are 'scannet200-vertices'"
    assert reasons["scannet200-semantic"].startswith("needs a class for every point")
    assert reasons["replica-openmask3d"] == "is not meant for scannet"
    annotated = found["protocols"]["class-agnostic-segment3d"]
    assert annotated["metrics"]["ap50"] == pytest.approx(2 / 3)  # two of three objects, all predictions right
    assert annotated["every_mask_every_class"] is None


def test_labels_of_another_list_are_doubted(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([5001, 1163002, 0], 200))
    write_scannet_text(tmp_path / "pred", scene([CHAIR], [5]))
    assert "NYU40 ends at 40" in said(numbers(tmp_path), "the ground truth holds the label 1163")
    write_truth(tmp_path / "gt")
    assert "NYU40 ids?" in said(numbers(tmp_path, "scannet200-instance"), "the largest label of the ground truth is 7")


def test_instance_protocols_refuse_a_truth_of_labels_alone(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=TRUTH // 1000)
    write_scannet_text(tmp_path / "pred", scene([CHAIR], [5]))
    with pytest.raises(ConfigError, match=r"scannet-instance.*needs instances, the ground truth holds class ids alone"):
        numbers(tmp_path)


def test_labels_of_points_may_be_held_against_a_truth_with_instances(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    (tmp_path / "pred").mkdir()
    (tmp_path / "pred/scene0001_00.txt").write_text("5\n" * 300 + "7\n" * 100 + "99\n" * 200)
    found = numbers(tmp_path, "scannet-semantic")
    assert found["metrics"]["macc"] == pytest.approx(0.5)  # chair 1, table 0.5, wall 0
    assert found["per_class"]["chair"]["iou"] == pytest.approx(2 / 3)
    assert "200 of 600 points are predicted as none of the 20 classes (most often 99, first at point 400)" in said(
        found, "scene0001_00: 200"
    )
    with pytest.raises(PredictionError, match="pred: scene0001_00: openlex3d-topn: needs ground truth of the form"):
        document(tmp_path, "openlex3d-topn")


# ---- formats


def test_masks_in_other_formats_give_the_numbers_of_the_text(tmp_path: Path) -> None:
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


def test_masks_without_classes_are_scored_where_classes_do_not_count(tmp_path: Path) -> None:
    groups = np.repeat([0, 1, -1], 200)
    write_truth(tmp_path / "gt", values=np.repeat([5001, 7002, 0], 200))
    write_sam3d(tmp_path / "pred", "scene0001_00", groups)
    assert numbers(tmp_path, "class-agnostic-segment3d")["metrics"]["ap"] == 1.0
    with pytest.raises(PredictionError, match="scene0001_00: scannet-instance: needs classes"):
        numbers(tmp_path)


def test_masks_of_class_0_alone_are_class_agnostic(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_maskclustering(tmp_path / "pred", scene([CHAIR], [0]))
    with pytest.raises(PredictionError, match="needs classes, every mask has class 0"):
        numbers(tmp_path)


def feature_scene(folder: Path) -> None:
    """OpenMask3D's files of two masks, the first like a chair, the second like a table; no feature for the third."""
    write_truth(folder / "gt")
    features = np.zeros((3, 16))
    features[0, 3], features[1, 9] = 2.0, 5.0
    write_openmask3d(folder / "pred", scene([CHAIR, TABLE, np.arange(150)], [0, 0, 0]), features)


def write_texts(path: Path, names: list[str], of: dict[str, int], **more: Any) -> None:
    features = np.full((len(names), 16), 0.01, np.float32)
    for name, column in of.items():
        features[names.index(name), column] = 1.0
    np.savez(path, names=np.array(names), features=features, **more)


def test_features_need_the_protocols_encoder_or_a_file_of_texts(tmp_path: Path) -> None:
    feature_scene(tmp_path)
    with pytest.raises(PredictionError, match=r"needs the encoder 'ViT-L-14-336/openai'.*--text-features FILE.npz"):
        numbers(tmp_path)
    names = [entry.name for entry in load_protocol("scannet-instance").classes]
    write_texts(tmp_path / "texts.npz", names, {"chair": 3, "table": 9})
    found = numbers(tmp_path, text_features=tmp_path / "texts.npz")
    assert found["metrics"]["ap"] == 1.0  # the mask without a feature is called wall, which is not scored
    assert said(found, "labels come from the encoder 'of texts.npz', the protocol's is 'ViT-L-14-336")
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


def test_scenes_without_a_prediction_are_left_out_loudly_under_the_originals_name(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0001_01", "scene0002_00"):
        write_truth(tmp_path / "gt", name)
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    found = numbers(tmp_path)
    assert found["metrics"]["ap"] == 1.0
    assert found["skipped_scenes"] == ["scene0001_01", "scene0002_00"]
    assert said(found, "2 of 3 scenes have no prediction and are left out, as the original evaluator does")


def test_an_empty_list_counts_every_object_as_missed(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0001_01"):
        write_truth(tmp_path / "gt", name)
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    (tmp_path / "pred/scene0001_01.txt").write_text("")
    found = numbers(tmp_path)
    assert found["metrics"]["ap"] == 0.5 * (1 + 1) / 2
    assert found["skipped_scenes"] == []


def test_an_empty_first_scene_decides_nothing(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0001_01"):
        write_truth(tmp_path / "gt", name, np.repeat([5001, 7002, 1163003], 200))
    write_sam3d(tmp_path / "pred", "scene0001_00", np.full(N, -1))
    write_sam3d(tmp_path / "pred", "scene0001_01", np.repeat([0, 1, -1], 200))
    found = document(tmp_path, None)
    assert "class-agnostic-segment3d" in found["protocols"]
    assert found["not_scored"]["scannet200-instance"].startswith("needs classes")


def test_a_protocol_of_the_user_counts_missing_scenes(tmp_path: Path) -> None:
    from su3d_bench.protocols import rules_file

    text = rules_file("scannet-instance").read_text().replace('name = "scannet-instance"', 'name = "mine"')
    (tmp_path / "mine.toml").write_text(text)
    for name in ("scene0001_00", "scene0001_01"):
        write_truth(tmp_path / "gt", name)
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    request = Request((tmp_path / "pred",), ground_truth=tmp_path / "gt", protocols=(str(tmp_path / "mine.toml"),))
    found = evaluate(request).to_json()["protocols"]["mine"]
    assert found["metrics"]["ap"] == 0.5
    assert found["missed_scenes"] == ["scene0001_01"]


def test_a_prediction_without_a_truth_is_refused(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR], [5], name="scene0001_02"))
    with pytest.raises(
        PredictionError, match="gt: no ground truth for the predicted scene 'scene0001_02'; did you mean"
    ):
        numbers(tmp_path)


def test_chosen_scenes_alone_are_scored(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0001_01"):
        write_truth(tmp_path / "gt", name)
        write_scannet_text(tmp_path / "pred", scene([CHAIR], [5], name=name))
    assert list(numbers(tmp_path, scenes=("*_01",))["per_scene"]) == ["scene0001_01"]
    with pytest.raises(DataError, match=r"no scene of .*gt matches 'scene0003_00'"):
        numbers(tmp_path, scenes=("scene0003_00",))


def matched(names: list[str], known: list[str]) -> dict[str, str]:
    source = Source(Path("pred"), READERS["scannet-text"], tuple(names))
    return {match.scene: match.name for match in match_scenes([source], known, "replica", "gt")[0]}


def test_names_of_scenes_agree_in_spite_of_signs_and_additions() -> None:
    known = ["room0", "room1", "office0"]
    assert matched(["room_0", "Office-0"], known) == {"room0": "room_0", "office0": "Office-0"}
    assert matched(["room0_mesh"], known) == {"room0": "room0_mesh"}
    assert matched(["room0", "room0_old"], known) == {"room0": "room0"}
    with pytest.raises(PredictionError, match=r"room0: 2 predictions match it .room0_a, room0_b."):
        matched(["room0_a", "room0_b"], known)
    with pytest.raises(PredictionError, match="no ground truth for the predicted scene 'room01'"):
        matched(["room01"], known)


def test_a_single_prediction_is_that_of_the_single_scene_asked_for(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7], name="final"))
    found = document(tmp_path, scenes=("scene0001_00",))
    assert found["protocols"]["scannet-instance"]["metrics"]["ap"] == 1.0
    assert found["remarks"] == ["scene0001_00: the prediction 'final' is taken for it, as the only one"]
    with pytest.raises(PredictionError, match="no ground truth for the predicted scene 'final'"):
        document(tmp_path)


def test_the_same_scene_in_two_paths_is_refused(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    for folder in ("one", "two"):
        write_scannet_text(tmp_path / folder, scene([CHAIR], [5]))
    request = Request((tmp_path / "one", tmp_path / "two"), ground_truth=tmp_path / "gt")
    with pytest.raises(PredictionError, match="scene 'scene0001_00' is predicted in several of the paths"):
        evaluate(request)


# ---- checks


def test_masks_of_another_length_are_refused_with_both_lengths(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR], [5], n=500))
    with pytest.raises(PredictionError, match="scene0001_00: the masks are of 500 points, the ground truth has 600"):
        numbers(tmp_path)


def test_empty_double_and_foreign_masks_are_warned_of_with_their_index(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    masks = [CHAIR, [], CHAIR, CHAIR[:195], TABLE]
    write_scannet_text(tmp_path / "pred", scene(masks, [5, 5, 5, 5, 1]))
    found = numbers(tmp_path)
    where = "scene0001_00: "
    assert said(found, f"{where}1 empty mask, the first is mask 1 (masks/scene0001_00_1.txt)")
    assert said(found, f"{where}1 pair of identical masks, the first is 0 (masks/scene0001_00_0.txt) and 2 (")
    assert said(found, f"{where}2 pairs of near-duplicates, the first is 0 (masks/scene0001_00_0.txt) and 3 (")
    assert "1 of class 1 (wall); the first is mask 4" in said(
        found, f"{where}1 of 5 masks has a class that is not scored"
    )
    assert said(found, "every confidence is 1")
    assert found["duplicates"] == {"near": 3, "identical": 1}


def test_two_lines_that_name_one_mask_file_are_told(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR], [5]) | {"files": ["masks/m.txt"]})
    listed = tmp_path / "pred/scene0001_00.txt"
    listed.write_text(listed.read_text() + "masks/m.txt 7 0.5\n")
    remarks = document(tmp_path)["remarks"]
    assert any(line.startswith("scene0001_00: 1 lines name a mask file again") for line in remarks)


def test_facts_of_masks_are_exact() -> None:
    masks = Masks(np.array([0, 3, 6, 8]), np.array([0, 1, 2, 0, 1, 2, 2, 5], np.int32))
    facts = mask_facts(masks, np.array([0.5, 1.0, 0.25]), 8)
    assert (facts.near, facts.identical) == (((0, 1),), ((0, 1),))
    assert (facts.n_covered, facts.n_contested) == (4, 3)
    assert (facts.lowest_score, facts.highest_score) == (0.25, 1.0)


BOX = np.array([[0.0, 0, 0], [6.4, 5, 2.5], [1, 1, 1]], np.float32)


@pytest.mark.parametrize(
    ("points", "line"),
    [
        (BOX * 500, "a: the cloud spans 3200, the scene 6.4 m: millimetres\\?"),
        (BOX * 100, "a: the cloud spans 640, the scene 6.4 m: centimetres\\?"),
        (BOX * 1e-3, "a: the cloud spans 0.0064, the scene 6.4 m: kilometres\\?"),
        (BOX + 50, "a: no point of the cloud lies in the box of the scene"),
        (BOX * np.nan, "a: point 0 is at"),
    ],
)
def test_a_cloud_in_other_units_or_elsewhere_is_refused(points: Any, line: str) -> None:
    with pytest.raises(PredictionError, match=line):
        check_cloud("a", points.astype(np.float32), BOX)


def test_a_cloud_half_outside_is_doubted_and_one_that_fits_is_not() -> None:
    assert check_cloud("a", BOX, BOX) == []
    assert check_cloud("a", BOX[:0], BOX) == []
    moved = BOX + np.array([6, 4.5, 0], np.float32)
    assert check_cloud("a", moved, BOX)[0].startswith("a: only 33 % of the cloud lies in the box of the scene")


# ---- hostile files


def test_every_damage_to_a_truth_file_is_one_error_with_its_name(tmp_path: Path) -> None:
    file = tmp_path / "scene0001_00.txt"
    content = "".join(f"{value}\n" for value in [0, 5001, 1163002, 39001, 7]).encode()

    def read(damaged: bytes) -> object:
        file.write_bytes(damaged)
        return read_text_truth({"scene0001_00": file})

    for copies in (truncations(content), damages(content)):
        n_read, n_refused = outcomes(read, copies, must_name=file.name)
        assert n_refused > 0
        assert n_read > 0


def test_every_damage_to_a_file_of_texts_is_one_error_with_its_name(tmp_path: Path) -> None:
    file = tmp_path / "texts.npz"
    write_texts(file, ["chair", "table"], {"chair": 1})
    content = file.read_bytes()

    def read(damaged: bytes) -> object:
        file.write_bytes(damaged)
        return read_text_features(file)

    for copies in (truncations(content), damages(content)):
        _, n_refused = outcomes(read, copies, must_name=file.name)
        assert n_refused > 0


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ({"names": np.array(["a"])}, "has no 'names' and 'features'"),
        ({"names": np.array([1]), "features": np.ones((1, 2))}, "expected texts"),
        ({"names": np.array(["a", "b"]), "features": np.ones((1, 2))}, "one finite row of features a name"),
        ({"names": np.array(["a"]), "features": np.full((1, 2), np.nan)}, "one finite row of features a name"),
        ({"names": np.array(["a", "a"]), "features": np.ones((2, 2))}, "'a' stands there twice"),
        ({"names": np.array(["a"]), "features": np.ones((1, 2)), "encoder": np.array([1])}, "expected one text"),
    ],
)
def test_a_file_of_texts_that_does_not_fit_is_refused(arrays: dict[str, Any], line: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "texts.npz", **arrays)
    with pytest.raises(DataError, match=line):
        read_text_features(tmp_path / "texts.npz")


# ---- datasets


def run_oracle(folder: Path, monkeypatch: pytest.MonkeyPatch, scenes: str, capsys: Any) -> Path:
    from painted import colour_perception

    from su3d_bench import scene_run

    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    words = ["run", "--scenes", f"{PAINTED}/{scenes}", "--methods", "oracle", "--protocols", "rooms-instance"]
    assert main([*words, "--no-pictures", "--jobs", "1", "--out", str(folder / "run"), "--quiet"]) == 0
    capsys.readouterr()
    return folder / "run"


BOTH = ("rooms-instance", "rooms-semantic")


def test_the_oracle_of_a_dataset_scores_exactly_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_oracle(tmp_path, monkeypatch, "[ab]", capsys)
    found = evaluate(Request((run,), dataset=PAINTED, protocols=BOTH)).to_json()["protocols"]
    assert found["rooms-instance"]["metrics"] == {"ap": 1.0, "ap50": 1.0, "ap25": 1.0}
    assert found["rooms-semantic"]["metrics"] == {"macc": 1.0, "miou": 1.0, "fmiou": 1.0}
    assert found["rooms-instance"]["coverage"] == {"0.025": 1.0, "0.05": 1.0, "0.1": 1.0}
    assert list(found["rooms-instance"]["per_scene"]) == ["a", "b"]  # those of the run, not all of the dataset


def test_scenes_that_a_run_lost_count_as_missed_under_our_own_protocols(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_oracle(tmp_path, monkeypatch, "[ab]", capsys)
    (run / "scenes/painted.b/oracle/prediction.npz").unlink()
    found = evaluate(Request((run,), dataset=PAINTED, protocols=BOTH)).to_json()["protocols"]
    assert found["rooms-instance"]["metrics"]["ap"] == 0.5  # half of the recall, precision 1
    assert found["rooms-instance"]["missed_scenes"] == ["b"]
    assert found["rooms-semantic"]["metrics"]["macc"] < 1
    assert said(found["rooms-instance"], "1 of 2 scenes have no prediction and count as missed: b")
    for name in ("prediction.npz", "."):
        alone = run / "scenes/painted.a/oracle" / name
        found = evaluate(Request((alone,), dataset=PAINTED, protocols=BOTH)).to_json()["protocols"]
        assert found["rooms-instance"]["metrics"]["ap"] == 1.0  # each stands for its scene, a folder of scenes for all


def test_masks_on_the_points_of_a_dataset_make_a_map_too(tmp_path: Path) -> None:
    from painted import Painted

    truth = Painted(tmp_path, Painted.Options()).ground_truth("a", "mesh-vertices")
    masks = [np.flatnonzero(truth.instance == k) for k in (1, 2, 3)]
    write_scannet_text(tmp_path / "pred", scene(masks, [20, 76, 80], name="a", n=len(truth.points)))
    found = evaluate(Request((tmp_path / "pred",), dataset=PAINTED, protocols=BOTH, scenes=("a",))).to_json()
    assert found["protocols"]["rooms-instance"]["metrics"]["ap"] == 1.0
    assert found["protocols"]["rooms-semantic"]["metrics"]["macc"] == 1.0
    assert found["protocols"]["rooms-instance"]["coverage"]["0.025"] == 1.0
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels/a.txt").write_text("".join(f"{one}\n" for one in truth.semantic))
    request = Request((tmp_path / "labels",), dataset=PAINTED, protocols=("rooms-semantic",), scenes=("a",))
    assert evaluate(request).to_json()["protocols"]["rooms-semantic"]["metrics"]["miou"] == 1.0


def test_a_map_of_its_own_points_needs_a_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_oracle(tmp_path, monkeypatch, "a", capsys)
    write_truth(tmp_path / "gt", "a")
    with pytest.raises(PredictionError, match="has points of its own, the ground truth has no coordinates"):
        evaluate(Request((run,), dataset=PAINTED, ground_truth=tmp_path / "gt", protocols=("rooms-instance",)))


# ---- OpenLex3D


def write_release(folder: Path) -> None:
    """OpenLex3D's files of a room with a chair at the left and a table at the right."""
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


def test_openlex3ds_queries_are_scored_against_its_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert said(one, "no ceiling is known: masks grow by the threshold")
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
