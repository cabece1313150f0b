"""Pickles of other programs are read as data: nothing in them runs, and no file makes the reader hold too much."""

from __future__ import annotations

import gzip
import os
import pickle
import struct
import subprocess
from collections import OrderedDict, defaultdict
from pathlib import Path, PosixPath
from typing import Any

import numpy as np
import pytest
from damage import assert_same, traced

from su3d_bench.core.errors import PredictionError
from su3d_bench.formats import pickles
from su3d_bench.formats.pickles import Opaque, Skipped, read_pickle_file

PROTOCOLS = range(2, 6)


def read(folder: Path, content: bytes, **options: Any) -> Any:
    (folder / "map.pkl").write_bytes(content)
    return read_pickle_file(folder / "map.pkl", **options)


def refused(folder: Path, content: bytes) -> str:
    with pytest.raises(PredictionError) as caught:
        read(folder, content)
    message = str(caught.value)
    assert message.startswith(str(folder)) and message.isprintable() and len(message) < 500
    return message


def a_map(n: int = 3) -> dict[str, Any]:
    """A map as ConceptGraphs pickles it, small."""
    rng = np.random.default_rng(0)
    one = {
        "pcd_np": rng.random((n, 3)),
        "clip_ft": rng.random(4).astype(np.float32),
        "mask": [rng.random((64, 80)) < 0.5 for _ in range(2)],
        "conf": [np.float32(0.5), 0.25],
    }
    return {"objects": [one], "bg_objects": None, "class_names": ["chair"], "class_colors": {"0": [0.1, 0.2, 0.3]}}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_plain_values_arrays_and_scalars_come_back(tmp_path: Path, protocol: int) -> None:
    kinds = ("?", "u1", "i2", "<i4", ">i4", "u8", "f2", "f4", ">f8", "U7", "S3")
    value = {
        "numbers": [0, -1, 255, 256, 65536, -(1 << 31), 1 << 40, 1 << 70, 0.5, -1e300, True, False, None],
        "texts": ("", "é\n\u4e2d\U0001f600", b"", b"\x00\xff", "x" * 300),
        "nested": [[[()]], {}, {1: {"a": (1,)}}, {b"k": None}, list(range(2000))],
        "arrays": {kind: np.arange(6).reshape(2, 3).astype(kind) for kind in kinds},
        "more": [np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.zeros((0, 5), np.float16), np.array(3.5)],
        "scalars": [np.float32(0.1), np.int64(-5), np.bool_(True), np.uint8(200)],
    }
    content = pickle.dumps(value, protocol)
    assert_same(read(tmp_path, content), value)
    assert_same(read(tmp_path, content.replace(b"numpy._core.", b"numpy.core.")) if protocol == 2 else value, value)
    array, names = np.arange(4), ["a"]
    shared = read(tmp_path, pickle.dumps([array, array, names, names], protocol))
    assert shared[0] is shared[1] and shared[2] is shared[3]
    special = [OrderedDict(a=1), defaultdict(list, {1: [2]}), PosixPath("/etc/passwd")]
    ordered, default, path = read(tmp_path, pickle.dumps(special, protocol))
    assert (ordered, default) == ({"a": 1}, {1: [2]}) and type(path) is Opaque and not vars(path)


def test_settings_become_one_inert_place_and_gzip_is_unpacked(tmp_path: Path) -> None:
    tree = b"\x80\x04comegaconf.dictconfig\nDictConfig\n)\x81}(X\x01\x00\x00\x00acomegaconf.base\nMetadata\n)\x81ub."
    assert type(read(tmp_path, tree)) is Opaque
    for content in (pickle.dumps(a_map()), gzip.compress(pickle.dumps(a_map()))):
        assert_same(read(tmp_path, content), a_map())


@pytest.mark.parametrize("protocol", [4, 5])
def test_payloads_below_a_key_to_forget_are_not_kept(tmp_path: Path, protocol: int) -> None:
    masks = [np.random.default_rng(k).random((500, 1000)) < 0.5 for k in range(5)]
    one = {"pcd": np.ones((1000, 3)), "mask": masks, "colours": np.ones(9000), "after": np.ones(2000)}
    content = pickle.dumps({"objects": [one]}, protocol)
    with traced(1_300_000):
        found = read(tmp_path, content, forget=("mask", "colours"))["objects"][0]
    assert [type(mask) for mask in (*found["mask"], found["colours"])] == [Skipped] * 6
    assert found["pcd"].shape == (1000, 3) and found["after"].shape == (2000,)


class Call:
    """Pickles as a call of ``function``."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.function, self.args = function, args

    def __reduce__(self) -> Any:
        return self.function, self.args


@pytest.mark.parametrize(
    "function", [os.system, eval, exec, getattr, open, subprocess.Popen, np.load, os.unlink, bytearray, range, map]
)
def test_a_call_of_anything_else_is_refused_by_name_and_not_made(tmp_path: Path, function: Any) -> None:
    victim = tmp_path / "victim"
    victim.write_text("here")
    argument = f"rm {victim}" if function in {os.system, eval, exec} else str(victim)
    for protocol in PROTOCOLS:
        message = refused(tmp_path, pickle.dumps({"objects": [Call(function, argument)]}, protocol))
        assert "which is no plain data" in message and (protocol < 4 or f".{function.__name__}, " in message)
    assert victim.read_text() == "here"


def short(text: bytes) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text


DTYPE = b"cnumpy\ndtype\n(\x8c\x02f4K\x00K\x01tR(K\x03\x8c\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85C\x01btR"
HUGE = b"\x8a\x06" + (10**12).to_bytes(6, "little")
ENCODE = b"c_codecs\nencode\n"
FAULTS = {
    "empty": b"",
    "no value": b".",
    "empty stack": b"R.",
    "instance": b"ios\nsystem\n.",
    "reference": b"K\x01Q.",
    "long bytes": b"\x8e" + b"\xff" * 8 + b".",
    "no text": b"X\x02\x00\x00\x00\xff\xff.",
    "list as key": b"}]K\x01s.",
    "tuple as key": b"}" + b"N" + b"2\x86" * 3 + b"K\x01s.",
    "crafted key": b"}\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x1fK\x01s.",
    "items set of a list": b"]K\x00K\x02s.",
    "state of a number": b"K\x01}b.",
    "call of a type": b"cbuiltins\nlist\n)R.",
    "escape": b"cos\n\x1b[31m\nsystem\n.",
    "larger array": ARRAY + b"(K\x01(" + HUGE + b"t" + DTYPE + b"\x89C\x04aaaatb.",
    "sizes beyond NumPy": ARRAY + b"(K\x01(K\x00" + HUGE * 7 + b"t" + DTYPE + b"\x89C\x00tb.",
    "type of shapes": b"cnumpy\ndtype\n(" + short(b"(9,)f4") + b"tR(K\x03\x8c\x01<NNNtb.",
    "another encoding": ENCODE + short(b"a") + short(b"rot13") + b"\x86R.",
    "character beyond Unicode": ARRAY
    + b"(K\x01(K\x01t"
    + DTYPE.replace(b"f4", b"U1")
    + b"\x89C\x04\xff\xff\xff\xfftb.",
    "foreign array": b"cnumpy.core.multiarray\n_reconstruct\n(cbuiltins\nlist\nK\x00\x85C\x01btR.",
    "steps without end": b"]" * 30_000,
    "text made bytes again and again": b"X" + struct.pack("<I", 1 << 20) + b"a" * (1 << 20) + b"\x940" + ENCODE
    + b"\x940" + b"(" + b"h\x01h\x00\x8c\x06latin1\x86R" * 200 + b"t.",
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_of_a_pickle_is_one_line(tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "FREE_STEPS", 20_000)
    with traced(400 << 20):
        refused(tmp_path, FAULTS[fault])


@pytest.mark.parametrize(
    "content",
    [
        b"]" * 200_000 + b"a" * 199_999 + b".",  # lists in lists
        b"N" + b"\x85" * 200_000 + b".",  # tuples in tuples
        b"]\x94" + b"(" + b"h\x00" * 100_000 + b"e.",  # a list that holds itself
        b"]" + b"r\xff\xff\xff\xff" + b".",  # remembered at place 4 billion
    ],
)
def test_odd_pickles_cost_no_more_than_their_bytes(tmp_path: Path, content: bytes) -> None:
    with traced(300 * len(content) + 10_000_000):
        read(tmp_path, content)


def test_a_gzip_bomb_stops_at_the_bound(tmp_path: Path) -> None:
    zeros = b"\x8e" + struct.pack("<Q", 256 << 20) + bytes(256 << 20) + b"."
    content = gzip.compress(zeros, 1)
    with traced(16 << 20):
        assert "unpacks to more than" in refused(tmp_path, content)
    with pytest.raises(PredictionError, match="cannot be read"):
        read_pickle_file(tmp_path)
