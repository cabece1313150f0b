"""Pickles of other programs are read as data: nothing in them runs, and no file makes the reader hold too much."""

from __future__ import annotations

import gzip
import os
import pickle
import struct
import subprocess
import tracemalloc
from collections import OrderedDict, defaultdict
from pathlib import Path, PosixPath
from typing import Any

import numpy as np
import pytest
from damage import damages, outcomes, truncations
from hypothesis import given, settings
from hypothesis import strategies as st
from same_values import assert_same

from su3d_bench.core.errors import PredictionError
from su3d_bench.formats import pickles
from su3d_bench.formats.pickles import NAMES, Forgotten, Inert, read_pickle_file
from su3d_bench.formats.torch_files import TORCH_NAMES

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
    assert (ordered, default) == ({"a": 1}, {1: [2]}) and type(path) is Inert and not vars(path)


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(1 << 200), 1 << 200)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.integers(-9, 9), inner) | st.tuples(inner, inner),
    max_leaves=20,
)


@settings(max_examples=50, deadline=None)
@given(value=PLAIN, protocol=st.sampled_from(PROTOCOLS))
def test_any_plain_value_round_trips(tmp_path_factory: pytest.TempPathFactory, value: object, protocol: int) -> None:
    assert_same(read(tmp_path_factory.getbasetemp(), pickle.dumps(value, protocol)), value)


def test_settings_become_one_inert_place_and_gzip_is_unpacked(tmp_path: Path) -> None:
    tree = b"\x80\x04comegaconf.dictconfig\nDictConfig\n)\x81}(X\x01\x00\x00\x00acomegaconf.base\nMetadata\n)\x81ub."
    assert type(read(tmp_path, tree)) is Inert
    for content in (pickle.dumps(a_map()), gzip.compress(pickle.dumps(a_map()))):
        assert_same(read(tmp_path, content), a_map())


@pytest.mark.parametrize("protocol", [4, 5])
def test_payloads_below_a_key_to_forget_are_not_kept(tmp_path: Path, protocol: int) -> None:
    masks = [np.random.default_rng(k).random((500, 1000)) < 0.5 for k in range(5)]
    one = {"pcd": np.ones((1000, 3)), "mask": masks, "colours": np.ones(9000), "after": np.ones(2000)}
    content = pickle.dumps({"objects": [one]}, protocol)
    tracemalloc.start()
    try:
        found = read(tmp_path, content, forget=("mask", "colours"))["objects"][0]
        assert tracemalloc.get_traced_memory()[1] < 1_300_000
    finally:
        tracemalloc.stop()
    assert [type(mask) for mask in (*found["mask"], found["colours"])] == [Forgotten] * 6
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
    "newer protocol": b"\x80\x06N.",
    "no value": b".",
    "no mark": b"t.",
    "empty stack": b"R.",
    "never remembered": b"h\x05.",
    "instance": b"ios\nsystem\n.",
    "object": b"(o.",
    "extension": b"\x82\x01.",
    "buffer": b"\x97.",
    "text of a reference": b"P12\n.",
    "reference": b"K\x01Q.",
    "long integer": b"\x8b\xff\xff\xff\x7f.",
    "long bytes": b"\x8e" + b"\xff" * 8 + b".",
    "long array of bytes": b"\x96" + struct.pack("<Q", 10**12) + b".",
    "no text": b"X\x02\x00\x00\x00\xff\xff.",
    "list as key": b"}]K\x01s.",
    "float as key": b"}G?\xf0\x00\x00\x00\x00\x00\x00K\x01s.",
    "tuple as key": b"}" + b"N" + b"2\x86" * 3 + b"K\x01s.",
    "crafted key": b"}\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x1fK\x01s.",
    "odd items": b"}(K\x01u.",
    "items of a number": b"K\x01K\x02a.",
    "items set of a list": b"]K\x00K\x02s.",
    "state of a number": b"K\x01}b.",
    "call of a type": b"cbuiltins\nlist\n)R.",
    "object of a type": b"cbuiltins\nlist\n)\x81.",
    "escape": b"cos\n\x1b[31m\nsystem\n.",
    "names that are none": b"K\x01K\x02\x93.",
    "larger array": ARRAY + b"(K\x01(" + HUGE + b"t" + DTYPE + b"\x89C\x04aaaatb.",
    "negative size": ARRAY + b"(K\x01(J\xff\xff\xff\xfft" + DTYPE + b"\x89C\x00tb.",
    "no type": ARRAY + b"(K\x01(K\x01tK\x01\x89C\x00tb.",
    "sizes beyond NumPy": ARRAY + b"(K\x01(K\x00" + HUGE * 7 + b"t" + DTYPE + b"\x89C\x00tb.",
    "type of shapes": b"cnumpy\ndtype\n(" + short(b"(9,)f4") + b"tR(K\x03\x8c\x01<NNNtb.",
    "type of fields": b"cnumpy\ndtype\n(" + short(b"f4") + b"tR(K\x03\x8c\x01<K\x01NNNNNtb.",
    "wrong byte order": b"cnumpy\ndtype\n(" + short(b"f4") + b"tR(K\x03\x8c\x01xNNNNNNtb.",
    "another encoding": ENCODE + short(b"a") + short(b"rot13") + b"\x86R.",
    "bytes beyond 255": ENCODE + short("\u4e2d".encode()) + short(b"latin1") + b"\x86R.",
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
    tracemalloc.start()
    try:
        refused(tmp_path, FAULTS[fault])
        assert tracemalloc.get_traced_memory()[1] < 400 << 20
    finally:
        tracemalloc.stop()


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
    tracemalloc.start()
    try:
        read(tmp_path, content)
        assert tracemalloc.get_traced_memory()[1] < 300 * len(content) + 10_000_000
    finally:
        tracemalloc.stop()


def test_a_gzip_bomb_stops_at_the_bound(tmp_path: Path) -> None:
    zeros = b"\x8e" + struct.pack("<Q", 256 << 20) + bytes(256 << 20) + b"."
    content = gzip.compress(zeros, 1)
    tracemalloc.start()
    try:
        assert "unpacks to more than" in refused(tmp_path, content)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()
    with pytest.raises(PredictionError, match="cannot be read"):
        read_pickle_file(tmp_path)


@pytest.mark.parametrize("pack", [bytes, lambda content: gzip.compress(content, mtime=0)], ids=["plain", "gzipped"])
def test_cut_and_damaged_pickles_are_read_or_refused_but_nothing_else(tmp_path: Path, pack: Any) -> None:
    content = pack(pickle.dumps(a_map() | {"more": OrderedDict(a=PosixPath("/a"))}, 4))

    def again(damaged: bytes) -> object:
        return read(tmp_path, damaged)

    cuts = list(truncations(content))[:: 1 + len(content) // 300]
    assert outcomes(again, iter(cuts), must_name="map.pkl", refusal=PredictionError)[0] == 0
    outcomes(again, damages(content), must_name="map.pkl", refusal=PredictionError)


VALUES = (
    *(short(text) for text in (b"latin1", b"<", b"f4", b"U1", b"F", b"storage", b"0", b"torch.sparse_coo")),
    *(b"N", b"\x88", b")", b"]", b"}", b"K\x00", b"K\x01", HUGE, b"J\xff\xff\xff\xff", b"G" + bytes(8), DTYPE),
    *(b"C\x04aaaa", ARRAY + b"(K\x01(K\x01t" + DTYPE + b"\x89C\x04aaaatb", b"]\x94h\x00a", b"N" + b"2\x86" * 90),
)
STEPS = st.sampled_from(VALUES) | st.sampled_from([bytes([code]) for code in b"(0R\x81bt\x85\x86\x87aesuQ"])
CALLS = st.builds(
    lambda name, args, state: name + b"(" + b"".join(args) + b"tR" + (b"(" + b"".join(state) + b"tb" if state else b""),
    st.sampled_from([f"c{full.rpartition('.')[0]}\n{full.rpartition('.')[2]}\n".encode() for full in TORCH_NAMES]),
    st.lists(st.sampled_from(VALUES), max_size=7),
    st.lists(st.sampled_from(VALUES), max_size=6),
)


@settings(max_examples=300, deadline=None)
@given(steps=st.lists(STEPS | CALLS, min_size=1, max_size=8))
def test_programs_of_valid_parts_are_read_or_refused_but_nothing_else(steps: list[bytes]) -> None:
    import io

    from su3d_bench.formats.pickles import unpickled
    from su3d_bench.formats.torch_files import Storages

    content = b"\x80\x04(" + b"".join(steps) + b"t."
    for names, find in ((NAMES, None), (TORCH_NAMES, Storages(99).find)):
        try:
            unpickled(io.BytesIO(content), len(content), len(content), "here", names, find)
        except PredictionError:
            continue
