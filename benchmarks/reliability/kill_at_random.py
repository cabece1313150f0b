"""Runs killed with signal 9 at random moments, their last written files spoilt as by a power cut, then taken up again.

    python benchmarks kill_at_random --kills 200
    python benchmarks kill_at_random --kills 20 --seed 7 --executors processes

A run of two methods on three tiny painted scenes (``--subject opensu3d``: OpenSU3D and two baselines) is started,
killed at a moment drawn evenly from the time that a whole run takes, and half of the time each file of the second
before the kill is cut short, emptied, filled with zeros or taken back. Half of the runs that take it up again are
killed too. After every kill nothing that a seal vouches for may differ from the undisturbed run and the folder may not
stay locked; in the end every file must have the bytes of the undisturbed run, columns of times aside, and no
unfinished file may be left.

Each run is a process forked from one that has its modules loaded, so that the kills strike the work, not the start.
``group`` kills a run and all its workers, ``driver`` leaves workers behind for the next run to meet, ``worker`` kills
one worker of a run. With ray, the workers are those of a cluster that is started here and outlives the runs.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from forked_runs import COMPLETE, EXECUTORS, INCOMPLETE, SUBJECTS, Run, false_seals, load_modules, outcome
from measured import write_measured

VICTIMS = {"inline": ("group",), "processes": ("group", "driver", "worker"), "ray": ("driver", "worker")}
SHARES = {"inline": 12, "processes": 5, "ray": 3}  # of the kills: a run in workers takes many times as long
A_WORKER = ("spawn_main", "ray::_on_node")  # in the command lines of workers
LAST_SECOND_NS = 1_000_000_000
PAGE = 4096
COLUMNS = ("kills", "of a group", "of a driver", "of a worker", "power cuts", "files spoilt", "compared")
NOTE = (
    "compared: runs that were taken up again to their end, whose files had the bytes of the undisturbed run; a fault "
    "is a file that differs, a half-written one taken for whole, a lock that stayed, a traceback, or a file left over."
)


@dataclass
class Tally:
    """What was done and what came of it; ``faults`` must stay empty."""

    done: collections.Counter[str] = field(default_factory=collections.Counter)
    faults: list[str] = field(default_factory=list)


def workers_below(pid: int) -> list[int]:
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        children = psutil.Process(pid).children(recursive=True)
        return [one.pid for one in children if any(mark in " ".join(one.cmdline()) for mark in A_WORKER)]
    return []


def kill(run: Run, victim: str, workers: Sequence[int], moments: random.Random) -> bool:
    """Kill ``victim`` of ``run``; whether it was there."""
    if run.has_ended():
        return False
    if victim == "worker":
        if not workers:
            return False
        with contextlib.suppress(ProcessLookupError):
            os.kill(moments.choice(workers), signal.SIGKILL)
    elif victim == "driver":
        os.kill(run.pid, signal.SIGKILL)
    else:
        os.killpg(run.pid, signal.SIGKILL)
    return True


def cut_power(roots: Sequence[Path], moments: random.Random) -> int:
    """Spoil the files of the last second as an unlucky file system would; how many were."""
    since = time.time_ns() - LAST_SECOND_NS
    spoilt = 0
    for path in sorted(path for root in roots for path in root.rglob("*") if path.is_file()):
        if path.stat().st_mtime_ns < since:
            continue
        content = path.read_bytes()
        way = moments.choice(("whole", "cut", "empty", "zeros", "tail", "undone"))
        at = moments.randrange(len(content) + 1)
        if way == "whole":
            continue
        spoilt += 1
        if way == "undone":  # the bytes reached the disk in part, the new name did not
            path.rename(path.with_name(f".{path.name}.tmp"))
        elif way == "cut":
            path.write_bytes(content[:at])
        elif way == "tail":  # whole pages that were promised but not written
            kept = at // PAGE * PAGE
            path.write_bytes(content[:kept] + bytes(len(content) - kept))
        else:
            path.write_bytes(b"" if way == "empty" else bytes(len(content)))
    return spoilt


class Cluster:
    """A Ray cluster of two machines on this one, the second of which takes jobs; a process of its own holds it."""

    CODE = (
        "import sys; from ray.cluster_utils import Cluster\n"
        "small = {'object_store_memory': 80_000_000, 'include_dashboard': False}\n"
        "made = Cluster(initialize_head=True, head_node_args={'num_cpus': 0, **small})\n"
        "made.add_node(num_cpus=2, **small); print(made.address, flush=True); sys.stdin.read(); made.shutdown()"
    )

    def __init__(self) -> None:
        words = [sys.executable, "-c", self.CODE]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        said = iter(self._process.stdout.readline, "")
        self.address = next(line.strip() for line in said if line.startswith("127.") or line[:1].isdigit())
        self.pid = self._process.pid

    def close(self) -> None:
        self._process.communicate("")


class Trial:
    """One executor: its undisturbed run, and as many killed ones as are asked for."""

    def __init__(
        self, scratch: Path, subject: str, executor: str, cluster: Cluster | None, seed: str, tally: Tally
    ) -> None:
        self._request = (*SUBJECTS[subject], *EXECUTORS[executor])
        if cluster is not None:
            self._request += ("--ray-address", cluster.address)
        self._cluster = cluster
        moments = random.Random(f"{seed} {executor}")
        self._scratch, self._executor, self._moments, self._tally = scratch, executor, moments, tally
        self._cache = scratch / "cache"
        os.environ["SU3D_CACHE"] = str(self._cache)
        whole = scratch / f"whole-{executor}"
        run = Run(whole, self._request)
        if run.finish() != COMPLETE:
            raise SystemExit(f"the undisturbed run failed: {run.said()}")
        shutil.rmtree(self._cache, ignore_errors=True)
        run = Run(scratch / "timed", self._request)
        run.finish()
        self._whole_s = time.monotonic() - run.started
        self.expected = outcome(whole)
        if outcome(scratch / "timed") != self.expected:
            raise SystemExit("two undisturbed runs differ; nothing can be said of killed ones")
        shutil.rmtree(scratch / "timed")

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
            self._take_up(folder)

    def _kill_one(self, folder: Path) -> bool:
        victim = self._moments.choice(VICTIMS[self._executor])
        run = Run(folder, self._request)
        time.sleep(self._moments.uniform(0, self._whole_s))
        above = run.pid if self._cluster is None else self._cluster.pid
        was_hit = kill(run, victim, workers_below(above) if victim == "worker" else (), self._moments)
        if was_hit and victim == "driver":
            run.finish()
            return self._count("driver", spoilt=None)  # its workers may live on for a moment: the next run meets them
        code = run.finish()
        if not was_hit:
            self._tally.done["nobody there"] += 1
            if code != COMPLETE:
                self._fault(f"a run that nobody killed ended with {code}: {run.said()}")
            return False
        if victim == "worker" and code not in (COMPLETE, INCOMPLETE):
            self._fault(f"a run whose worker was killed ended with {code}: {run.said()}")
        if victim == "worker" and "Traceback" in run.said():
            self._fault(f"a run whose worker was killed showed a traceback: {run.said()}")
        spoilt = cut_power([folder, self._cache], self._moments) if self._moments.random() < 0.5 else None
        if folder.is_dir():
            for name in false_seals(folder, self.expected):
                self._fault(f"taken for whole after the kill of a {victim}: {name}")
            self._lock(folder)
        return self._count(victim, spoilt)

    def _count(self, victim: str, spoilt: int | None) -> bool:
        self._tally.done["kills"] += 1
        self._tally.done[f"of a {victim}"] += 1
        if spoilt is not None:
            self._tally.done["power cuts"] += 1
            self._tally.done["files spoilt"] += spoilt
        if self._tally.done["kills"] % 10 == 0:
            print(f"{self._executor}: {dict(self._tally.done)}", flush=True)
        return True

    def _lock(self, folder: Path) -> None:
        from su3d_bench.core.errors import StoreError
        from su3d_bench.store.run_folder import RunFolder

        try:
            with RunFolder(folder).locked():
                pass
        except StoreError as error:
            self._fault(f"a lock stayed: {error}")

    def _take_up(self, folder: Path) -> None:
        run = Run(folder, self._request)
        code = run.finish()
        self._tally.done["compared"] += 1
        if code != COMPLETE:
            self._fault(f"taken up again it ended with {code}: {run.said()}")
            return
        found = outcome(folder)
        for name in sorted(found.keys() | self.expected.keys()):
            if found.get(name) != self.expected.get(name):
                state = (
                    "is missing" if name not in found else "is left over" if name not in self.expected else "differs"
                )
                self._fault(f"taken up again: {name} {state}")
        for path in self._cache.rglob("*"):
            if path.is_file() and path.suffix != ".npz":
                self._fault(f"left in the cache: {path.name}")

    def _fault(self, line: str) -> None:
        self._tally.faults.append(f"{self._executor}: {line}")
        print(f"FAULT {self._tally.faults[-1]}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="in all; most are of runs inline (default: 200)")
    parser.add_argument("--seed", default="0")
    parser.add_argument("--executors", nargs="+", choices=list(EXECUTORS), default=list(EXECUTORS))
    parser.add_argument("--subject", choices=list(SUBJECTS), default="light", help="what runs (default: light)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table there too")
    given = parser.parse_args(arguments)
    load_modules(given.subject)
    started = time.monotonic()
    tallies = {}
    with tempfile.TemporaryDirectory(prefix="su3d-kills-") as scratch:
        for executor in given.executors:
            n = round(given.kills * SHARES[executor] / sum(SHARES[one] for one in given.executors))
            tallies[executor] = Tally()
            try_executor(Path(scratch) / executor, given.subject, executor, max(n, 1), given.seed, tallies[executor])
            print(f"{executor}: {dict(tallies[executor].done)}, {len(tallies[executor].faults)} faults", flush=True)
    rows = [
        [name, *(str(tally.done[what]) for what in COLUMNS), str(len(tally.faults))] for name, tally in tallies.items()
    ]
    n_faults = sum(len(tally.faults) for tally in tallies.values())
    print(f"{n_faults} faults in {time.monotonic() - started:.0f} s")
    if given.json is not None:
        command = f"python benchmarks kill_at_random --kills {given.kills} --seed {given.seed}"
        command += f" --executors {' '.join(given.executors)} --subject {given.subject}"
        write_measured(given.json, "Runs killed at random", command, ["executor", *COLUMNS, "faults"], rows, [NOTE])
    return 1 if n_faults else 0


def try_executor(scratch: Path, subject: str, executor: str, n: int, seed: str, tally: Tally) -> None:
    scratch.mkdir()
    cluster = Cluster() if executor == "ray" else None
    try:
        Trial(scratch, subject, executor, cluster, seed, tally).kills(n)
    finally:
        if cluster is not None:
            cluster.close()


if __name__ == "__main__":
    sys.exit(main())
