"""Runs a file reader on damaged samples: each is read or rejected in one line, quickly and in little memory."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from damage import peak_bytes, reset_peak
from mutations import mutated

from su3d_bench.core.errors import GroundTruthMissing, Su3dError

MAX_SECONDS = 20.0  # one read of a small file; generous, for a busy machine
MAX_GROWN_BYTES = 256 << 20  # how far the peak of resident memory may rise during a read
MAX_ADDRESSES_BYTES = 2 << 30  # how much address space a read may reserve
MAX_CHARACTERS = 1000  # of a message including file names
ENDLESS = {"pipe": "a pipe", "device": "a device"}  # one blocks, one is endless
SHAPES = ("missing", "folder", "loop", *ENDLESS)  # a missing file, or not a file
Read = Callable[[], object]
Make = Callable[[Path], Read]


@dataclass(frozen=True)
class Target:
    """A reader: ``make`` writes a valid sample into a folder and returns the reading call. ``files``: those to damage.

    ``weight``: its share of the inputs, less than 1 for slow readers.
    """

    name: str
    make: Make
    files: tuple[str, ...]
    weight: float = 1.0


@dataclass(frozen=True)
class Input:
    """Damage number ``index`` of a target: ``file`` gets ``content``, or becomes something else, by ``shape``."""

    index: int
    file: str
    content: bytes | None
    shape: str | None


@dataclass(frozen=True)
class Outcome:
    """``fault`` is None if the input was read (``is_read``) or properly rejected."""

    is_read: bool
    fault: str | None
    seconds: float
    grown_bytes: int


class TooSlow(BaseException):
    """Raised by the alarm; not an ``Exception``, so that no reader mistakes it for damage."""


class BadMessage(Exception):
    """An error of the right type whose message is not fit for a terminal."""


class Sample:
    """A valid sample of ``target`` in ``folder``, which must be empty or missing."""

    def __init__(self, target: Target, folder: Path) -> None:
        self.target, self.folder = target, folder
        folder.mkdir(parents=True, exist_ok=True)
        self.read = target.make(folder)
        found = {file for pattern in target.files for file in folder.glob(pattern) if file.is_file()}
        self.whole = {file.relative_to(folder).as_posix(): file.read_bytes() for file in sorted(found)}
        assert self.whole, f"{target.name}: {target.files} match no files"

    def input(self, seed: int, index: int) -> Input:
        """The damage of that number: the same on every machine."""
        rng = random.Random(f"{seed}/{self.target.name}/{index}")
        file = rng.choice(sorted(self.whole))
        if rng.random() < 0.01:
            return Input(index, file, None, rng.choice(SHAPES))
        return Input(index, file, mutated(self.whole[file], rng), None)

    def meet(self, one: Input) -> Outcome:
        """The reader's outcome on the damaged sample, which is restored afterwards."""
        path = self.folder / one.file
        self._put(path, one.content, one.shape)
        try:
            outcome = self._watched()
            if outcome.fault is not None and outcome.fault.startswith(("slow", "memory")):
                outcome = self._watched()  # first imports or a busy machine do not occur twice
            return outcome
        finally:
            self._put(path, self.whole[one.file], None)

    def _put(self, path: Path, content: bytes | None, shape: str | None) -> None:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        if shape == "folder":
            path.mkdir()
        elif shape == "loop":
            path.symlink_to(path.name)
        elif shape == "pipe":
            os.mkfifo(path)
        elif shape == "device":
            path.symlink_to("/dev/zero")
        elif content is not None:
            path.write_bytes(content)

    def _watched(self) -> Outcome:
        before = reset_peak()
        started = time.monotonic()
        is_read, fault = False, None
        try:
            with alarm(MAX_SECONDS), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.read()
            is_read = True
        except Su3dError as error:
            fault = fault_of_message(str(error))
        except TooSlow:
            fault = f"slow: more than {MAX_SECONDS:g} s"
        except Exception as error:  # noqa: BLE001 - what a reader must not raise
            fault = f"{type(error).__name__}: {error}"[:500]
        seconds = time.monotonic() - started
        grown = max(0, peak_bytes() - before)
        if fault is None and grown > MAX_GROWN_BYTES:
            fault = f"memory: grew by {grown >> 20} MiB"
        return Outcome(is_read and fault is None, fault, seconds, grown)


def every_one_of(asked: Iterator[Read]) -> None:
    """Call all of ``asked``, even after errors; the first rejection is raised at the end."""
    first: Su3dError | None = None
    for one in asked:
        try:
            one()
        except Su3dError as error:
            if (fault := fault_of_message(str(error))) is not None:
                raise BadMessage(fault) from error
            first = first or (None if isinstance(error, GroundTruthMissing) else error)  # no ground truth is no damage
    if first is not None:
        raise first


def fault_of_message(message: str) -> str | None:
    """Faults in the form of an error's message, if any."""
    odd = {c for c in message if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    if odd:
        return f"message: holds {sorted(map(ascii, odd))}: {message!r:.300}"
    if len(message) > MAX_CHARACTERS:
        return f"message: {len(message)} characters long: {message[:200]!r}"
    return None if message.strip() else "message: is empty"


@contextmanager
def alarm(seconds: float) -> Iterator[None]:
    """Raise ``TooSlow`` after ``seconds``, as soon as Python code runs."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
