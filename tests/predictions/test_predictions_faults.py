"""Any damage to predictions of other programs is one clear error."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import prediction_files as made
import pytest

from su3d_bench.core.files.atomic import write_npz
from su3d_bench.store.predictions import prediction_arrays

# ---- errors in a text list


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("pred_mask/a.txt 5", ":1: 2 fields"),
        ("pred_mask/a.txt five 0.5", "'five' is not a class id"),
        ("pred_mask/a.txt 5 nan", "confidence 'nan' is not a finite number"),
        ("../a.txt 5 0.5", "'../a.txt' is not a path inside the folder"),
        ("/etc/passwd 5 0.5", "'/etc/passwd' is not a path inside the folder"),
        ("pred_mask/none.txt 5 0.5", "mask 'pred_mask/none.txt' does not exist"),
        ("pred_mask/link.txt 5 0.5", "is not a file inside the folder"),
        ("links/a.txt 5 0.5", "is not a file inside the folder"),
        ("loop 5 0.5", "mask 'loop' cannot be read"),
        ("\x1b[31m" + "x" * 9000 + " 5 0.5", "cannot be read"),
        ("pred_mask/short.txt 5 0.5", "is of 2 points and 'pred_mask/a.txt' of 3;"),
        ("pred_mask/word.txt 5 0.5", ":2: 'one' is not a 64-bit integer"),
        ("pred_mask/bad.json 5 0.5", "is not valid JSON"),
        ("pred_mask/huge.json 5 0.5", "'length' is 1000000000000"),
        ("pred_mask/beyond.json 5 0.5", "run of 3 points from 2 in 3 points"),
    ],
)
def test_each_invalid_mask_list_is_one_line_with_its_position(tmp_path: Path, line: str, message: str) -> None:
    folder = tmp_path / "predictions"
    (folder / "pred_mask").mkdir(parents=True)
    (tmp_path / "a.txt").write_text("1\n0\n1\n")
    for name, content in {
        "a.txt": "1\n0\n1\n",
        "short.txt": "1\n0\n",
        "word.txt": "1\none\n1\n",
        "bad.json": "{",
        "huge.json": json.dumps({"length": 10**12, "counts": "1 1000000000000"}),
        "beyond.json": json.dumps({"length": 3, "counts": "2 3"}),
    }.items():
        (folder / "pred_mask" / name).write_text(content)
    os.symlink(tmp_path / "a.txt", folder / "pred_mask/link.txt")
    os.symlink(tmp_path, folder / "links")
    os.symlink("loop", folder / "loop")
    other = "pred_mask/a.txt 3 0.5\n" if "short" in line else ""
    (folder / "scene.txt").write_text(f"{other}{line}\n")
    text = made.refused(folder, "scene", "scannet-text")
    assert text.startswith(f"{folder}/scene.txt") and message in text and "\x1b" not in text


@pytest.mark.parametrize(
    ("content", "message"),
    [("", "is empty"), ("3\nx\n", ":2: 'x' is not a 64-bit integer"), ("1\n4294967296\n", ":2: 42949")],
)
def test_each_invalid_label_file_is_one_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "s.txt").write_text(content)
    assert message in made.refused(tmp_path, "s", "scannet-semantic-text")


# ---- wrong shapes and values in archives


MASKS = made.TOY["masks"].T


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"masks": MASKS}, "has no 'pred_masks'"),
        ({"pred_masks": MASKS[:, 0]}, "expected a matrix of numbers"),
        ({"pred_masks": np.full((4, 2), np.nan)}, "NaN or infinite"),
        ({"pred_masks": MASKS, "pred_score": np.ones(4)}, "3 masks, but the scores are an array of shape (4,)"),
        ({"pred_masks": MASKS, "pred_score": np.array([1, np.nan, 1])}, "mask 'mask 1': the score is nan"),
        ({"pred_masks": MASKS, "pred_classes": np.array([1, 2.5, 3])}, "mask 1 has class 2.5"),
        ({"pred_masks": np.zeros((0, 200_000), bool)}, "200000 masks of 0 points; is it damaged?"),
    ],
)
def test_each_invalid_mask_archive_is_one_line(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "s.npz", **arrays)
    text = made.refused(tmp_path, "s", "maskclustering")
    assert text.startswith(f"{tmp_path}/s.npz") and message in text


def test_wrong_shapes_in_torch_files_are_refused(tmp_path: Path) -> None:
    made.write_torch(tmp_path / "a.pt", (made.Tensor(MASKS), made.Tensor(np.ones(4, np.float32))))
    assert "3 masks, but the scores are an array of shape (4,)" in made.refused(tmp_path, "a", "openyolo3d")
    made.write_torch(tmp_path / "b.pth", {"ins": made.Tensor(MASKS), "conf": made.Tensor(np.ones(7))})
    assert "with 7 scores or classes" in made.refused(tmp_path, "b", "open3dis")
    made.write_openmask3d(tmp_path, made.TOY, made.FEATURES[:2])
    assert "3 masks, but the features are an array of shape (2, 768)" in made.refused(
        tmp_path, made.TOY["name"], "openmask3d"
    )
    made.write_torch(tmp_path / "c.pth", np.zeros((2, 2), np.int64))
    assert "expected one group number per point" in made.refused(tmp_path, "c", "sam3d")
    np.save(tmp_path / "d.npy", np.zeros(4))
    assert "expected one group number per point" in made.refused(tmp_path, "d", "sam3d")
    made.write_torch(tmp_path / "e.pt", made.Sparse(np.zeros((2, 0), np.int64), (5, 10**12)))
    assert "1000000000000 masks of 5 points" in made.refused(tmp_path, "e", "openins3d")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": np.array("Picture")}, "has no 'kind' of"),
        ({"points": np.zeros((6, 2), np.float32)}, "'points' is an array of shape (6, 2) float32"),
        ({"points": np.full((6, 3), np.nan, np.float32)}, "'points' has values that are NaN"),
        ({"scores": np.array([1.0, np.inf])}, "'scores' has values that are NaN"),
        ({"indptr": np.array([0, 5, 2])}, "indptr does not describe"),
        ({"indices": np.array([0, 1, 2, 3, 6], np.int32)}, "mask has index 6, the map has 6 points"),
        ({"boxes": None}, "'boxes' is missing"),
    ],
)
def test_each_invalid_prediction_file_is_one_line(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    arrays = {
        name: array
        for name, array in {**prediction_arrays(made.own_instances()), **changes}.items()
        if array is not None
    }
    write_npz(tmp_path / "prediction.npz", arrays)
    text = made.refused(tmp_path / "prediction.npz", "prediction", "su3d-bench")
    assert text.startswith(f"{tmp_path}/prediction.npz: ") and message in text


# ---- damage
