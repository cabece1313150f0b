"""PCD files of every form are read bit by bit, and every damaged file is a typed error."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import traced

from su3d_bench.core.errors import DataError
from su3d_bench.formats.pcd import read_pcd_points, write_pcd_points

POINTS = np.array([[1.5, -2.25, 0.0], [1.5, 3.0, 1e-3], [1.5, 3.0, 7.0]], np.float32)


def header(
    form: str, n: int = 3, *, fields: str = "x y z", sizes: str = "4 4 4", types: str = "F F F", **more: Any
) -> str:
    lines = {
        "VERSION": "0.7",
        "FIELDS": fields,
        "SIZE": sizes,
        "TYPE": types,
        "COUNT": " ".join("1" for _ in fields.split()),
        "WIDTH": str(n),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(n),
        "DATA": form,
        **more,
    }
    return "# .PCD v0.7 - Point Cloud Data file format\n" + "".join(
        f"{key} {value}\n" for key, value in lines.items() if value
    )


def packed_as_runs(content: bytes) -> bytes:
    """LZF without repetitions: runs of at most 32 bytes."""
    parts = [content[at : at + 32] for at in range(0, len(content), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


def compressed(points: Any, packed: bytes | None = None, n_plain: int | None = None) -> bytes:
    plain = np.ascontiguousarray(points.T).tobytes()
    body = packed_as_runs(plain) if packed is None else packed
    sizes = struct.pack("<II", len(body), len(plain) if n_plain is None else n_plain)
    return header("binary_compressed", len(points)).encode() + sizes + body


def forms(points: Any = POINTS) -> dict[str, bytes]:
    text = "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in points)
    return {
        "ascii": (header("ascii", len(points)) + text).encode(),
        "binary": header("binary", len(points)).encode() + points.tobytes(),
        "binary_compressed": compressed(points),
    }


def read(path: Path, content: bytes) -> Any:
    path.write_bytes(content)
    return read_pcd_points(path, "map: a.pcd")


def refused(path: Path, content: bytes) -> str:
    with pytest.raises(DataError) as caught:
        read(path, content)
    message = str(caught.value)
    assert message.startswith("map: a.pcd") and "\n" not in message and len(message) < 500
    return message


@pytest.mark.parametrize("form", forms())
def test_every_pcd_form_is_read_unchanged(tmp_path: Path, form: str) -> None:
    np.testing.assert_array_equal(read(tmp_path / "a.pcd", forms()[form]), POINTS.astype(np.float64))


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_of_open3d_are_read(tmp_path: Path, form: str) -> None:
    import open3d

    rng = np.random.default_rng(0)
    points = rng.normal(size=(5000, 3)).astype(np.float32).round(1)  # rounded, so that LZF finds repetitions
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.colors = open3d.utility.Vector3dVector(rng.random((5000, 3)).round(1))
    path = tmp_path / "a.pcd"
    open3d.io.write_point_cloud(str(path), cloud, write_ascii=form == "ascii", compressed=form == "binary_compressed")
    assert f"DATA {form}\n".encode() in path.read_bytes()[:400]
    np.testing.assert_allclose(read_pcd_points(path), points, rtol=0, atol=1e-9 if form != "ascii" else 1e-6)


def test_written_pcd_is_read_here_and_by_open3d(tmp_path: Path) -> None:
    import open3d

    path = tmp_path / "a.pcd"
    points = np.random.default_rng(1).normal(size=(100, 3)).astype(np.float32)
    write_pcd_points(path, points)
    np.testing.assert_array_equal(read_pcd_points(path), points.astype(np.float64))
    np.testing.assert_array_equal(np.asarray(open3d.io.read_point_cloud(str(path)).points), points.astype(np.float64))


def test_other_pcd_fields_and_types_are_ignored(tmp_path: Path) -> None:
    kind = np.dtype([("intensity", "u1"), ("x", "<f8"), ("hist", "<f4", 3), ("z", "<i2"), ("y", "<f4")])
    rows = np.zeros(2, kind)
    rows["x"], rows["y"], rows["z"] = [0.1, 0.2], [1.5, 2.5], [-3, 4]
    head = header("binary", 2, fields="intensity x hist z y", sizes="1 8 4 2 4", types="U F F I F", COUNT="1 1 3 1 1")
    expected = [[0.1, 1.5, -3.0], [0.2, 2.5, 4.0]]
    assert read(tmp_path / "a.pcd", head.encode() + rows.tobytes()).tolist() == expected
    text = head.replace("DATA binary", "DATA ascii") + "7 0.1 1 2 3 -3 1.5\n9 0.2 1 2 3 4 2.5\n"
    assert read(tmp_path / "a.pcd", text.encode()).tolist() == expected


def test_missing_points_of_an_organised_cloud_are_nan(tmp_path: Path) -> None:
    content = header("ascii", 2, WIDTH="1", HEIGHT="2") + "nan nan nan\n1 2 3\n"
    found = read(tmp_path / "a.pcd", content.encode())
    assert np.isnan(found[0]).all() and found[1].tolist() == [1, 2, 3]


def test_empty_cloud_is_read(tmp_path: Path) -> None:
    for content in forms(np.zeros((0, 3), np.float32)).values():
        assert read(tmp_path / "a.pcd", content).shape == (0, 3)


@pytest.mark.parametrize(
    "changes",
    [
        *({"FIELDS": "x y w"}, {"FIELDS": "x x z"}, {"FIELDS": "x y"}, {"SIZE": "4 4 3"}, {"TYPE": "F F Q"}),
        *({"COUNT": "1 1 0"}, {"COUNT": "1 1 999999999999"}, {"COUNT": "1 1 2"}, {"POINTS": "4"}, {"WIDTH": "-3"}),
        *({"WIDTH": ""}, {"DATA": "base64"}, {"COLOUR": "red"}, {"COLUMNS": "a b c"}),
    ],
    ids=str,
)
def test_each_invalid_pcd_header_is_a_one_line_error(tmp_path: Path, changes: dict[str, Any]) -> None:
    head = header("binary", **changes)
    if "COLOUR" in changes or "COLUMNS" in changes:  # before the last line of the header
        ((key, value),) = changes.items()
        head = header("binary").replace("DATA", f"{key} {value}\nDATA")
    refused(tmp_path / "a.pcd", head.encode() + POINTS.tobytes())


@pytest.mark.parametrize(
    "packed",
    [
        bytes([32, 0]) + bytes(34),  # a repetition before anything was written
        bytes([0, 0, 32, 1]),  # a repetition from before the beginning
        bytes([31]) + bytes(10),  # a run beyond the end
        bytes([0, 0, 7 << 5]),  # a repetition without its length
        bytes([0, 0, 32]),  # a repetition without its distance
        bytes([0, 0, 7 << 5, 255, 0]),  # more than declared
        bytes([0, 0]),  # less
    ],
)
def test_damaged_compressed_points_are_a_one_line_error(tmp_path: Path, packed: bytes) -> None:
    message = refused(tmp_path / "a.pcd", compressed(POINTS, packed))
    assert "compressed points are damaged" in message or "truncated or damaged" in message


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_header_larger_than_the_file_allocates_nothing(tmp_path: Path, form: str) -> None:
    content = header(form, 10**12 - 1).encode() + struct.pack("<II", 100, 0xFFFFFFFF) + b"1 2 3\n" * 20
    with traced(1 << 22):
        refused(tmp_path / "a.pcd", content)
