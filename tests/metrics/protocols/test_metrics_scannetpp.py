"""ScanNet++'s protocols give what its own evaluators answer, to the last bit, from files on disk."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES
from scored_room import ID, LABELS, OneHotEncoder, instances

from su3d_bench.core.maps import DenseFeatures, Masks
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.evaluation.scoring import map_of, skips_missing_scenes
from su3d_bench.metrics.compatibility import ContentFacts, content_incompatibility
from su3d_bench.metrics.instance.score import without_labels
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import ProtocolResult, combine, pack_scores, score_scene, unpack_scores
from su3d_bench.metrics.semantic.top_k import ONE_CLASS, top_k_confusion
from su3d_bench.predictions.base import VertexLabels
from su3d_bench.predictions.export import _runs_json
from su3d_bench.predictions.formats import recognise

INSTANCE, SEMANTIC = load_protocol("scannetpp-instance"), load_protocol("scannetpp-semantic")
TOP_K = load_protocol("rooms-top-k")
ENCODER = OneHotEncoder()
CLASSES = LabelSet("scannetpp", tuple(c.id for c in SEMANTIC.classes), tuple(c.name for c in SEMANTIC.classes))
PROBLEMS = {
    name: json.loads((CASES / f"{name}.json").read_text())["problems"]
    for name in ("scannetpp01_instance", "scannetpp02_semantic")
}


def arrays_of(case: str, index: int) -> Iterator[dict[str, np.ndarray]]:
    with np.load(CASES / f"{case}.npz") as archive:
        for s in range(PROBLEMS[case][index]["n_scenes"]):
            ends = f"_{index}_{s}"
            arrays = {key.removesuffix(ends): archive[key] for key in archive.files if key.endswith(ends)}
            yield {key: array.astype(np.int64) if array.dtype.kind == "i" else array for key, array in arrays.items()}


def truth_of(semantic: np.ndarray, instance: np.ndarray, masked: np.ndarray, every: Any = None) -> GroundTruth:
    points = np.random.default_rng(0).random((len(semantic), 3)).astype(np.float32)
    semantic = semantic.copy()
    semantic[masked] = -1
    return GroundTruth(
        points, semantic.astype(np.int32), instance.astype(np.int32), CLASSES, "scannetpp", "made for a test",
        every_semantic=every,
    )  # fmt: skip


def score_files(folder: Path, truths: dict[str, GroundTruth], rules: Any) -> ProtocolResult:
    """What the files in ``folder`` score, read by the reader that knows them."""
    scores = {}
    for name, truth in truths.items():
        content = recognise(folder, FORMATS[rules.name]).read(folder, name).content
        scores[name] = score_scene(rules, truth, map_of(content, truth.points, rules), None)
    return combine(rules, unpack_scores_of(scores), with_intervals=False)


FORMATS = {"scannetpp-instance": "scannetpp", "scannetpp-semantic": "scannetpp-semantic"}


def unpack_scores_of(scores: dict[str, Any]) -> dict[str, Any]:
    """The scores as a run keeps them."""
    return {
        name: next(iter(unpack_scores(pack_scores({score.protocol: score})).values())) for name, score in scores.items()
    }


def same(value: float, expected: float | None) -> bool:
    return bool(np.isnan(value)) if expected is None else value == expected


@pytest.mark.parametrize("index", range(30))
def test_a_list_of_masks_has_the_answer_of_the_benchmarks_script(index: int, tmp_path: Path) -> None:
    problem, truths = PROBLEMS["scannetpp01_instance"][index], {}
    (tmp_path / "predicted_masks").mkdir()
    for s, one in enumerate(arrays_of("scannetpp01_instance", index)):
        values, lines = one["truth"], []
        semantic = np.where(values > 0, values // 1000 + 1, 0)
        truths[f"{s:010x}"] = truth_of(semantic, np.where(values > 0, values % 1000, 0), one["masked"])
        masks: Any = np.unpackbits(one["masks"], axis=1)[:, : len(values)] if len(one["labels"]) else []
        for k, (mask, label, score, file) in enumerate(
            zip(masks, one["labels"], one["scores"].tolist(), one["files"], strict=True)
        ):
            path = f"predicted_masks/{s:010x}_{file:03d}.json"
            if file == k:
                (tmp_path / path).write_bytes(_runs_json(np.flatnonzero(mask).astype(np.int32), len(values)))
            lines.append(f"{path} {label} {score!r}\n")
        (tmp_path / f"{s:010x}.txt").write_text("".join(lines))
    found = score_files(tmp_path, truths, INSTANCE)
    assert all(same(found.metrics[name], problem[name]) for name in ("AP", "AP50", "AP25"))
    for name, row in problem["classes"].items():
        assert all(
            same(found.per_class[name][key], value) for key, value in zip(("AP", "AP50", "AP25"), row, strict=True)
        )


@pytest.mark.parametrize("index", range(30))
def test_ranked_classes_have_the_answer_of_the_benchmarks_script(index: int, tmp_path: Path) -> None:
    problem, truths = PROBLEMS["scannetpp02_semantic"][index], {}
    for s, one in enumerate(arrays_of("scannetpp02_semantic", index)):
        every = np.where(one["labels"] >= 0, one["labels"] + 1, 0).astype(np.int32)
        truths[f"{s:010x}"] = truth_of(every[:, 0], np.zeros(len(every)), one["masked"], every)
        np.savetxt(tmp_path / f"{s:010x}.txt", one["pred"], fmt="%d", delimiter=",")
    found = score_files(tmp_path, truths, SEMANTIC)
    assert all(same(found.metrics[name], problem[name]) for name in ("mIoU", "top-3 mIoU"))
    with np.load(CASES / "scannetpp02_semantic.npz") as archive:
        expected = archive[f"ious_{index}"]
    columns = [[found.per_class[name][key] for name in CLASSES.names] for key in ("IoU", "top-3 IoU")]
    np.testing.assert_array_equal(columns, expected)


# ---- rules


def test_the_84_classes_are_the_100_without_the_stuff_and_lines_count_from_one() -> None:
    assert [entry.id for entry in SEMANTIC.scored] == list(range(1, 101))
    assert len(INSTANCE.scored) == 84 and INSTANCE.classes == SEMANTIC.classes
    assert {"wall", "ceiling", "floor", "doorframe", "paper"} <= set(INSTANCE.ignore)


def test_a_scene_without_a_submission_counts_as_missed() -> None:
    assert not any(map(skips_missing_scenes, (INSTANCE, SEMANTIC)))  # there the script stops


def test_files_of_class_ids_are_refused_where_the_benchmark_counts_places() -> None:
    facts = ContentFacts("vertex-labels", 3, class_ids=np.array([1, 2, 3]), n_points=3)
    assert "number the classes by their place in the list from 0" in (content_incompatibility(SEMANTIC, facts) or "")
    assert content_incompatibility(TOP_K, facts) is None
    assert content_incompatibility(SEMANTIC, replace(facts, class_ids=None)) is None


def test_masked_points_leave_truth_and_masks_of_every_protocol_of_masks() -> None:
    semantic, instance = np.repeat([10, 0, 5], 150), np.repeat([1, 0, 2], 150)
    masked = np.r_[0:60, 140:160]
    truth = truth_of(semantic, instance, masked)
    prediction = instances(truth.points, [np.arange(150), np.arange(150, 450)], ["chair", "door"], scores=[1.0, 0.5])
    for name in ("scannetpp-instance", "scannetpp-open-vocabulary", "class-agnostic-maskclustering-scannetpp",
                 "class-agnostic-open3dis-scannetpp"):  # fmt: skip
        rules = load_protocol(name)
        values, masks, _ = without_labels(rules, truth, prediction)
        assert not values[masked].any()
        assert not np.isin(masks.indices, masked).any() and masks.sizes.tolist() == [80, 290]
        kept = np.setdiff1d(np.arange(450), masked)
        without = GroundTruth(
            truth.points[kept], truth.semantic[kept], truth.instance[kept], CLASSES, "scannetpp", "made for a test"
        )
        smaller = Masks.of_sets([np.flatnonzero(np.isin(kept, mask)) for mask in prediction.sets()])
        bare = instances(without.points, smaller.sets(), ["chair", "door"], scores=[1.0, 0.5])
        both = [
            combine(rules, {"s": score_scene(rules, *pair, None)}).metrics
            for pair in ((truth, prediction), (without, bare))
        ]
        np.testing.assert_equal(both[0], both[1])


# ---- top k, on a room


def test_the_features_of_a_map_are_ranked_and_the_first_is_what_one_class_would_be() -> None:
    truth = room_truth()
    names = [LABELS.name_of(int(one)) for one in truth.semantic]
    features = np.stack([ENCODER.feature(f"a {name} in a scene") for name in names])
    best, *others = (ENCODER.feature(f"a {name} in a scene") for name in ("sofa", "plate", "chair"))
    turned = features + 2 * best + 1.5 * others[0]
    found = {}
    for key, rows in (("right", features), ("third", turned)):
        prediction = DenseFeatures(truth.points, rows.astype(np.float16))
        found[key] = combine(TOP_K, {"s": score_scene(TOP_K, truth, prediction, ENCODER)}).metrics
    assert found["right"]["mIoU"] == found["right"]["top-3 mIoU"] == 1
    assert found["third"]["mIoU"] < 0.5 < found["third"]["top-3 mIoU"] == 1


def room_truth() -> GroundTruth:
    """A few objects with a label each."""
    points = np.random.default_rng(1).random((60, 3)).astype(np.float32)
    semantic = np.repeat([ID["chair"], ID["table"], ID["lamp"]], 20).astype(np.int32)
    instance = np.repeat([1, 2, 3], 20).astype(np.int32)
    return GroundTruth(points, semantic, instance, LABELS, "mesh-vertices", "made for a test")


def test_one_class_a_point_makes_top_k_top_1_and_is_said() -> None:
    truth = room_truth()
    called = np.where(np.arange(60) < 30, ID["chair"], ID["table"]).astype(np.int32)
    score = score_scene(TOP_K, truth, map_of(VertexLabels(called), truth.points, TOP_K), None)
    assert ONE_CLASS.format(k=3) in score.warnings
    metrics = combine(TOP_K, {"s": score}).metrics
    assert metrics["mIoU"] == metrics["top-3 mIoU"]
    further = np.full((60, 2), ID["lamp"], np.int32)
    ranked = score_scene(TOP_K, truth, map_of(VertexLabels(called, further), truth.points, TOP_K), None)
    assert ONE_CLASS.format(k=3) not in ranked.warnings
    assert combine(TOP_K, {"s": ranked}).metrics["top-3 mIoU"] > metrics["mIoU"]


def test_a_point_without_any_label_is_skipped_and_one_without_a_class_is_missed() -> None:
    labels, ranked = np.array([[-1, -1], [-1, 2], [1, 0]]), np.array([[0, 1], [-1, -1], [2, 0]])
    assert top_k_confusion(labels, ranked, 3).tolist() == [[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]
