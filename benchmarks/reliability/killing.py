"""How processes are killed on purpose, and what is counted afterwards: faults, orphaned processes, leftovers."""

from __future__ import annotations

import collections
import contextlib
import os
import random
import shutil
import signal
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from forked_runs import ForkedProcess

# The signal that cannot be handled, and those of a terminal, a scheduler and a user.
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
WORKER_COMMAND = "spawn_main"  # in the command line of a worker
GRACE_S = 5.0  # until the children of a killed process must have ended
MAX_S = 120.0  # until a process that received a signal it can handle must have ended
LAST_SECOND_NS = 1_000_000_000
PAGE = 4096


@dataclass
class Tally:
    """What was done and the results; ``faults``, ``orphans`` and ``leftovers`` must stay empty."""

    name: str
    done: collections.Counter[str] = field(default_factory=collections.Counter)
    faults: list[str] = field(default_factory=list)
    orphans: list[str] = field(default_factory=list)
    leftovers: list[str] = field(default_factory=list)

    def fault(self, line: str) -> None:
        self._note("FAULT", self.faults, line)

    def orphan(self, line: str) -> None:
        self._note("ORPHAN", self.orphans, line)

    def leftover(self, line: str) -> None:
        self._note("LEFTOVER", self.leftovers, line)

    def _note(self, kind: str, lines: list[str], line: str) -> None:
        lines.append(f"{self.name}: {line}")
        print(f"{kind} {lines[-1]}", flush=True)

    def kill(self, victim: str, sent: signal.Signals, damaged: int | None) -> None:
        """Count an effective kill; ``corrupted`` files if a power cut was simulated."""
        self.done["kills"] += 1
        self.done[f"of a {victim}"] += 1
        self.done[sent.name] += 1
        if damaged is not None:
            self.done["power cuts"] += 1
            self.done["files corrupted"] += damaged
        if self.done["kills"] % 10 == 0:
            print(f"{self.name}: {dict(self.done)}", flush=True)

    @property
    def is_clean(self) -> bool:
        return not (self.faults or self.orphans or self.leftovers)


def workers_below(pid: int) -> list[int]:
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        children = psutil.Process(pid).children(recursive=True)
        return [one.pid for one in children if WORKER_COMMAND in " ".join(one.cmdline())]
    return []


def kill(run: ForkedProcess, victim: str, sent: signal.Signals, workers: Sequence[int], moments: random.Random) -> bool:
    """Send a signal to ``victim`` of ``run``; return whether it existed."""
    if run.has_ended():
        return False
    if victim == "worker" and not workers:
        return False
    try:
        if victim == "group":
            os.killpg(run.pid, sent)
        else:
            os.kill(moments.choice(workers) if victim == "worker" else run.pid, sent)
    except ProcessLookupError:  # not a group yet, or no longer a worker
        return False
    return True


def end_of(run: ForkedProcess, tally: Tally) -> int:
    """The exit code after a signal; a process that does not end is a fault, and is killed."""
    limit = time.monotonic() + MAX_S
    while not run.has_ended():
        if time.monotonic() > limit:
            tally.fault(f"still runs {MAX_S:.0f} s after the signal: {run.output()}")
            os.killpg(run.pid, signal.SIGKILL)
            break
        time.sleep(0.01)
    return run.finish()


def check_end(run: ForkedProcess, code: int, sent: signal.Signals, usual: Collection[int], tally: Tally) -> None:
    """Check that the process ended by ``sent`` or as usual (``usual``), without a traceback."""
    if code not in (-sent, 128 + sent, *usual):
        tally.fault(f"ended with {code} after {sent.name}: {run.output()}")
    if "Traceback" in run.output():
        tally.fault(f"showed a traceback after {sent.name}: {run.output()}")


def end_orphans(place: Path, tally: Tally) -> None:
    """Count and kill processes that work below ``place``, after giving ending ones time to finish."""
    limit = time.monotonic() + GRACE_S
    while (found := _working_below(place)) and time.monotonic() < limit:
        time.sleep(0.05)
    for pid, words in found:
        tally.orphan(f"still runs after {GRACE_S:.0f} s: {words}")
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _working_below(place: Path) -> list[tuple[int, str]]:
    """Other processes whose working folder, or a word of whose command line, is below ``place``."""
    import psutil

    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            if process.pid == os.getpid() or process.status() == psutil.STATUS_ZOMBIE:
                continue
            words = process.cmdline()
            if any(str(place) in text for text in (os.readlink(f"/proc/{process.pid}/cwd"), *words)):
                found.append((process.pid, " ".join(words)[-200:]))
    return found


def clear_leftovers(folder: Path, known: Collection[str], tally: Tally) -> None:
    """Count and remove entries of ``folder`` not in ``known``."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.name not in known:
            tally.leftover(f"in {folder.name}: {path.name}")
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def cut_power(roots: Sequence[Path], moments: random.Random) -> int:
    """Corrupt the files of the last second as a power cut might; return their number."""
    from su3d_bench.core.files.locks import beside

    since = time.time_ns() - LAST_SECOND_NS
    damaged = 0
    for path in sorted(path for root in roots for path in root.rglob("*") if path.is_file()):
        if path.stat().st_mtime_ns < since:
            continue
        content = path.read_bytes()
        way = moments.choice(("whole", "cut", "empty", "zeros", "tail", "undone"))
        at = moments.randrange(len(content) + 1)
        if way == "whole":
            continue
        damaged += 1
        if way == "undone":  # the bytes partly reached the disk, the rename did not
            path.rename(beside(path))
        elif way == "cut":
            path.write_bytes(content[:at])
        elif way == "tail":  # whole pages that were allocated but not written
            kept = at // PAGE * PAGE
            path.write_bytes(content[:kept] + bytes(len(content) - kept))
        else:
            path.write_bytes(b"" if way == "empty" else bytes(len(content)))
    return damaged
