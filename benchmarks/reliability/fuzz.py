"""Damaged input for every file reader in fuzzing/fuzz_targets.py, in processes that may die.

    python benchmarks fuzz --inputs 100000 --seed 1 --json build/measured/fuzz.json

Inputs are distributed over the readers by weight; damage number k of a reader is the same on every machine, so that
``--only NAME --first K --inputs 1 --seed S`` reproduces a fault. A reader whose process dies (a crash in a native
library, an uninterruptible loop) counts as a fault like an untyped error; its input is saved below ``--save``.
``--minutes`` limits the total; unreached inputs are reported. Exit code 1 on a fault.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from folders import BENCHMARKS
from measured import write_measured

HANG_S = 120.0  # silence of a process: far beyond the alarm of one input
STARTS_S = 300.0  # until the first output: imports and the sample


@dataclass
class Tally:
    """Results of a reader's inputs."""

    name: str
    n_read: int = 0
    n_refused: int = 0
    faults: list[dict[str, Any]] = field(default_factory=list)
    slowest_s: float = 0.0
    slowest_index: int = -1
    max_grown_bytes: int = 0

    @property
    def n_inputs(self) -> int:
        return self.n_read + self.n_refused + len(self.faults)

    def add(self, outcomes: dict[str, Any]) -> None:
        if outcomes["fault"] is not None:
            self.faults.append({"index": outcomes["index"], "file": outcomes["file"], "fault": outcomes["fault"]})
        elif outcomes["is_read"]:
            self.n_read += 1
        else:
            self.n_refused += 1
        if outcomes["seconds"] > self.slowest_s:
            self.slowest_s, self.slowest_index = outcomes["seconds"], outcomes["index"]
        self.max_grown_bytes = max(self.max_grown_bytes, outcomes["grown_bytes"])


def work() -> None:
    """For each order on stdin, run a reader on damaged input and print one JSON line per input."""
    from damage import bounded_addresses
    from fuzz_targets import TARGETS
    from fuzzing import MAX_ADDRESSES_BYTES, Sample

    output, null = os.fdopen(os.dup(1), "w"), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    sys.stderr = os.fdopen(os.dup(2), "w")
    os.dup2(null, 2)  # native libraries print errors there, one line per input
    for line in sys.stdin:
        order = json.loads(line)
        with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
            os.chdir(folder)  # a reader that writes to the working folder does no harm
            os.environ["SU3D_DATA"] = folder
            sample = Sample(TARGETS[order["name"]], Path(folder, "sample").resolve())
            with bounded_addresses(MAX_ADDRESSES_BYTES):
                sample.read()
                for index in range(order["first"], order["end"]):
                    one = sample.input(order["seed"], index)
                    outcomes = {"index": index, "file": one.file, **vars(sample.meet(one))}
                    print(json.dumps(outcomes), file=output, flush=True)
            os.chdir("/")


class Worker:
    """A process that executes orders, any of which may kill it."""

    def __init__(self) -> None:
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed with the process
        command = [sys.executable, str(BENCHMARKS), "fuzz", "--worker"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True
        )
        self._lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def outcomes(self, name: str, seed: int, first: int, end: int) -> Iterator[dict[str, Any]]:
        """Results of each input; ends early if the process dies or hangs."""
        assert self._process.stdin is not None
        print(
            json.dumps({"name": name, "seed": seed, "first": first, "end": end}), file=self._process.stdin, flush=True
        )
        for index in range(first, end):
            try:
                line = self._lines.get(timeout=STARTS_S if index == first else HANG_S)
            except queue.Empty:
                return
            if line is None:
                return
            yield json.loads(line)

    def end(self) -> tuple[int, str]:
        """Exit code and last output; kills the process if it still runs."""
        try:
            self._process.wait(timeout=1)
        except subprocess.TimeoutExpired:
            self._process.kill()
        code = self._process.wait()
        self._errors.seek(0)
        output = self._errors.read()
        self._errors.close()
        return code, output


class Crew:
    """The current worker process."""

    def __init__(self) -> None:
        self._worker: Worker | None = None

    def meet(self, name: str, seed: int, first: int, end: int, save: Path, ends: float) -> Tally:
        """All inputs of a reader, using as many processes as needed."""
        tally = Tally(name)
        while first < end and time.monotonic() < ends:
            self._worker = self._worker or Worker()
            for outcomes in self._worker.outcomes(name, seed, first, end):
                tally.add(outcomes)
                first += 1
                if time.monotonic() > ends:
                    break
            if first < end:
                self._bury(tally, seed, first, save, is_over=time.monotonic() > ends)
                first += 1
                if tally.faults and tally.faults[-1]["fault"].startswith("harness"):
                    break  # it would fail on every input
        for fault in tally.faults[:20]:
            fault["file"] = _saved(name, seed, fault["index"], save)
        return tally

    def _bury(self, tally: Tally, seed: int, index: int, save: Path, *, is_over: bool) -> None:
        assert self._worker is not None
        code, output = self._worker.end()
        self._worker = None
        if not is_over:
            reason = f"harness: {output[-500:]}" if "Traceback" in output else f"process died or hung, exit code {code}"
            tally.faults.append({"index": index, "file": "", "fault": reason})

    def go_home(self) -> None:
        if self._worker is not None:
            self._worker.end()


def _saved(name: str, seed: int, index: int, save: Path) -> str:
    """Path of the saved bytes of an input."""
    from fuzz_targets import TARGETS
    from fuzzing import Sample

    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        one = Sample(TARGETS[name], Path(folder).resolve() / "sample").input(seed, index)
    file = save / f"{name.replace(' ', '-').replace('/', '-')}-{seed}-{index}" / Path(one.file).name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(one.content or b"")
    return str(file)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of each reader's first input")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="readers; 'scannet*' for a prefix")
    parser.add_argument("--minutes", type=float, default=600.0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table to FILE")
    parser.add_argument("--save", type=Path, default=Path("fuzz-faults"), help="folder for inputs of faults")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work()
        return 0
    from fuzz_targets import TARGETS

    wanted = arguments.only or ["*"]
    names = [name for name in TARGETS if any(Path(name).match(one) if "*" in one else name == one for one in wanted)]
    if not names:
        parser.error(f"unknown reader; known: {', '.join(TARGETS)}")
    started = time.monotonic()
    ends = started + 60 * arguments.minutes
    tallies, crew = [], Crew()
    weight = sum(TARGETS[name].weight for name in names)
    for name in names:
        n = math.ceil(arguments.inputs * TARGETS[name].weight / weight)
        before = time.monotonic()
        end = arguments.first + n
        tallies.append(one := crew.meet(name, arguments.seed, arguments.first, end, arguments.save, ends))
        print(
            f"{name:34} {one.n_inputs:6} inputs, {one.n_read:6} read, {len(one.faults):3} faults, slowest "
            f"{one.slowest_s * 1000:7.0f} ms, memory +{one.max_grown_bytes >> 20:4} MiB, "
            f"{time.monotonic() - before:6.1f} s",
            flush=True,
        )
        for fault in one.faults[:5]:
            print(f"    {fault['index']} {fault['file']}: {fault['fault']}", flush=True)
    crew.go_home()
    return _summed_up(tallies, arguments, time.monotonic() - started)


def _summed_up(tallies: list[Tally], arguments: argparse.Namespace, elapsed_s: float) -> int:
    n, n_faults = sum(one.n_inputs for one in tallies), sum(len(one.faults) for one in tallies)
    slowest = max(tallies, key=lambda one: one.slowest_s)
    largest = max(tallies, key=lambda one: one.max_grown_bytes)
    summary = (
        f"{n} inputs for {len(tallies)} readers with seed {arguments.seed} in {elapsed_s / 60:.1f} min: "
        f"{sum(one.n_read for one in tallies)} read, {sum(one.n_refused for one in tallies)} refused, "
        f"{n_faults} faults; slowest {slowest.slowest_s:.2f} s ({slowest.name} {slowest.slowest_index}), "
        f"largest memory growth +{largest.max_grown_bytes >> 20} MiB ({largest.name})"
    )
    print(summary)
    if arguments.json is not None:
        columns = ("reader", "inputs", "read", "refused", "faults", "slowest", "memory")
        rows = [
            (
                *(one.name, str(one.n_inputs), str(one.n_read), str(one.n_refused), str(len(one.faults))),
                *(f"{one.slowest_s:.2f} s", f"+{one.max_grown_bytes >> 20} MiB"),
            )
            for one in tallies
        ]
        command = f"python benchmarks fuzz --inputs {arguments.inputs} --seed {arguments.seed}"
        write_measured(arguments.json, "Damaged inputs of every reader", command, columns, rows, [summary])
    return 1 if n_faults else 0


if __name__ == "__main__":
    sys.exit(main())
