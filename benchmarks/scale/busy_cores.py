"""How busy a run keeps the cores, where they idle, and how soon work starts.

``python benchmarks busy_cores --json build/measured/busy_cores.json``, five minutes: the four demo rooms under
opensu3d through the command line, with as many workers as cores and without the perception cache; before that one frame
of each room, so that cached data of the rooms exist. Processor time of the whole process tree is
sampled every 50 ms. *While jobs wait*: until the first update of the last room begins. A core is *idle* if no part
of the run waits for it: on an otherwise idle machine, all time is used or idle; on a busy one the share of
the two that was used is still a fair estimate. Work starts with the first stage of the first update; the best of
``--starts`` runs of one frame of the first room.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
from as_installed import as_installed
from measured import write_measured

SCENES = ("rooms/living0", "rooms/bedroom0", "rooms/kitchen0", "rooms/office0")
EVERY_S = 0.05
WINDOW = 4  # samples over which demand is capped at the cores' capacity: several threads may wait for one
# The command line, but with one JSON line per progress event.
COMMAND = """
import json, sys
from contextlib import contextmanager
from su3d_bench.cli import main, run
@contextmanager
def lines(*_, **__):
    yield lambda one: print(json.dumps([one.unit, one.label, one.done, one.total]), file=sys.stderr, flush=True)
run.progress = lines
sys.exit(main.main(sys.argv[1:]))
"""
OPTIONS = (
    *("--methods", "opensu3d", "--protocols", "rooms-semantic", "rooms-instance", "--no-pictures"),
    *("--set", "perception.cache=false"),
)
BEFORE, UPDATES, AFTER, DONE = "before its first frame", "at its updates", "after its last frame", "scene"


@dataclass(frozen=True)
class Sample:
    """Seconds since the command began; processor seconds used and waited for by its tree; the state of the scenes."""

    at_s: float
    used_s: float
    waited_s: float
    phases: Mapping[str, str]
    n_updates: int

    @property
    def n_begun(self) -> int:
        return len(self.phases)

    def doing(self, n_workers: int) -> str:
        """The states of the workers; one without a message is starting, if there are scenes left for it."""
        now = [phase for phase in self.phases.values() if phase != DONE]
        if not self.phases:
            return "starting, none before that"
        return ", ".join(sorted(now) + ["starting"] * (n_workers - len(now)))


class Tree:
    """The processor time of a process and its descendants; ended ones keep their last value."""

    def __init__(self, pid: int) -> None:
        self._root = psutil.Process(pid)
        self._threads: dict[tuple[int, str], tuple[float, float]] = {}

    def seconds(self) -> tuple[float, float]:
        """Used, and waited for while ready to run."""
        processes: list[psutil.Process] = []
        with suppress(psutil.Error):
            processes = [self._root, *self._root.children(recursive=True)]
        for one in processes:
            with suppress(OSError):
                for thread in Path(f"/proc/{one.pid}/task").iterdir():
                    # nanoseconds on a core, and nanoseconds on its queue: the kernel's sched-stats
                    used, waited, _ = (thread / "schedstat").read_text().split()
                    self._threads[one.pid, thread.name] = int(used) / 1e9, int(waited) / 1e9
        return sum(one for one, _ in self._threads.values()), sum(one for _, one in self._threads.values())


def watch(words: Sequence[str], log: Path, environment: Mapping[str, str]) -> tuple[list[Sample], float]:
    """Samples of the run ``words`` until it ends, and its wall time; its events are written to ``log``."""
    samples = []
    start = time.perf_counter()
    with log.open("w") as stream:
        running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=stream, env=environment)
        tree = Tree(running.pid)
        while running.poll() is None:
            phases, n_updates = progress(log)
            samples.append(Sample(time.perf_counter() - start, *tree.seconds(), phases, n_updates))
            time.sleep(EVERY_S)
    if running.returncode != 0:
        sys.exit(f"{' '.join(words)}: exit code {running.returncode}: {log.read_text()[-500:]}")
    return samples, time.perf_counter() - start


def progress(log: Path) -> tuple[dict[str, str], int]:
    """The state of each started scene, and the updates done, from the events printed by ``COMMAND``."""
    phases: dict[str, str] = {}
    n_updates = 0
    for line in log.read_text().splitlines():
        if not (line.startswith('["') and line.endswith("]")):
            continue
        unit, label, done, total = json.loads(line)
        if label == DONE or label != "opensu3d":
            phases[unit] = DONE if label == DONE else AFTER
            continue
        n_updates += done > 0
        phases[unit] = BEFORE if done == 0 else UPDATES if done < total else AFTER
    return phases, n_updates


def idle_s(samples: Sequence[Sample]) -> list[float]:
    """The unused capacity of the cores between one sample and the next."""
    cores = os.cpu_count() or 1
    found = []
    for k in range(len(samples) - 1):
        first = samples[max(0, k - WINDOW // 2)]
        last = samples[min(len(samples) - 1, k + 1 + WINDOW // 2)]
        wanted = last.used_s - first.used_s + last.waited_s - first.waited_s
        share = min(1.0, wanted / (cores * (last.at_s - first.at_s)))
        found.append((1 - share) * cores * (samples[k + 1].at_s - samples[k].at_s))
    return found


def shares(samples: Sequence[Sample]) -> tuple[float, float]:
    """The share of the cores' time used over ``samples``, and its share of used and idle time."""
    used_s = samples[-1].used_s - samples[0].used_s
    available_s = (os.cpu_count() or 1) * (samples[-1].at_s - samples[0].at_s)
    return used_s / available_s, used_s / (used_s + sum(idle_s(samples)))


def rates(samples: Sequence[Sample], n_scenes: int) -> Iterator[tuple[str, str]]:
    begun = next(k for k, one in enumerate(samples) if one.n_begun)
    fed = next(k for k, one in enumerate(samples) if one.n_updates)
    last = next(k for k, one in enumerate(samples) if one.n_begun == n_scenes)
    spans = {"from the command until no job waits": samples[: last + 1]}
    if last > fed:  # with fewer scenes than workers no job waits
        spans["from the first update until no job waits"] = samples[fed : last + 1]
    spans["to the end of the last job"] = samples
    for name, span in spans.items():
        of_all, of_ours = shares(span)
        yield name, f"{of_all:.0%} used; {of_ours:.0%} of what was used or idle"
    for name, one in (("begins", samples[begun]), ("is done", samples[fed])):
        yield f"the first update of all {name}", f"{one.at_s:.2f} s"


def idling(samples: Sequence[Sample], n_scenes: int) -> Iterator[tuple[str, str]]:
    """Idle time of the cores while jobs waited, by the states of the workers, most first."""
    cores = os.cpu_count() or 1
    all_s, idle = defaultdict[str, float](float), defaultdict[str, float](float)
    last = next(k for k, one in enumerate(samples) if one.n_begun == n_scenes)
    for k, seconds in enumerate(idle_s(samples)[:last]):
        name = samples[k].doing(cores)
        all_s[name] += cores * (samples[k + 1].at_s - samples[k].at_s)
        idle[name] += seconds
    for name in sorted(idle, key=lambda name: -idle[name]):
        yield f"idle, workers {name}", f"{idle[name]:.1f} s of {all_s[name]:.1f} s"


def first_starts(rounds: Sequence[Sequence[Sample]]) -> Iterator[tuple[str, str]]:
    """The start time of a single scene, the best of ``rounds``."""
    begins = [next(one for one in samples if one.n_begun) for samples in rounds]
    done = [next(one for one in samples if one.n_updates) for samples in rounds]
    for name, found in (("begins", begins), ("is done", done)):
        at_s, used_s = min(one.at_s for one in found), min(one.used_s for one in found)
        yield f"one room: its first update {name}", f"{at_s:.2f} s, {used_s:.2f} s of processor time"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--limit", type=int, default=0, metavar="N", help="only the first N updates of each scene")
    parser.add_argument("--starts", type=int, default=5, metavar="N", help="runs of one frame of the first scene")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        environment = as_installed(Path(folder) / "compiled")
        events = Path(folder) / "events"

        def run(name: str, scenes: Sequence[str], limit: int) -> tuple[list[Sample], float]:
            words = [sys.executable, "-c", COMMAND, "run", *OPTIONS, "--limit", str(limit), "--out", f"{folder}/{name}"]
            return watch([*words, "--scenes", *scenes], events, environment)

        run("first", arguments.scenes, 1)
        starts = [run(f"start{k}", arguments.scenes[:1], 1)[0] for k in range(arguments.starts)]
        samples, wall_s = run("whole", arguments.scenes, arguments.limit)
    n = len(arguments.scenes)
    rows = [*first_starts(starts), *rates(samples, n), *idling(samples, n), ("whole run", f"{wall_s:.0f} s")]
    for name, value in rows:
        print(f"{name:<60} {value}")
    if arguments.json is not None:
        command = "python benchmarks busy_cores --json build/measured/busy_cores.json"
        notes = (
            f"{n} rooms under opensu3d, embedded profile, no perception cache, {os.cpu_count()} workers; processor "
            "time of the whole process tree over cores times wall time. Idle: nothing of the run waited for the core. "
            "The targets: 85 % while jobs wait, and work that starts in 2 s.",
        )
        write_measured(arguments.json, "Core utilization of a run", command, ("what", "value"), rows, notes)


if __name__ == "__main__":
    main()
