"""Damage for every reader in the inventory; ``benchmarks/reliability/fuzz.py`` is the long mode of the same table."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import pytest
from fuzz_mutations import MOST_BYTES, _json, _text, mutated
from fuzz_targets import TARGETS
from fuzzing import ENDLESS, MOST_ADDRESSES_BYTES, BadMessage, Input, Read, Sample, Target, every_one_of
from memory import bounded_addresses

from su3d_bench.core.errors import DataError

N_INPUTS = 2_400
WEIGHT = sum(one.weight for one in TARGETS.values())


def faults_of(target: Target, folder: Path, n: int) -> list[str | None]:
    sample = Sample(target, folder)
    with bounded_addresses(MOST_ADDRESSES_BYTES):
        sample.read()  # the sample itself is fine
        return [sample.meet(sample.input(0, index)).fault for index in range(n)]


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_meets_damage_with_nothing_but_typed_errors_soon_and_in_little_memory(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    n = math.ceil(N_INPUTS * TARGETS[name].weight / WEIGHT)
    faults = [(index, fault) for index, fault in enumerate(faults_of(TARGETS[name], tmp_path / "sample", n)) if fault]
    assert not faults, f"python benchmarks fuzz --only '{name}' --first {faults[0][0]} --inputs 1: {faults[0][1]}"


@pytest.mark.parametrize("name", TARGETS)
def test_no_reader_waits_for_a_pipe_or_reads_a_device(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    sample = Sample(TARGETS[name], tmp_path / "sample")
    with bounded_addresses(MOST_ADDRESSES_BYTES):
        sample.read()
        files = one_of_each_kind(sample.whole)
        for k, file in enumerate(files):
            for shape in [*ENDLESS][k % 2 :: 2] if len(files) > 1 else ENDLESS:
                assert sample.meet(Input(0, file, None, shape)).fault is None, f"{file} is a {shape}"


def one_of_each_kind(files: Iterable[str]) -> list[str]:
    """Of files whose names differ in digits alone, the first; at most 12. Where they are several, they take turns."""
    kinds = {re.sub(r"\d+", "0", file): file for file in sorted(files, reverse=True)}
    return sorted(kinds.values())[:12]


# What the harness itself finds


def number_reader(folder: Path) -> Read:
    """A reader with the faults that the harness is there to find, by what the file says."""
    path = folder / "n.txt"
    path.write_text("1")

    def read() -> object:
        text = path.read_bytes().decode("latin-1") if path.is_file() else ""
        if text == "loop":
            while True:
                pass
        if text == "memory":
            return len(b"x" * (400 << 20))
        if text == "address space":
            return bytearray(8 << 30)
        if text == "escape":
            raise BadMessage("x")
        if text != "1":
            raise DataError("n.txt: is no number")
        return int(text)

    return read


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("1", None),
        ("2", None),
        ("loop", "slow"),
        ("memory", "memory"),
        ("address space", "MemoryError"),
        ("escape", "Bad"),
    ],
)
def test_the_harness_finds_loops_memory_and_untyped_errors(
    text: str, fault: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text == "loop":
        monkeypatch.setattr("fuzzing.MOST_SECONDS", 0.2)
    sample = Sample(Target("numbers", number_reader, ("n.txt",)), tmp_path)
    with bounded_addresses(MOST_ADDRESSES_BYTES):
        found = sample.meet(Input(0, "n.txt", text.encode(), None)).fault
    assert found is None if fault is None else found is not None and found.startswith(fault)
    assert (tmp_path / "n.txt").read_text() == "1"


def test_the_first_refusal_of_several_questions_is_raised_and_all_are_asked() -> None:
    asked = []

    def refusing(k: int) -> None:
        asked.append(k)
        raise DataError(f"refusal {k}")

    with pytest.raises(DataError, match="refusal 0"):
        every_one_of(iter([partial(refusing, k) for k in range(3)]))
    assert asked == [0, 1, 2]


@pytest.mark.parametrize(
    "name", ["replica objects", "prediction openmask3d", "pickle map.pkl.gz", "image.png", "paper"]
)
def test_damage_is_the_same_for_a_seed_and_hardly_ever_none(name: str, tmp_path: Path) -> None:
    sample = Sample(TARGETS[name], tmp_path)
    first, again = ([sample.input(3, k).content for k in range(60)] for _ in range(2))
    assert first == again
    assert len(set(first)) > 45 and sum(one in sample.whole.values() for one in first) < 6


def test_damage_reaches_inside_archives_texts_and_numbers() -> None:
    rng = random.Random(0)
    copies = [mutated(b'{"a": [1, 2, {"b": "text"}]}', rng) for _ in range(400)]
    assert any(b"NaN" in one for one in copies) and any(b"null" in one for one in copies)
    assert any(one.startswith(b"[[[[") for one in copies) and b"" in copies


@pytest.mark.parametrize("change", [_text, _json])
def test_a_large_text_is_not_repeated_beyond_memory(change: Callable[[bytes, random.Random], bytes]) -> None:
    one_line = b'"' + b"x" * (MOST_BYTES // 2) + b'"'
    lengths = [len(change(one_line, random.Random(k))) for k in range(60)]
    assert 2 * MOST_BYTES < max(lengths) < 8 * MOST_BYTES
