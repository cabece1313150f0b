"""ScanNet's ground truth on a hand-worked mesh: both label sets, both releases, each fault once, damaged files."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from recording_files import grid
from scannet_scan import SCAN, TABLE_ROWS, table_text, write_truth

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.scannet import truth as annotation
from su3d_bench.metrics.instance.average_precision import encode_ground_truth
from su3d_bench.metrics.protocols.loading import load_protocol

WHERE = f"scannet/{SCAN}"
# 24 vertices in four rows of six. Segment 7 covers the first two columns, 12 the next two, 19 the last two;
# 19 is in two objects, the later of which (the stool) gets it; vertex 0 is in segment 3, which is in none.
SEGMENTS = [7, 7, 12, 12, 19, 19] * 4
SEGMENTS[0] = 3
GROUPS = [(0, "chair", [7]), (2, "piano", [12, 19]), (5, "stool", [19])]
NYU40 = [5, 5, 39, 39, 40, 40] * 4
NYU40[0] = 0
INSTANCE = [1, 1, 3, 3, 6, 6] * 4
INSTANCE[0] = 0


def read(folder: Path, scan: str = SCAN) -> annotation.AnnotatedScan:
    return annotation.read_annotated_scan(
        {name: folder / name for name in annotation.truth_names(scan)}, scan, f"scannet/{scan}"
    )


def table(tmp_path: Path, text: str | None = None) -> annotation.LabelTable:
    (tmp_path / annotation.TABLE_NAME).write_text(table_text() if text is None else text, newline="")
    return annotation.read_label_table(tmp_path / annotation.TABLE_NAME, WHERE)


def test_nyu40_uses_file_labels_and_the_last_object_with_the_segment(tmp_path: Path) -> None:
    write_truth(tmp_path, SEGMENTS, GROUPS, NYU40)
    truth = annotation.nyu40_truth(read(tmp_path), [])
    assert truth.semantic.tolist() == NYU40
    assert truth.instance.tolist() == INSTANCE
    assert truth.variant == "nyu40-vertices"
    np.testing.assert_array_equal(truth.points, grid()[0])
    # label * 1000 + id + 1, as Mask3D writes it
    assert encode_ground_truth(truth.semantic, truth.instance)[:6].tolist() == [0, 5001, 39003, 39003, 40006, 40006]


def test_scannet200_uses_the_raw_id_of_the_category(tmp_path: Path) -> None:
    write_truth(tmp_path, SEGMENTS, GROUPS, NYU40)
    truth = annotation.scannet200_truth(read(tmp_path), table(tmp_path))
    assert truth.semantic[:6].tolist() == [0, 2, 90, 90, 38, 38]
    assert truth.instance.tolist() == INSTANCE
    assert [truth.labels.name_of(one) for one in (2, 38, 90)] == ["chair", "stool", "piano"]


def test_label_sets_match_the_class_names_of_the_protocols(tmp_path: Path) -> None:
    sets = {
        "scannet-instance": annotation.nyu40_label_set(),
        "scannet200-instance": annotation.raw_label_set(table(tmp_path)),
    }
    for protocol, labels in sets.items():
        classes = load_protocol(protocol).classes
        assert [labels.name_of(entry.id) for entry in classes] == [entry.name for entry in classes]
        assert len(set(labels.names)) == len(labels.names)
    assert annotation.nyu40_label_set().ids == tuple(range(1, 41))


def test_raw_id_outside_the_200_does_not_reuse_their_names(tmp_path: Path) -> None:
    labels = annotation.raw_label_set(table(tmp_path, table_text([*TABLE_ROWS, ("book", 1300, 23, "books")])))
    assert labels.name_of(1300) == "book (1300)"
    assert labels.name_of(22) == "book"


def test_table_with_mixed_line_ends_trailing_blanks_and_repeated_categories(tmp_path: Path) -> None:
    rows = [*TABLE_ROWS, ("object ", 40, 40, "otherprop"), ("object", 1234, 39, "otherfurniture")]
    text = "\ufeff" + table_text(rows).replace("\n", "\r\n", 3).replace("\n", "\r", 2) + "\r\n\t\n"
    (tmp_path / annotation.TABLE_NAME).write_bytes(text.encode())
    found = annotation.read_label_table(tmp_path / annotation.TABLE_NAME, WHERE)
    assert (found.nyu40_of["object"], found.raw_id_of["object"]) == (40, 40)
    assert found.nyu40_of["couch"] == 6


def test_category_without_row_is_void_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_truth(tmp_path, SEGMENTS, [*GROUPS[:2], (5, "Stool", [19])], NYU40)
    with caplog.at_level(logging.WARNING):
        truth = annotation.scannet200_truth(read(tmp_path), table(tmp_path))
    assert truth.semantic[:6].tolist() == [0, 2, 90, 90, 0, 0]
    assert [record.getMessage() for record in caplog.records] == [
        f"{WHERE}: categories without a row in {annotation.TABLE_NAME}: 1 (the first: 'Stool'); vertices made void: 8"
    ]


def test_ids_may_be_text_and_categories_padded(tmp_path: Path) -> None:
    groups = [(str(one), f" {category} ", [str(part) for part in parts]) for one, category, parts in GROUPS]
    write_truth(tmp_path, [str(one) for one in SEGMENTS], groups, NYU40)
    truth = annotation.scannet200_truth(read(tmp_path), table(tmp_path))
    assert truth.instance.tolist() == INSTANCE
    assert truth.semantic[:3].tolist() == [0, 2, 90]


RAW = [2 if one == 5 else 90 if one == 39 else 38 if one == 40 else 0 for one in NYU40]


@pytest.mark.parametrize("groups", [GROUPS, [(0, "chair", [7]), (2, "couch", [12]), (5, "stool", [19])]])
def test_raw_ids_of_the_first_release_become_nyu40(tmp_path: Path, groups: list) -> None:  # type: ignore[type-arg]
    """The second scan has no id above 40: only its objects identify the release."""
    raw = [6 if one == 90 else one for one in RAW] if groups is not GROUPS else RAW
    write_truth(tmp_path, SEGMENTS, groups, raw, prefix="")
    truth = annotation.nyu40_truth(read(tmp_path), [table(tmp_path)])
    assert truth.semantic.tolist() == ([6 if one == 39 else one for one in NYU40] if groups is not GROUPS else NYU40)
    assert truth.instance.tolist() == INSTANCE
    assert "categories" in truth.source


def test_stray_label_above_40_does_not_indicate_the_first_release(tmp_path: Path) -> None:
    """As in scene0270_00 and scene0384_00 of the second release."""
    labels = [149 if k == 8 else one for k, one in enumerate(NYU40)]
    write_truth(tmp_path, SEGMENTS, [*GROUPS[:2], (5, "stool with a name of its own", [19])], labels)
    truth = annotation.nyu40_truth(read(tmp_path), [table(tmp_path)])
    assert truth.semantic.tolist() == [0 if k == 8 else one for k, one in enumerate(NYU40)]
    assert "labels.ply" in truth.source


def first_table(tmp_path: Path) -> annotation.LabelTable:
    """The first release's table: row numbers instead of ids, and a missing class."""
    categories = [("wall", "1"), ("stool", "40"), ("storage", ""), *[(f"thing {k}", "40") for k in range(4, 47)]]
    categories += [("piano", "39"), ("chair", "5")]
    rows = [f"{name}\t7\t21\t{nyu40}\t4\t{name}" for name, nyu40 in categories]
    (tmp_path / annotation.FIRST_TABLE_NAME).write_text(
        "\n".join(["category\tcount\tnyuId\tnyu40id\teigen13id\tnyuClass", *rows])
    )
    return annotation.read_label_table(tmp_path / annotation.FIRST_TABLE_NAME, WHERE)


@pytest.mark.parametrize("beside", [False, True])
def test_first_release_labels_are_rows_of_its_own_table(tmp_path: Path, beside: bool) -> None:
    rows = [48 if one == 5 else 47 if one == 39 else 2 if one == 40 else 0 for one in NYU40]
    write_truth(tmp_path, SEGMENTS, GROUPS, rows, prefix="")
    first = first_table(tmp_path)
    assert (first.raw_id_of["storage"], first.nyu40_of.get("storage")) == (3, None)
    other = table(tmp_path, table_text([("chair", 2, 6, "sofa")]))  # lacks piano and maps chair to sofa
    truth = annotation.nyu40_truth(read(tmp_path), [other, first] if beside else [first])
    assert truth.semantic.tolist() == NYU40
    assert truth.source.endswith(f"categories in {annotation.FIRST_TABLE_NAME} and the objects of .aggregation.json")
    (tmp_path / annotation.FIRST_TABLE_NAME).write_text(table_text().replace("\tcategory", "\tother"))
    with pytest.raises(DataError, match=r"scannet-labels.combined.tsv: has no column 'category'"):
        annotation.read_label_table(tmp_path / annotation.FIRST_TABLE_NAME, WHERE)


def test_triangle_belongs_to_the_majority_instance_of_its_vertices(tmp_path: Path) -> None:
    write_truth(tmp_path, SEGMENTS, GROUPS, NYU40)
    mesh = annotation.instance_mesh(read(tmp_path), [])
    # the first cell: vertices 0 (none), 1 and 6 (chair); the second: 1, 7 (chair) and 2, 8 (piano)
    assert mesh.triangles[:4].tolist() == [[0, 1, 6], [1, 7, 6], [1, 2, 7], [2, 8, 7]]
    assert mesh.instance_of_triangle[:4].tolist() == [1, 1, 1, 3]
    assert mesh.class_of_instance == {1: 5, 3: 39, 6: 40}


def test_triangle_of_three_instances_belongs_to_none(tmp_path: Path) -> None:
    points, triangles = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    write_truth(tmp_path, [1, 2, 3], [(0, "chair", [1]), (1, "couch", [2]), (2, "x", [3])], [5, 6, 0],
                mesh=(points, triangles))  # fmt: skip
    mesh = annotation.instance_mesh(read(tmp_path), [])
    assert mesh.instance_of_triangle.tolist() == [0]
    assert mesh.class_of_instance == {1: 5, 2: 6}
