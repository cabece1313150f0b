"""Maps with one feature per point: on disk equal to in memory, stored in a second file, read and scored in blocks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import INTRINSICS, images, pose

from su3d_bench.baselines.conceptfusion import point_fusion as feature_table
from su3d_bench.baselines.conceptfusion.method import ConceptFusion, ConceptFusionConfig
from su3d_bench.baselines.conceptfusion.point_fusion import FeatureTable
from su3d_bench.core.errors import PredictionError, StoreError
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, SceneInfo
from su3d_bench.metrics.matching.labelling import most_similar
from su3d_bench.metrics.semantic.score import has_feature
from su3d_bench.predictions.run_predictions import OWN_RUNS
from su3d_bench.store import predictions
from su3d_bench.store.predictions import features_beside, read_prediction, write_prediction

POINTS = np.arange(12, dtype=np.float32).reshape(4, 3)
ROWS = np.arange(20, dtype=np.float16).reshape(4, 5)


# ---- on disk and in memory


def in_the_box(index: int) -> tuple[Frame, Detections]:
    rgb, depth_m = images(index)
    masks = np.array([(rgb == colour).all(-1) for colour in np.unique(rgb.reshape(-1, 3), axis=0)])
    features = np.random.default_rng(index).normal(size=(len(masks) + 1, 48)).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    found = Detections(
        index, masks, np.tile(np.array([0, 0, 48, 36], np.float32), (len(masks), 1)),
        np.ones(len(masks), np.float32), ("side",) * len(masks), ("",) * len(masks), (1.0,),
        features[1:, None], features[0],
    )  # fmt: skip
    return Frame(index, 0.0, rgb, depth_m.astype(np.float32), pose(index), INTRINSICS), found


def fused(feature_storage: Any) -> ConceptFusion:
    method = ConceptFusion(ConceptFusionConfig(height=36, width=48, feature_storage=feature_storage))
    method.start(SceneInfo("made", "box", 6, 1, "camera"))
    for index in range(6):
        method.update(*in_the_box(index), Timer())
    return method


def test_features_on_disk_equal_those_in_memory_bit_by_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feature_table, "BLOCK_ROWS", 100)  # many blocks
    on_disk, in_memory = fused("disk"), fused("memory")
    disk, memory = on_disk.finish(), in_memory.finish()
    assert disk.features.dtype == memory.features.dtype == np.float16
    np.testing.assert_array_equal(disk.features.view(np.uint16), memory.features.view(np.uint16))
    np.testing.assert_array_equal(disk.points, memory.points)
    assert on_disk.n_points > 1.2 * 36 * 48  # it grew, so the file was mapped at several sizes
    assert on_disk.map_bytes == in_memory.map_bytes
    for prediction in (disk, memory):
        assert not prediction.features.flags.writeable
    monkeypatch.setattr(feature_table, "scratch_folder", lambda: Path("/none"))
    assert fused("memory").n_points == on_disk.n_points
    with pytest.raises(StoreError, match="cannot write features to /none"):
        fused("disk")


def test_mean_is_computed_in_float32_and_rounded_once_per_update() -> None:
    table = FeatureTable(2, "memory")
    first, second = np.array([[0.1, 1.0]], np.float16), np.array([[0.3, -1.0]], np.float16)
    table.append(first, np.zeros(1, np.int32), np.array([3.0]))
    table.average(np.array([0]), second, np.zeros(1, np.int32), np.array([1.0]))
    expected = np.float32(0.75) * first.astype(np.float32) + np.float32(0.25) * second.astype(np.float32)
    np.testing.assert_array_equal(table.features(), expected.astype(np.float16))
    assert table.confidences.tolist() == [4.0]


# ---- scratch


# ---- the store


def test_dense_features_are_a_separate_memory_mapped_file(tmp_path: Path) -> None:
    path = tmp_path / "prediction.npz"
    write_prediction(path, DenseFeatures(POINTS, ROWS))
    assert sorted(child.name for child in tmp_path.iterdir()) == ["prediction.features.npy", "prediction.npz"]
    with np.load(path) as archive:
        assert set(archive.files) == {"kind", "points"}
    again = read_prediction(path)
    assert isinstance(again, DenseFeatures) and isinstance(again.features, np.memmap)
    np.testing.assert_array_equal(again.features, ROWS)
    np.testing.assert_array_equal(np.load(features_beside(path)), ROWS)


def test_features_written_in_blocks_equal_the_file_of_numpy_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictions, "ROWS_AT_ONCE", 3)
    write_prediction(tmp_path / "a.npz", DenseFeatures(POINTS, ROWS))
    np.save(tmp_path / "b.npy", ROWS)
    assert (tmp_path / "a.features.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()
    mapped = read_prediction(tmp_path / "a.npz")
    write_prediction(tmp_path / "c.npz", mapped)
    assert (tmp_path / "c.features.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()


@pytest.mark.parametrize("damage", ["missing", "cut", "text", "rows", "integers"])
def test_missing_or_damaged_features_are_a_one_line_error_in_both_readers(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "prediction.npz"
    write_prediction(path, DenseFeatures(POINTS, ROWS))
    temporary_path = features_beside(path)
    if damage == "missing":
        temporary_path.unlink()
    elif damage == "cut":
        temporary_path.write_bytes(temporary_path.read_bytes()[:-3])
    elif damage == "text":
        temporary_path.write_text("not numbers")
    else:
        np.save(temporary_path, ROWS[:3] if damage == "rows" else ROWS.astype(np.int16))
    with pytest.raises(StoreError, match=r"prediction\.features\.npy: .*run again$"):
        read_prediction(path)
    with pytest.raises(PredictionError, match=r"prediction(\.features)?\.npy?z?: "):
        OWN_RUNS.read(path, "prediction")


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f2', 'fortran_order': False, 'shape': (4, 999999999999), }",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (4, 5), }",
        b"{'descr': '<f2', 'fortran_order': True, 'shape': (4, 5), }",
        b"__import__('os').abort()",
    ],
)
def test_hostile_feature_headers_are_rejected(tmp_path: Path, header: bytes) -> None:
    path = tmp_path / "prediction.npz"
    write_prediction(path, DenseFeatures(POINTS, ROWS))
    padded = header + b" " * (117 - len(header)) + b"\n"
    content = b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded + ROWS.tobytes()
    features_beside(path).write_bytes(content)
    with pytest.raises(PredictionError, match=r"prediction\.features\.npy: "):
        OWN_RUNS.read(path, "prediction")


# ---- scoring in blocks


def test_labels_of_a_mapped_table_equal_those_of_rows_in_memory(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(20_000, 16)).astype(np.float16)
    features[::7] = 0
    write_prediction(tmp_path / "a.npz", DenseFeatures(np.zeros((20_000, 3), np.float32), features))
    mapped = read_prediction(tmp_path / "a.npz")
    assert isinstance(mapped, DenseFeatures)
    text = rng.normal(size=(9, 16)).astype(np.float32)
    np.testing.assert_array_equal(most_similar(mapped.features, text), most_similar(features, text))
    np.testing.assert_array_equal(has_feature(mapped), np.arange(20_000) % 7 != 0)
