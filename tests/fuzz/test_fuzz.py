"""Damage for every reader in the table; ``benchmarks/reliability/fuzz.py`` is the long mode of the same."""

from __future__ import annotations

import json
import math
import os
import random
from pathlib import Path

import pytest
from cli_calls import Declined, called
from fuzz_targets import TARGETS
from fuzz_words import ODD, drawn_words, verbs
from fuzzing import ENDLESS, MOST_ADDRESSES_BYTES, Input, Read, Sample, Target, alarm
from memory import bounded_addresses

from su3d_bench.core.errors import DataError

N_INPUTS = 1_000
N_VECTORS = int(os.environ.get("SU3D_FUZZ_EXAMPLES", "4"))  # of words behind each verb
WEIGHT = sum(one.weight for one in TARGETS.values())
# A verb whose work could begin with nothing more than its name ends with words that keep it from that.
HELD_BACK = {"run": ["--scenes", "replica/none", "--dry-run"], "ablate": ["--scenes", "replica/none", "--dry-run"]}
HELD_BACK |= {"questions": ["--scenes", "replica/none"], "make": ["--scenes", "none/none", "--out", "folder/out"]}


@pytest.fixture(autouse=True)
def _own_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("SU3D_DATA", "SU3D_CACHE", "SU3D_MODELS", "HF_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "data"))


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_meets_damage_with_nothing_but_typed_errors_soon_and_in_little_memory(
    name: str, tmp_path: Path
) -> None:
    """So it does where a pipe or a device stands in place of the file."""
    sample = Sample(TARGETS[name], tmp_path / "sample")
    with bounded_addresses(MOST_ADDRESSES_BYTES):
        sample.read()  # the sample itself is fine
        inputs = [sample.input(0, index) for index in range(math.ceil(N_INPUTS * TARGETS[name].weight / WEIGHT))]
        inputs += [Input(0, file, None, shape) for file, shape in zip(sorted(sample.whole), ENDLESS, strict=False)]
        faults = [(one.index, one.file, one.shape, fault) for one in inputs if (fault := sample.meet(one).fault)]
    assert not faults, f"python benchmarks fuzz --only '{name}' --first {faults[0][0]} --inputs 1: {faults[0]}"


@pytest.mark.parametrize("words", [words for words, _ in verbs()], ids=" ".join)
def test_any_words_behind_a_verb_are_done_or_declined_in_one_line(words: tuple[str, ...]) -> None:
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


def number_reader(folder: Path) -> Read:
    """A reader with the faults that the harness is there to find, by what the file says."""
    path = folder / "n.txt"
    path.write_text("1")

    def read() -> object:
        text = path.read_text()
        while text == "loop":
            pass
        if text == "memory":
            return len(b"x" * (400 << 20))
        if text == "address space":
            return bytearray(8 << 30)
        if text != "1":
            raise DataError("n.txt: is no number")
        return int(text)

    return read


@pytest.mark.parametrize(
    ("text", "fault"),
    [("1", None), ("2", None), ("loop", "slow"), ("memory", "memory"), ("address space", "MemoryError")],
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


def test_damage_is_the_same_for_a_seed_and_hardly_ever_none(tmp_path: Path) -> None:
    for name in ("prediction openmask3d", "file map.pkl.gz", "file a.png", "file q.toml"):
        sample = Sample(TARGETS[name], tmp_path / name)
        first, again = ([sample.input(3, k).content for k in range(60)] for _ in range(2))
        assert first == again
        assert len(set(first)) > 40 and sum(one in sample.whole.values() for one in first) < 10
