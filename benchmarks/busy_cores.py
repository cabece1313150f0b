"""How busy a run keeps the cores, and how soon it starts.

``python benchmarks/busy_cores.py --json build/measured/busy_cores.json``, five minutes: the four demo rooms under
opensu3d with as many workers as cores and without the perception cache. The processor time of the whole process tree is
sampled every 50 ms. *While jobs remain*: from the start of the command, and from the first frame handed to a method, to
the moment when the last waiting job is taken up. Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
from measured import write_measured

SCENES = ("rooms/living0", "rooms/bedroom0", "rooms/kitchen0", "rooms/office0")
EVERY_S = 0.05


@dataclass(frozen=True)
class Sample:
    """Seconds since the command began, processor seconds of its tree so far, scenes begun, scenes with an update."""

    at_s: float
    cpu_s: float
    n_begun: int
    n_fed: int


class Tree:
    """The processor time of a process and all that it starts; what has ended keeps what it had when last seen."""

    def __init__(self, pid: int) -> None:
        self._root = psutil.Process(pid)
        self._seen: dict[tuple[int, float], float] = {}

    def cpu_s(self) -> float:
        try:
            processes = [self._root, *self._root.children(recursive=True)]
        except psutil.Error:
            processes = []
        for one in processes:
            try:
                times = one.cpu_times()
                self._seen[one.pid, one.create_time()] = times.user + times.system
            except psutil.Error:
                continue
        return sum(self._seen.values())


def watch(words: Sequence[str], log: Path) -> tuple[list[Sample], float]:
    """Samples of the run ``words`` until it ends, and its wall time; progress lines on stderr go to ``log``."""
    samples = []
    start = time.perf_counter()
    with log.open("w") as stream:
        running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=stream)
        tree = Tree(running.pid)
        while running.poll() is None:
            begun, fed = _progress(log)
            samples.append(Sample(time.perf_counter() - start, tree.cpu_s(), begun, fed))
            time.sleep(EVERY_S)
    if running.returncode != 0:
        sys.exit(f"{' '.join(words)}: exit code {running.returncode}: {log.read_text()[-500:]}")
    return samples, time.perf_counter() - start


def _progress(log: Path) -> tuple[int, int]:
    """Scenes that were taken up, and updates that were done, from the events that ``RUN`` prints."""
    lines = [line for line in log.read_text().splitlines() if line.startswith('{"unit"') and line.endswith("}")]
    events = [json.loads(line) for line in lines]
    return len({one["unit"] for one in events}), sum(one["label"] == "opensu3d" and one["done"] > 0 for one in events)


RUN = """
import json, sys
from su3d_bench.executors import limit_threads
limit_threads()
from pathlib import Path
from su3d_bench.config import Setting, Settings
from su3d_bench.planning import make_plan
from su3d_bench.runner import run_plan
keys = {("scenes",): sys.argv[2:], ("methods",): ["opensu3d"], ("pictures",): False,
        ("protocols",): ["rooms-semantic", "rooms-instance"], ("perception", "cache"): False, ("limit",): LIMIT}
settings = Settings(tuple(Setting(key, value, "benchmark") for key, value in keys.items()))
plan = make_plan(settings, (), Path(sys.argv[1]))
def report(event):
    line = {"unit": event.unit, "label": event.label, "done": event.done}
    print(json.dumps(line), file=sys.stderr, flush=True)
assert run_plan(plan, report).is_complete
"""


def rates(samples: Sequence[Sample], n_scenes: int) -> dict[str, float]:
    """Shares of the cores' time, and when the first update was done."""
    cores = os.cpu_count() or 1
    fed = next(one for one in samples if one.n_fed)
    last = next(one for one in samples if one.n_begun == n_scenes)
    end = samples[-1]

    def share(first: Sample, then: Sample) -> float:
        return (then.cpu_s - first.cpu_s) / (cores * max(then.at_s - first.at_s, 1e-9))

    found = {"from the command until no job waits": share(samples[0], last)}
    if last.at_s > fed.at_s:  # with fewer scenes than workers none ever waits
        found["from the first update until no job waits"] = share(fed, last)
    return found | {"to the end of the last job": share(samples[0], end), "first update done, s": fed.at_s}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--limit", type=int, default=0, metavar="N", help="only the first N updates of each scene")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-c", RUN.replace("LIMIT", str(arguments.limit)), f"{folder}/run", *arguments.scenes]
        samples, wall_s = watch(words, Path(folder) / "events")
    found = rates(samples, len(arguments.scenes))
    rows = [(name, f"{value:.2f}" if name.endswith(", s") else f"{value:.0%}") for name, value in found.items()]
    rows.append(("whole run, s", f"{wall_s:.0f}"))
    for name, value in rows:
        print(f"{name:<45} {value:>8}")
    if arguments.json is not None:
        command = "python benchmarks/busy_cores.py --json build/measured/busy_cores.json"
        notes = (
            f"{len(arguments.scenes)} rooms under opensu3d, embedded profile, no perception cache, {os.cpu_count()} "
            "workers; processor time of the whole process tree over cores times wall time.",
        )
        write_measured(arguments.json, "A run keeps the cores busy", command, ("what", "value"), rows, notes)


if __name__ == "__main__":
    main()
