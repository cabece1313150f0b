"""Hostile and damaged predictions with their own points: nothing is run, nothing runs away, each is one typed error."""

from __future__ import annotations

import gzip
import os
import pickle
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_files import (
    FORMATS,
    a_map,
    an_object,
    write_map,
    write_small,
)
from damage import N_DAMAGES, damages, outcomes, truncations
from prediction_files import refused

from su3d_bench.core.errors import PredictionError
from su3d_bench.formats.pickles import pickle_machine, pickles
from su3d_bench.formats.pickles.pickle_constructors import CONSTRUCTORS
from su3d_bench.predictions.formats import READERS


class Bomb:
    """What a hostile map holds: a call, hidden in an object's state."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


def fire(*_: object) -> None:
    raise AssertionError("the pickle ran code")


CALLS: list[tuple[Any, ...]] = [
    (os.system, "touch {}"),
    (eval, "open('{}', 'w')"),
    (exec, "open('{}', 'w')"),
    (getattr, os, "system"),
    (__import__, "os"),
    (open, "{}", "w"),
    (fire,),
    (np.load, "{}"),
    (np.fromfile, "{}"),
    (pickle.loads, b"."),
    (map, fire, [1]),
    (type, "x", (), {}),
]


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize("place", ["cfg", "mask", "pcd_np", "class_names", "edges"])
@pytest.mark.parametrize("call", CALLS, ids=lambda call: getattr(call[0], "__name__", "call"))
def test_no_call_in_a_map_is_made(tmp_path: Path, call: tuple[Any, ...], place: str, protocol: int) -> None:
    proof = tmp_path / "proof"
    args = [one.format(proof) if isinstance(one, str) else one for one in call[1:]]
    if os in args:
        args = ["os", "system"]  # modules cannot be pickled
    value = a_map()
    holder = value if place in {"cfg", "class_names", "edges"} else value["objects"][0]
    holder[place] = Bomb(call[0], *args)
    path = write_map(tmp_path / "pcd_x.pkl.gz", value, protocol)
    assert "no plain data" in refused(path, "pcd_x", "conceptgraphs")
    assert not proof.exists()


@pytest.mark.parametrize("name", sorted(CONSTRUCTORS), ids=".".join)
def test_no_name_that_may_stand_in_a_map_makes_or_does_anything(tmp_path: Path, name: tuple[str, str]) -> None:
    """Each allowed name called with paths, commands and shapes, through every way in which a pickle can call."""
    proof = tmp_path / "proof"
    module, attribute = (part.encode() for part in name)
    reached = b"c" + module + b"\n" + attribute + b"\n"
    command = pickle.dumps(f"touch {proof}", 2)[2:-1]
    hostile = [
        b"(" + command + b"tR",
        b"(" + command + b"t\x81",
        b"(" + command + command + b"tR" + b"}" + command + command + b"sb",
        b")R(" + command * 4 + b"tb",
        b"(" + reached + command + b"tR",
        b"(c"
        + b"numpy\nndarray\n"
        + b"(K\x00t"
        + command
        + b"tR(K\x01(\x8a\x08"
        + b"\xff" * 7
        + b"\x3ftcnumpy\ndtype\n"
        + command
        + b"\x85R\x89"
        + command
        + b"tb",
    ]
    for ending in hostile:
        content = b"\x80\x02}X\x07\x00\x00\x00objects" + reached + ending + b"s."
        path = tmp_path / "pcd_x.pkl.gz"
        path.write_bytes(gzip.compress(content))
        with pytest.raises(PredictionError, match=r"pcd_x\.pkl\.gz"):
            READERS["conceptgraphs"].read(path, "pcd_x")
        assert not proof.exists()


def test_chains_of_calls_and_built_objects_end_the_reading(tmp_path: Path) -> None:
    chain: Any = Bomb(os.getcwd)
    for _ in range(50):
        chain = Bomb(list, [chain])
    path = write_map(tmp_path / "pcd_x.pkl.gz", {"objects": chain})
    refused(path, "pcd_x", "conceptgraphs")
    nested: Any = []
    for _ in range(400):
        nested = [nested]
    path = write_map(tmp_path / "pcd_x.pkl.gz", {"objects": nested})
    assert "object 0: is a list without 'pcd_np'" in refused(path, "pcd_x", "conceptgraphs")


def test_a_stream_that_inflates_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "MOST_INFLATED", 8 << 20)
    n = 64 << 20
    content = b"\x80\x04}\x8c\x07objects]\x8c\x04mask]\x8e" + struct.pack("<Q", n) + bytes(n) + b"aes."
    path = tmp_path / "pcd_x.pkl.gz"
    path.write_bytes(gzip.compress(content, 9))
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    try:
        assert "promises" in refused(path, "pcd_x", "conceptgraphs")
        monkeypatch.setattr(pickle_machine, "MOST_OPERATIONS", 100_000)
        path.write_bytes(gzip.compress(b"\x80\x04" + b"N0" * (16 << 20) + b".", 9))
        assert "more than 100000 operations" in refused(path, "pcd_x", "conceptgraphs")
        assert tracemalloc.get_traced_memory()[1] < 200 << 20
    finally:
        tracemalloc.stop()


# ---- damage


def damaged_files(folder: Path) -> list[Path]:
    unread = {"pc_colors.h5", "pc_confidences.h5"}
    return [file for file in sorted(folder.rglob("*")) if file.is_file() and file.name not in unread]


def reading(folder: Path, format: str, file: Path) -> Callable[[bytes], object]:
    def read_bytes(content: bytes) -> object:
        file.write_bytes(content)
        READERS[format].recognise(folder)
        return READERS[format].read(folder, "room0")

    return read_bytes


# Files of HDF5 have kilobytes of header; every tenth of their ends is enough.
@pytest.mark.parametrize("format", FORMATS)
def test_cut_files_are_refused(tmp_path: Path, format: str) -> None:
    folder = write_small(tmp_path, format)
    for file in damaged_files(folder):
        content = file.read_bytes()
        step = max(1, len(content) // 400)
        cuts = (one for k, one in enumerate(truncations(content)) if k % step == 0)
        n_read, n_refused = outcomes(reading(folder, format, file), cuts, must_name="room0", refusal=PredictionError)
        assert n_read == 0 and n_refused >= 100
        file.write_bytes(content)


@pytest.mark.parametrize("format", FORMATS)
def test_damaged_files_are_read_or_refused_but_nothing_else(tmp_path: Path, format: str) -> None:
    folder = write_small(tmp_path, format)
    for file in damaged_files(folder):
        content = file.read_bytes()
        read_bytes = reading(folder, format, file)
        n_read, n_refused = outcomes(read_bytes, damages(content), must_name="room0", refusal=PredictionError)
        assert n_read + n_refused == N_DAMAGES and n_refused > 0.05 * N_DAMAGES
        file.write_bytes(content)


def test_damage_inside_the_gzip_is_read_or_refused_but_nothing_else(tmp_path: Path) -> None:
    file = write_map(tmp_path / "room0/pcd_saves/full_pcd_x.pkl.gz", a_map(objects=[an_object(2, [0, 1], mask=[])]))
    content = gzip.decompress(file.read_bytes())
    read_bytes = reading(tmp_path, "conceptgraphs", file)
    copies = (gzip.compress(one, 1) for one in damages(content))
    n_read, n_refused = outcomes(read_bytes, copies, must_name="full_pcd_x.pkl.gz", refusal=PredictionError)
    assert n_read + n_refused == N_DAMAGES and n_refused > 0.1 * N_DAMAGES
