from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, StoreError
from su3d_bench.core.files.atomic import Scratch, npz_bytes, read_json, read_npz, write_bytes, write_json, write_npz
from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.store.predictions import read_prediction, write_prediction
from su3d_bench.store.run_folder import JobFolder, RunFolder

KEY = {"method": "collector", "stride": "40", "data": "abc"}


def small_map() -> Instances:
    return Instances.of(
        np.arange(12, dtype=np.float32).reshape(4, 3),
        [[0, 1], [3]],
        [1.0, 0.5],
        np.ones((2, 5), np.float32),
        names=("chair", "plant ü"),
        captions=("a chair", ""),
        views=[[(0, 0)], []],
        ids=[4, 9],
    )


def sealed_job(tmp_path: Path) -> JobFolder:
    job = RunFolder(tmp_path).job("rooms/living0", "collector")
    job.prepare()
    write_bytes(job.prediction, b"prediction")
    write_bytes(job.updates, b"update\n")
    job.mark_complete("predict", KEY, [job.prediction, job.updates])
    return job


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.dictionaries(
        st.sampled_from(["points", "names", "indptr"]),
        st.sampled_from(["<f4", "<i8", "|b1", "<U3"]).flatmap(
            lambda name: hnp.arrays(np.dtype(name), hnp.array_shapes(min_dims=0))
        ),
    )
)
def test_arrays_come_back_as_they_were_and_the_bytes_depend_on_them_alone(arrays: dict[str, NDArray[Any]]) -> None:
    content = npz_bytes(arrays)
    assert content == npz_bytes({name: array.copy() for name, array in arrays.items()})
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        assert archive.files == list(arrays)
        for name, array in arrays.items():
            assert archive[name].shape == array.shape
            np.testing.assert_array_equal(archive[name], array)


@pytest.mark.parametrize(
    "prediction",
    [
        small_map(),
        Partition(np.zeros((3, 3), np.float32), np.array([0, -1, 0], np.int32), np.ones((1, 4), np.float32)),
        DenseFeatures(np.zeros((3, 3), np.float32), np.ones((3, 4), np.float16)),
    ],
    ids=lambda prediction: type(prediction).__name__,
)
def test_a_prediction_comes_back_as_it_was(tmp_path: Path, prediction: Instances | Partition | DenseFeatures) -> None:
    write_prediction(tmp_path / "prediction.npz", prediction)
    again = read_prediction(tmp_path / "prediction.npz")
    assert type(again) is type(prediction)
    for name in prediction.__dataclass_fields__:
        before, after = getattr(prediction, name), getattr(again, name)
        assert isinstance(after, type(before))
        np.testing.assert_array_equal(before, after)
        assert getattr(before, "dtype", None) == getattr(after, "dtype", None)


def test_a_file_that_is_no_prediction_is_refused(tmp_path: Path) -> None:
    write_npz(tmp_path / "other.npz", {"points": np.zeros(3)})
    with pytest.raises(PredictionError, match=r"other.npz: holds no 'kind' out of Instances, Partition, DenseFeatures"):
        read_prediction(tmp_path / "other.npz")
    write_npz(tmp_path / "short.npz", {"kind": np.array("Partition"), "points": np.zeros((0, 3), np.float32)})
    with pytest.raises(PredictionError, match=r"short.npz: lacks 'instance'"):
        read_prediction(tmp_path / "short.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and no more", b"text", npz_bytes({"x": np.zeros(100)})[:300]])
def test_a_damaged_archive_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(StoreError, match=r"x.npz: not a readable .npz file"):
        read_npz(tmp_path / "x.npz")


def test_a_step_is_done_under_its_key_only(tmp_path: Path) -> None:
    job = sealed_job(tmp_path)
    assert job.is_done("predict", KEY)
    assert not job.is_done("score", KEY)
    assert not job.is_done("predict", KEY | {"stride": "10"})
    assert job.changed_field("predict", KEY) is None
    assert job.changed_field("predict", KEY | {"stride": "10"}) == "stride was 40, now 10"
    assert job.changed_field("predict", KEY | {"limit": "3"}) == "limit was not set, now 3"
    assert job.changed_field("predict", {"method": "collector", "stride": "40"}) == "data was abc, now not set"
    assert job.changed_field("predict", {"method": "collector", "stride": "40"}, known_later=["data"]) is None


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b'{"schema": 1}', b'{"schema": 1, "steps": {"predict": 3}}', None]
)
def test_a_damaged_seal_means_that_the_step_runs_anew(tmp_path: Path, content: bytes | None) -> None:
    job = sealed_job(tmp_path)
    job.done.unlink() if content is None else job.done.write_bytes(content)
    assert not job.is_done("predict", KEY)
    assert job.changed_field("predict", KEY) is None


@pytest.mark.parametrize("damage", ["truncate", "flip", "remove"])
def test_a_damaged_file_means_that_the_step_runs_anew(tmp_path: Path, damage: str) -> None:
    job = sealed_job(tmp_path)
    if damage == "truncate":
        job.prediction.write_bytes(b"predict")
    elif damage == "flip":
        job.prediction.write_bytes(b"prediction"[::-1])
    else:
        job.prediction.unlink()
    assert not job.is_done("predict", KEY)


def test_predicting_anew_breaks_the_seal_of_the_score(tmp_path: Path) -> None:
    job = sealed_job(tmp_path)
    write_bytes(job.counts, b"counts")
    job.mark_complete("score", {"protocol": "1"}, [job.counts], {"unscored": {"rooms-semantic": "no truth"}})
    assert job.is_done("score", {"protocol": "1"})
    assert job.remarks("score") == {"unscored": {"rooms-semantic": "no truth"}}
    job.mark_complete("predict", KEY, [job.prediction])
    assert not job.is_done("score", {"protocol": "1"})


@pytest.mark.parametrize(
    ("code", "reason"),
    [(errno.ENOSPC, "the disk is full"), (errno.EROFS, "the folder is read-only"), (errno.EIO, "Input/output error")],
)
def test_a_failed_write_is_one_line_and_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, reason: str
) -> None:
    path = tmp_path / "metrics.json"
    write_json(path, {"old": 1})

    def fail(descriptor: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(StoreError, match=f"cannot write {path}: {reason}"):
        write_json(path, {"new": 2})
    assert read_json(path) == {"old": 1}
    assert [child.name for child in tmp_path.iterdir()] == ["metrics.json"]


def test_two_runs_on_one_folder_are_refused_until_the_first_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from su3d_bench.store.run_folder import RunFolder\n"
        "with RunFolder(Path(sys.argv[1])).locked():\n    print('locked', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdin=PIPE, stdout=PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "locked\n"
        with pytest.raises(StoreError, match="another run is writing here; wait for it"), RunFolder(tmp_path).locked():
            pass
        other.kill()
        other.wait()
    with RunFolder(tmp_path).locked():
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("most_in_memory_bytes", [1 << 20, 1])
def test_rows_come_out_as_they_were_put_in(most_in_memory_bytes: int) -> None:
    scratch = Scratch(most_in_memory_bytes)
    generator = np.random.default_rng(0)
    arrays: list[NDArray[Any]] = [
        generator.normal(size=(5, 7)),
        np.arange(9, dtype=np.int32),
        np.empty((0, 3)),
        np.arange(12.0)[::2],
    ]
    stored = [scratch.put(array) for array in arrays]
    for array, one in zip(arrays, stored, strict=True):
        everything = one.rows(0, len(array))
        assert everything.dtype == array.dtype
        np.testing.assert_array_equal(everything, array)
    np.testing.assert_array_equal(stored[0].rows(2, 4), arrays[0][2:4])
    with pytest.raises(IndexError, match="rows 4 to 6 of 5"):
        stored[0].rows(4, 6)
    scratch.close()


def _open_files(folder: Path) -> list[str]:
    """This process's open files that lay in ``folder``, nameless ones too."""
    links = (os.path.realpath(link) for link in Path("/proc/self/fd").iterdir())
    return [link for link in links if link.startswith(str(folder))]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are listed on Linux alone")
def test_what_is_much_lies_on_disk_under_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    scratch = Scratch(1000)
    scratch.put(np.zeros(100))
    assert list(_open_files(tmp_path)) == []
    scratch.put(np.zeros(100))
    assert len(_open_files(tmp_path)) == 1
    assert list(tmp_path.iterdir()) == []
    scratch.close()
