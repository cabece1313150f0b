"""Damaged input for all readers in the table of targets; ``python benchmarks fuzz`` is the long version."""

from __future__ import annotations

import json
import os
import random
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_calls import Declined, called
from damage import bounded_addresses
from fuzz_targets import TARGETS, copied_run
from fuzz_words import ODD, drawn_words, verbs
from fuzzing import ENDLESS, MAX_ADDRESSES_BYTES, Input, Sample, alarm
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, StoreError
from su3d_bench.core.files.atomic import DAMAGE, read_arrays, read_json
from su3d_bench.metrics.scoring import unpack_scores
from su3d_bench.store.predictions import read_prediction

N_INPUTS = 10  # per reader, besides pipes and the like; python benchmarks fuzz uses many more
USUAL = (
    *("prediction scannet-text", "prediction openmask3d", "prediction conceptgraphs", "prediction hovsg"),
    *("prediction su3d-bench", "file ascii.ply", "file binary_compressed.pcd", "file a.png", "file a.npz"),
    *("file map.pkl.gz", "file q.toml", "dataset replica", "run", "answers ann.csv", "archive a.tar.gz"),
)
N_VECTORS = int(os.environ.get("SU3D_FUZZ_EXAMPLES", "2"))  # of random arguments per verb
# A verb that could start work with its name only gets arguments that prevent this.
HELD_BACK = {"run": ["--scenes", "replica/none", "--dry-run"], "ablate": ["--scenes", "replica/none", "--dry-run"]}
HELD_BACK |= {"questions": ["--scenes", "replica/none"], "make": ["--scenes", "none/none", "--out", "folder/out"]}


@pytest.fixture(autouse=True)
def _own_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("SU3D_DATA", "SU3D_CACHE", "SU3D_MODELS", "HF_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "data"))


@pytest.mark.parametrize(
    "name", [name if name in USUAL else pytest.param(name, marks=pytest.mark.proof) for name in TARGETS]
)
def test_reader_meets_damage_only_with_typed_errors_quickly_in_little_memory(name: str, tmp_path: Path) -> None:
    """This also applies to a pipe or device in place of the file."""
    sample = Sample(TARGETS[name], tmp_path / "sample")
    with bounded_addresses(MAX_ADDRESSES_BYTES):
        sample.read()  # the sample itself is fine
        inputs = [sample.input(0, index) for index in range(N_INPUTS)]
        inputs += [Input(0, file, None, shape) for file, shape in zip(sorted(sample.whole), ENDLESS, strict=False)]
        faults = [(one.index, one.file, one.shape, fault) for one in inputs if (fault := sample.meet(one).fault)]
    assert not faults, f"python benchmarks fuzz --only '{name}' --first {faults[0][0]} --inputs 1: {faults[0]}"


@pytest.mark.parametrize("words", [words for words, _ in verbs()], ids=" ".join)
def test_random_arguments_never_give_a_traceback(words: tuple[str, ...]) -> None:
    for name, text in (("a.toml", "[method.opensu3d]\ntop_m = 3\n"), ("a.json", json.dumps({"a": 1}))):
        Path(name).write_text(text)
    Path("a.csv").write_text("a,b\n1,2\n")
    Path("folder").mkdir()
    parser, rng = dict(verbs())[words], random.Random(" ".join(words))
    for _ in range(N_VECTORS):
        try:
            with alarm(60):
                called([*words, *drawn_words(parser, rng), *HELD_BACK.get(words[-1], [])])
        except Declined:
            continue
    with pytest.raises(Declined):
        called([rng.choice(ODD), rng.choice(ODD)])


DEEP, LONG = "[" * 100_000, "1" * 5000
NO_TEXT = np.array([0x3F800000], np.uint32).tobytes()  # a float's bits where a character should be


def npz(folder: Path, header: str, body: bytes = b"") -> Path:
    """An archive of one array described by ``header``."""
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
def test_array_headers_are_never_trusted(tmp_path: Path, header: str, body: bytes) -> None:
    path = npz(tmp_path, header, body)
    with pytest.raises(DAMAGE):
        read_arrays(path)
    with pytest.raises(StoreError, match=r"a\.npz: not a readable \.npz file"):
        read_prediction(path)


@pytest.mark.parametrize("text", [DEEP, '{"a":' * 50_000, f'{{"a": {LONG}}}'])
def test_record_nested_or_numbered_excessively_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(StoreError, match=r"run\.json: not readable as JSON"):
        read_json(tmp_path / "run.json")


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("indices", np.zeros(3, "S4")),
        ("points", np.zeros(9, np.float32)),
        ("indptr", np.zeros(0, np.int64)),
        ("scores", np.zeros(1, np.complex64)),
    ],
)
def test_prediction_with_a_field_of_another_kind_is_rejected(tmp_path: Path, name: str, array: NDArray[Any]) -> None:
    file = tmp_path / "prediction.npz"
    arrays = {"kind": np.array("Instances"), "points": np.zeros((3, 3), np.float32), name: array}
    np.savez(file, **arrays)  # type: ignore[arg-type]
    with pytest.raises(PredictionError, match=rf"prediction.npz: '{name}' is an array of shape"):
        read_prediction(file)


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
def test_counts_of_another_kind_shape_or_range_are_rejected(tmp_path: Path, name: str, array: NDArray[Any]) -> None:
    file = copied_run(tmp_path) / "scenes" / "painted.a" / "collector" / "counts.npz"
    arrays = read_arrays(file) | {f"rooms-instance/{name}": array}
    np.savez(file, **arrays)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=rf"counts: '{name}'"):
        unpack_scores(file.read_bytes())
