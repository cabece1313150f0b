"""What fuzzing found readers and the command line to stumble over: each is one clear line now."""

from __future__ import annotations

import io
import json
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz_targets_runs import copied_run
from numpy.typing import NDArray

from su3d_bench.analysis.leaderboard import leaderboard
from su3d_bench.analysis.tables import check_paper
from su3d_bench.cli.main import main
from su3d_bench.core.config import parse_value, read_file
from su3d_bench.core.errors import (
    MOST_CHARACTERS,
    ConfigError,
    DataError,
    PredictionError,
    StoreError,
    Su3dError,
)
from su3d_bench.core.files.atomic import is_file, read_arrays, read_json
from su3d_bench.core.files.unpacking import DAMAGE
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.metrics.protocols.loading import load_protocol, read_protocol
from su3d_bench.metrics.scoring import combine, unpack_scores
from su3d_bench.questions.files.queries import read_query_file
from su3d_bench.runs.advice import recent_update_s
from su3d_bench.runs.finished import read_run
from su3d_bench.store.predictions import read_prediction

DEEP, LONG = "[" * 100_000, "1" * 5000
NO_TEXT = np.array([0x3F800000], np.uint32).tobytes()  # a float's bits where a character should be


def npz(folder: Path, header: str, body: bytes = b"") -> Path:
    """An archive of one array, which says of itself what ``header`` says."""
    text = header.encode().ljust(117) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        archive.writestr("a.npy", member)
    return folder / "a.npz"


@pytest.mark.parametrize(
    ("header", "body"),
    [
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (3,", b""),  # no end: tokenize's own error
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776,)}", b""),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (0, -4)}", b""),
        ("{'descr': '<U0', 'fortran_order': False, 'shape': (1099511627776,)}", b""),  # of no bytes, says NumPy
        ("{'descr': '<U1', 'fortran_order': False, 'shape': (1,)}", NO_TEXT),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"\x80\x04N."),
    ],
)
def test_no_header_of_an_array_is_believed(tmp_path: Path, header: str, body: bytes) -> None:
    path = npz(tmp_path, header, body)
    with pytest.raises(DAMAGE):
        read_arrays(path)
    with pytest.raises(StoreError, match=r"a\.npz: not a readable \.npz file"):
        read_prediction(path)


def test_a_member_that_is_no_array_is_damage() -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("a.npy", b"no array")
    with pytest.raises(DAMAGE):
        read_arrays(content)


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i8", "|b1", "<U5", ">U2", "|S3", "<c8"])
@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 0, 3), (2, 3, 4)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path, dtype: str, shape: tuple[int, ...], order: str) -> None:
    array = np.asarray(np.arange(int(np.prod(shape))).reshape(shape).astype(dtype), order=order)  # type: ignore[call-overload]
    np.savez(tmp_path / "a.npz", a=array)
    ours = read_arrays(tmp_path / "a.npz")["a"]
    with np.load(tmp_path / "a.npz") as theirs:
        np.testing.assert_array_equal(ours, theirs["a"])
        assert (ours.dtype, ours.shape, ours.flags.writeable) == (theirs["a"].dtype, array.shape, True)


def test_a_shape_of_hundreds_of_digits_is_refused_at_once(tmp_path: Path) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({'1' * 400},), }}".encode() + b"\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    started = time.monotonic()
    with pytest.raises(PredictionError, match=r"a\.npy"):
        read_npy(tmp_path / "a.npy")
    assert time.monotonic() - started < 5


@pytest.mark.parametrize(
    ("read", "error"), [(read_file, ConfigError), (read_protocol, ConfigError), (read_query_file, DataError)]
)
@pytest.mark.parametrize("text", [f"a = {DEEP}", f"a = {LONG}", f"[[query]]\nobjects = [{LONG}]\n"])
def test_toml_nested_or_numbered_beyond_reason_is_refused(
    tmp_path: Path, read: Callable[[Path], object], error: type[Su3dError], text: str
) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(error, match=r"a\.toml"):
        read(tmp_path / "a.toml")


@pytest.mark.parametrize("text", [DEEP, LONG])
def test_an_assignment_beyond_reason_is_text(text: str) -> None:
    assert parse_value(text) == text


@pytest.mark.parametrize("text", [DEEP, '{"a":' * 50_000, f'{{"a": {LONG}}}'])
def test_a_record_nested_or_numbered_beyond_reason_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(StoreError, match=r"run\.json: not readable as JSON"):
        read_json(tmp_path / "run.json")


def test_a_name_that_no_file_can_have_is_no_file(tmp_path: Path) -> None:
    assert not is_file(tmp_path / ("a" * 20_000))
    with pytest.raises(StoreError, match=r"holds no run\.json"):
        read_run(tmp_path / ("a" * 20_000))


@pytest.mark.parametrize(
    "content", [b"total_ms\n0b1\n", b"total_ms\n\xff\n", b"other\n1\n", b"a,total_ms\n1\n", b"total_ms\nnan\n", b""]
)
def test_a_damaged_table_of_times_is_left_out_of_the_estimate(tmp_path: Path, content: bytes) -> None:
    for name, table in (("a", b"total_ms\n4\n8\n"), ("b", content)):
        job = tmp_path / name / "scenes/rooms.x/opensu3d"
        job.mkdir(parents=True)
        (job / "updates.csv").write_bytes(table)
    assert recent_update_s(tmp_path, "opensu3d") == pytest.approx(0.006)


def test_what_an_error_quotes_can_be_shown_on_a_terminal() -> None:
    text = str(DataError("a.ply:\x1b[31m 'propert\0' \u202e\n is not PLY" + "x" * 5000))
    assert text.startswith(r"a.ply:\x1b[31m 'propert\x00' \u202e is not PLYxxx") and text.isprintable()
    assert len(text) == MOST_CHARACTERS


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["methods", "show", "opensu3d", ""], "su3d-bench: methods show: unknown argument ''"),
        (["report", "a\"b'c"], "su3d-bench: report: unknown"),
        (["sheets", "make", "--kind", "'", "--out", "x", "y"], "su3d-bench: sheets make: unknown --kind"),
        (["\x1b[31m"], r"su3d-bench: unknown verb '\x1b[31m'"),
    ],
)
def test_odd_words_are_answered_in_one_line(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith(line) and said.count("\n") == 1 and said.rstrip("\n").isprintable()


def test_a_paper_that_links_to_itself_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "paper.tex").symlink_to("paper.tex")
    with pytest.raises(ConfigError, match=r"paper\.tex: cannot be read"):
        check_paper(tmp_path / "paper.tex")


def test_results_under_a_protocol_that_the_record_does_not_name_stand_in_no_ranking(tmp_path: Path) -> None:
    run = copied_run(tmp_path)
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, "protocols": record["protocols"][:1]}))
    missing = record["protocols"][1]["name"]
    assert any("none of those that run.json names" in one.reason for one in leaderboard(run.parent).refused)
    with pytest.raises(StoreError, match=f"run\\.json does not name the protocol '{missing}'"):
        read_run(run).rules(missing)


def test_a_list_of_scenes_that_are_no_names_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"scenes": [1]}))
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(StoreError, match=r"run\.json"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("indices", np.zeros(3, "S4")),
        ("points", np.zeros(9, np.float32)),
        ("indptr", np.zeros(0, np.int64)),
        ("scores", np.zeros(1, np.complex64)),
    ],
)
def test_a_prediction_with_a_field_of_another_kind_is_refused(tmp_path: Path, name: str, array: NDArray[Any]) -> None:
    file = tmp_path / "prediction.npz"
    arrays = {"kind": np.array("Instances"), "points": np.zeros((3, 3), np.float32), name: array}
    np.savez(file, **arrays)  # type: ignore[arg-type]
    with pytest.raises(PredictionError, match=rf"prediction.npz: '{name}' is an array of shape"):
        read_prediction(file)


@pytest.mark.parametrize("name", ["done.json", "counts.npz"])
def test_an_empty_file_of_a_scene_ends_no_report_on_times(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copied_run(tmp_path)
    (run / "scenes" / "painted.a" / "collector" / name).write_bytes(b"")
    assert main(["report", "timing", str(run)]) == 0
    assert "collector" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("n_missed", np.zeros((66, 10), "M8[ns]")),
        ("n_truth", np.zeros(65, np.int64)),
        ("class_index", np.full(30, 66, np.int32)),
        ("threshold_index", np.full(30, -1, np.int32)),
        ("score", np.full(30, np.nan)),
    ],
)
def test_counts_of_another_kind_shape_or_range_are_damaged(tmp_path: Path, name: str, array: NDArray[Any]) -> None:
    file = copied_run(tmp_path) / "scenes" / "painted.a" / "collector" / "counts.npz"
    arrays = read_arrays(file) | {f"rooms-instance/{name}": array}
    np.savez(file, **arrays)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=rf"counts: '{name}'"):
        unpack_scores(file.read_bytes())


def test_counts_of_other_classes_than_the_rules_are_not_combined(tmp_path: Path) -> None:
    file = copied_run(tmp_path) / "scenes" / "painted.a" / "collector" / "counts.npz"
    scores = unpack_scores(file.read_bytes())
    rules = load_protocol("rooms-semantic")
    fewer = rules.model_copy(update={"classes": rules.classes[:-1]})
    with pytest.raises(DataError, match="painted/a: was scored with 69 classes, rooms-semantic has 68 here"):
        combine(fewer, {"painted/a": scores["rooms-semantic"]})
