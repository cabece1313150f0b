"""Runs on full or read-only disks: real, small in-memory file systems. Needs root to mount them.

    python benchmarks full_disk --disks 20

The light run of ``kill_at_random.py`` writes to a disk of a random size below its needs, with its cache
on it or elsewhere, or to a disk that turns read-only at a random moment. It must end with one line about it, no
traceback and no partial file accepted as complete; once the disk is larger or writable, the same command
must produce the bytes of the undisturbed run.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from forked_runs import COMPLETE, EXECUTORS, SUBJECTS, Run, false_seals, load_modules, outcome
from measured import write_measured

REQUEST = (*SUBJECTS["light"], *EXECUTORS["inline"])
ENOUGH = "size=64m"
WRONG_INPUT = 2  # exit code of the command: not its own fault
KINDS = {
    "run folder on a full disk": "the disk is full; free some space",
    "cache on a full disk": "cannot write the perception cache (No space left on device)",
    "disk that turns read-only": "the folder is read-only; choose another with --out",
}


@contextmanager
def disk(at: Path, options: str) -> Iterator[None]:
    """An in-memory file system at ``at``."""
    at.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "su3d-full-disk", str(at)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(at)], check=True)
        at.rmdir()


def remount(at: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", str(at)], check=True)


def used_kib(folder: Path) -> int:
    return sum(-(-path.stat().st_size // 4096) * 4 for path in folder.rglob("*"))


class Trials:
    """Runs of each kind, compared with the undisturbed one."""

    def __init__(self, scratch: Path, moments: random.Random) -> None:
        self._scratch, self._moments = scratch, moments
        os.environ["SU3D_CACHE"] = str(scratch / "whole-cache")
        whole = Run(scratch / "whole", REQUEST)
        if whole.finish() != COMPLETE:
            raise SystemExit(f"the undisturbed run failed: {whole.output()}")
        self._whole_s = time.monotonic() - whole.started
        self._expected = outcome(scratch / "whole")
        self._needs_kib = {"run": used_kib(scratch / "whole"), "cache": used_kib(scratch / "whole-cache")}

    def one(self, kind: str, number: int) -> tuple[bool, list[str]]:
        """Whether the fault occurred, and what was wrong with the end of the run."""
        at = self._scratch / f"disk{number}"
        cache = at / "cache" if kind.startswith("cache") else self._scratch / f"cache{number}"
        folder = self._scratch / f"run{number}" if kind.startswith("cache") else at / "run"
        os.environ["SU3D_CACHE"] = str(cache)
        # Half: an in-memory file system does not count folders, and each entry has one.
        needed = self._needs_kib["cache"] // 2 if kind.startswith("cache") else self._needs_kib["run"]
        small = f"size={self._moments.randrange(4, needed, 4)}k" if "full" in kind else ENOUGH
        with disk(at, small):
            run = Run(folder, REQUEST, self._scratch / f"log{number}")
            if "read-only" in kind:
                time.sleep(self._moments.uniform(0, self._whole_s))
                # An open file prevents a disk from turning read-only: it works between two writes.
                while subprocess.run(["mount", "-o", "remount,ro", str(at)], capture_output=True).returncode:
                    time.sleep(0.001)
            code = run.finish()
            remount(at, f"rw,{ENOUGH}")
            if code == COMPLETE:
                return False, []
            wrong = self._wrong_end(kind, folder, code, run.output())
            again = Run(folder, REQUEST, self._scratch / f"log{number}")
            if again.finish() != COMPLETE:
                return True, [*wrong, f"does not resume: {again.output()}"]
            found = outcome(folder)
            names = [
                name for name in found.keys() | self._expected.keys() if found.get(name) != self._expected.get(name)
            ]
            return True, [*wrong, *(f"{name} differs" for name in names)]

    def _wrong_end(self, kind: str, folder: Path, code: int, output: str) -> list[str]:
        wrong = [f"{name} is complete" for name in false_seals(folder, self._expected)] if folder.is_dir() else []
        lines = [line for line in output.splitlines() if line.startswith("su3d-bench: ")]
        if code != WRONG_INPUT or len(lines) != 1 or KINDS[kind] not in lines[0] or "Traceback" in output:
            wrong.append(f"ended with {code}: {output}")
        return wrong


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--disks", type=int, default=20, help="disks of each kind (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the table to FILE")
    given = parser.parse_args(arguments)
    load_modules("light")
    rows = []
    with tempfile.TemporaryDirectory(prefix="su3d-disks-") as scratch:
        trials = Trials(Path(scratch), random.Random(given.seed))
        for k, kind in enumerate(KINDS):
            ends = [trials.one(kind, k * given.disks + number) for number in range(given.disks)]
            faults = [line for _, wrong in ends for line in wrong]
            for line in faults:
                print(f"FAULT {kind}: {line}")
            rows.append([kind, str(given.disks), str(sum(met for met, _ in ends)), str(len(faults))])
            print("{}: {} runs, {} affected, {} faults".format(*rows[-1]), flush=True)
    if given.json is not None:
        command = f"python benchmarks full_disk --disks {given.disks}"
        notes = ["The others ended before the disk was full or read-only."]
        write_measured(given.json, "Disk errors", command, ["kind", "runs", "affected", "faults"], rows, notes)
    return 1 if any(row[-1] != "0" for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
