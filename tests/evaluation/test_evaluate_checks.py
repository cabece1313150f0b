"""Errors and warnings of ``evaluate``: masks, clouds, ground truth and texts that do not fit or are damaged."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import damages, outcomes, truncations
from evaluated_text import CHAIR, TABLE, numbers, printed, scene, write_truth
from prediction_files import write_scannet_text

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Masks
from su3d_bench.evaluation.text_ground_truth import read_values
from su3d_bench.metrics.matching.checks import check_cloud, mask_facts

# ---- checks


def test_masks_of_another_length_are_refused_with_both_lengths(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR], [5], n=500))
    with pytest.raises(PredictionError, match="scene0001_00: the masks are of 500 points, the ground truth has 600"):
        numbers(tmp_path)


def test_empty_duplicate_and_foreign_masks_give_warnings_with_their_index(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt")
    masks = [CHAIR, [], CHAIR, CHAIR[:195], TABLE]
    write_scannet_text(tmp_path / "pred", scene(masks, [5, 5, 5, 5, 1]))
    found = numbers(tmp_path)
    where = "scene0001_00: "
    assert printed(found, f"{where}1 empty mask, the first is mask 1 (masks/scene0001_00_1.txt)")
    assert printed(found, f"{where}1 pair of identical masks, the first is 0 (masks/scene0001_00_0.txt) and 2 (")
    assert printed(found, f"{where}2 pairs of near-duplicates, the first is 0 (masks/scene0001_00_0.txt) and 3 (")
    assert "1 of class 1 (wall); the first is mask 4" in printed(
        found, f"{where}1 of 5 masks has a class that is not scored"
    )
    assert printed(found, "all confidences are 1")
    assert found["duplicates"] == {"near": 3, "identical": 1}


def test_mask_facts_are_exact() -> None:
    masks = Masks(np.array([0, 3, 6, 8]), np.array([0, 1, 2, 0, 1, 2, 2, 5], np.int32))
    facts = mask_facts(masks, np.array([0.5, 1.0, 0.25]), 8)
    assert (facts.near, facts.identical) == (((0, 1),), ((0, 1),))
    assert (facts.n_covered, facts.n_contested) == (4, 3)
    assert (facts.lowest_score, facts.highest_score) == (0.25, 1.0)
    assert facts.n_masks == 3
    none = mask_facts(Masks(np.zeros(2, np.int64), np.zeros(0, np.int32)), np.zeros(0), 0)
    assert (none.n_masks, none.n_covered, none.n_contested) == (1, 0, 0)
    assert (none.near, none.lowest_score, none.highest_score) == ((), None, None)


BOX = np.array([[0.0, 0, 0], [6.4, 5, 2.5], [1, 1, 1]], np.float32)


@pytest.mark.parametrize(
    ("points", "line"),
    [
        (BOX * 500, "the cloud spans 3200, the scene 6.4 m: millimetres\\?"),
        (BOX * 100, "the cloud spans 640, the scene 6.4 m: centimetres\\?"),
        (BOX * 1e-3, "the cloud spans 0.0064, the scene 6.4 m: kilometres\\?"),
        (BOX + 50, "no point of the cloud is in the box of the scene"),
        (np.array([[0, 0, 0], [1, np.nan, 1]]), "point 1 is at \\[1.0, nan, 1.0\\]; coordinates must be finite"),
    ],
)
def test_cloud_in_other_units_or_position_is_refused(points: Any, line: str) -> None:
    with pytest.raises(PredictionError, match=line):
        check_cloud(points.astype(np.float32), BOX)


# ---- lists of masks


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (" 5 1.0", " 5 nan", "pred/scene0001_00.txt:1: confidence 'nan' is not a finite number"),
        (" 5 1.0", " 3.5 1.0", "pred/scene0001_00.txt:1: '3.5' is not a class id"),
        (" 5 1.0", ",5,1.0", "pred/scene0001_00.txt:1: 1 field in 'masks/scene0001_00_0.txt,5,1.0'; expected 'mask f"),
        (" 5 1.0", " chair", "scene0001_00.txt:1: 'masks/scene0001_00_0.txt chair' is neither 'mask file, class id, c"),
        (" 7 1.0", " 7,1.0", "pred/scene0001_00.txt:2: 2 fields in 'masks/scene0001_00_1.txt 7,1.0'; expected 'mask"),
    ],
)
def test_malformed_line_of_a_list_is_refused_with_file_line_and_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_truth(Path("gt"))
    write_scannet_text(Path("pred"), scene([CHAIR, TABLE], [5, 7]))
    file = Path("pred/scene0001_00.txt")
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(PredictionError, match=re.escape(line)):
        numbers(Path())


@pytest.mark.parametrize("name", ["README.txt", "readme.txt", "LICENSE.txt"])
def test_tabs_byte_order_marks_and_readmes_do_not_matter(tmp_path: Path, name: str) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7]))
    plain = numbers(tmp_path)
    for file in (tmp_path / "gt", tmp_path / "pred"):
        (file / name).write_text("Results of the second run\n")
    for file in tmp_path.rglob("scene*.txt"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b" ", b"\t"))
    assert numbers(tmp_path) == plain


# ---- hostile files


def test_every_damaged_ground_truth_file_is_one_error_with_its_name(tmp_path: Path) -> None:
    file = tmp_path / "scene0001_00.txt"
    content = "".join(f"{value}\n" for value in [0, 5001, 1163002, 39001, 7]).encode()

    def read(damaged: bytes) -> object:
        file.write_bytes(damaged)
        return read_values(file)

    for copies in (truncations(content), damages(content)):
        n_read, n_refused = outcomes(read, copies, must_name=file.name)
        assert n_refused > 0
        assert n_read > 0
