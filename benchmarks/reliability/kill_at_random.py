"""Runs and verbs killed at random moments, last written files corrupted as by a power cut, then resumed.

    python benchmarks kill_at_random --kills 200
    python benchmarks kill_at_random --kills 20 --seed 7 --only processes export

A run of two methods on three tiny painted scenes (``--subject opensu3d``: OpenSU3D and two baselines) is started and
killed, with signal 9 or with those sent by terminals, schedulers and users, at a random moment of the duration of a
complete run; after half of the kills with signal 9 each file of the last second is truncated, emptied, filled with
zeros or reverted. Half of the runs that resume it are killed too. After every kill no file covered by a completion
record may differ from the undisturbed run and the folder may not stay locked; finally every file must have the bytes of
the undisturbed run, except columns of times. The same holds for runs of a user program that starts another program
(``program``, ``programs`` in workers), and ``export``, ``sheets make``, ``sheets score`` and ``report html``.

Three counts must be zero: faults; orphans, processes that still work for a run killed seconds ago;
and leftovers, files and folders without an owner once the same command has completed.

Each run is forked from a process with loaded modules, so that kills hit the work, not the start.
``group`` kills a run and all its workers, ``driver`` leaves workers behind for the next run, ``worker`` kills
one worker of a run.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from forked_runs import (
    COMPLETE,
    EXECUTORS,
    INCOMPLETE,
    SUBJECTS,
    Run,
    false_seals,
    load_modules,
    outcome,
    program_of,
)
from killed_commands import VERBS, load_verbs, try_verbs
from killing import SIGNALS, Tally, check_end, clear_leftovers, cut_power, end_of, end_orphans, kill, workers_below
from measured import write_measured

# What is run, and by which executor; ``--subject`` selects what the first three run.
RUNS = {
    "inline": (None, "inline"),
    "processes": (None, "processes"),
    "program": ("program", "inline"),
    "programs": ("program", "processes"),
}
VICTIMS = {"inline": ("group", "driver"), "processes": ("group", "driver", "worker")}
# Shares of the kills: a run in workers takes much longer.
SHARES = dict.fromkeys(VERBS, 2) | {"inline": 8, "processes": 3, "program": 4, "programs": 2}
COLUMNS = (
    "kills", "of a group", "of a driver", "of a worker", "SIGKILL", "SIGTERM", "SIGHUP", "SIGINT", "power cuts",
    "files corrupted", "compared",
)  # fmt: skip
COUNTED = ("faults", "orphans", "leftovers")
NOTE = (
    "compared: resumed to completion with the bytes of the undisturbed run; a fault is a file that "
    "differs, a partial one accepted as complete, a remaining lock, a traceback or an unexpected exit code; an "
    "orphan is a process still working 5 s after its run was killed, a leftover a file or folder without an owner."
)


class Trial:
    """Runs of one kind: the undisturbed one, and as many killed ones as requested."""

    def __init__(self, scratch: Path, subject: str, executor: str, seed: str, tally: Tally) -> None:
        self._request = (*SUBJECTS[subject], *EXECUTORS[executor])
        self._scratch, self._executor, self._tally = scratch, executor, tally
        self._moments = random.Random(f"{seed} {tally.name}")
        self._cache, self._temporary = scratch / "cache", scratch.parent / "temporary"
        os.environ["SU3D_CACHE"] = str(self._cache)
        if subject == "program":
            self._request += ("--set", program_of(self._ready()))
        whole = scratch / "whole"
        run = Run(whole, self._request)
        if run.finish() != COMPLETE:
            raise SystemExit(f"the undisturbed run failed: {run.output()}")
        shutil.rmtree(self._cache, ignore_errors=True)
        run = Run(scratch / "timed", self._request)
        run.finish()
        self._whole_s = time.monotonic() - run.started
        self.expected = outcome(whole)
        if outcome(scratch / "timed") != self.expected:
            raise SystemExit("two undisturbed runs differ; killed ones cannot be compared")
        shutil.rmtree(scratch / "timed")
        self._kept = {path.name for path in self._temporary.iterdir()}

    def _ready(self) -> Path:
        """A map for the program to write."""
        run = Run(self._scratch / "light", (*SUBJECTS["light"], *EXECUTORS["inline"]))
        if run.finish() != COMPLETE:
            raise SystemExit(f"the run before those of a program failed: {run.output()}")
        return self._scratch / "light/scenes/painted.a/collector/prediction.npz"

    def kills(self, n: int) -> None:
        """Episodes until ``n`` kills struck."""
        struck = 0
        while struck < n:
            folder = self._scratch / "run"
            shutil.rmtree(folder, ignore_errors=True)
            shutil.rmtree(self._cache, ignore_errors=True)
            of_episode = 0
            while of_episode == 0 or (struck < n and self._moments.random() < 0.5):
                of_episode += 1
                struck += self._kill_one(folder)
            self._resume(folder)

    def _kill_one(self, folder: Path) -> bool:
        victim, sent = self._moments.choice(VICTIMS[self._executor]), self._moments.choice(SIGNALS)
        run = Run(folder, self._request)
        time.sleep(self._moments.uniform(0, self._whole_s))
        was_hit = kill(run, victim, sent, workers_below(run.pid) if victim == "worker" else (), self._moments)
        code = end_of(run, self._tally) if was_hit else run.finish()
        if not was_hit:
            self._tally.done["nobody there"] += 1
            if code != COMPLETE:
                self._tally.fault(f"a run that was not killed ended with {code}: {run.output()}")
            return False
        if victim == "worker" or sent != signal.SIGKILL:
            check_end(run, code, sent, (COMPLETE, INCOMPLETE), self._tally)
        if victim == "driver" and sent == signal.SIGKILL:
            self._tally.kill(victim, sent, None)  # its workers may live on briefly: the next run encounters them
            return True
        self._end_orphans()
        is_cut = sent == signal.SIGKILL and self._moments.random() < 0.5
        damaged = cut_power([folder, self._cache], self._moments) if is_cut else None
        if folder.is_dir():
            for name in false_seals(folder, self.expected):
                self._tally.fault(f"accepted as complete after the kill of a {victim}: {name}")
            self._lock(folder)
        self._tally.kill(victim, sent, damaged)
        return True

    def _end_orphans(self) -> None:
        for place in (self._scratch, self._temporary):
            end_orphans(place, self._tally)

    def _lock(self, folder: Path) -> None:
        from su3d_bench.core.errors import StoreError
        from su3d_bench.store.run_folder import RunFolder

        try:
            with RunFolder(folder).locked():
                pass
        except StoreError as error:
            self._tally.fault(f"a lock remained: {error}")

    def _resume(self, folder: Path) -> None:
        run = Run(folder, self._request)
        code = run.finish()
        self._tally.done["compared"] += 1
        self._end_orphans()
        if code != COMPLETE:
            self._tally.fault(f"after resuming it ended with {code}: {run.output()}")
            return
        found = outcome(folder)
        for name in sorted(found.keys() | self.expected.keys()):
            if name not in self.expected:
                self._tally.leftover(name)
            elif name not in found or found[name] != self.expected[name]:
                self._tally.fault(f"resumed: {name} {'differs' if name in found else 'is missing'}")
        for path in self._cache.rglob("*"):
            if path.is_file() and path.suffix != ".npz":
                self._tally.leftover(f"in the cache: {path.name}")
        clear_leftovers(self._temporary, self._kept, self._tally)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="minimum number; most are of inline runs (default: 200)")
    parser.add_argument("--seed", default="0")
    parser.add_argument("--only", nargs="+", choices=list(SHARES), default=list(SHARES), help="what is killed")
    parser.add_argument(
        "--subject", choices=("light", "opensu3d"), default="light", help="subject of most runs (default: light)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the table to FILE")
    given = parser.parse_args(arguments)
    load_modules(given.subject)
    started = time.monotonic()
    tallies = {name: Tally(name) for name in given.only}
    n_shares = sum(SHARES[name] for name in tallies)
    counts = {name: math.ceil(given.kills * SHARES[name] / n_shares) for name in tallies}
    with tempfile.TemporaryDirectory(prefix="su3d-kills-") as place:
        scratch = Path(place)
        (scratch / "temporary").mkdir()
        os.environ["TMPDIR"] = tempfile.tempdir = str(scratch / "temporary")
        for name, (subject, executor) in RUNS.items():
            if name in tallies:
                (scratch / name).mkdir()
                trial = Trial(scratch / name, subject or given.subject, executor, given.seed, tallies[name])
                trial.kills(counts[name])
        of_verbs = {name: counts[name] for name in VERBS if name in tallies}
        if of_verbs:
            load_verbs()
            try_verbs(scratch, of_verbs, given.seed, tallies)
    rows = [
        [name, *(str(tally.done[what]) for what in COLUMNS), *(str(len(getattr(tally, what))) for what in COUNTED)]
        for name, tally in tallies.items()
    ]
    for row in rows:
        print("  ".join(row))
    totals = {what: sum(len(getattr(tally, what)) for tally in tallies.values()) for what in COUNTED}
    print(f"{', '.join(f'{n} {what}' for what, n in totals.items())} in {time.monotonic() - started:.0f} s")
    if given.json is not None:
        command = f"python benchmarks kill_at_random --kills {given.kills} --seed {given.seed}"
        command += f" --only {' '.join(given.only)} --subject {given.subject}"
        columns = ["killed", *COLUMNS, *COUNTED]
        write_measured(given.json, "Runs and verbs killed at random", command, columns, rows, [NOTE])
    return 0 if all(tally.is_clean for tally in tallies.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
