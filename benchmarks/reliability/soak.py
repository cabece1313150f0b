"""Hours of repeated runs: memory, files, threads and temporary files after each round, and whether any of them grows.

    python benchmarks soak --hours 3 --out soak.csv
    python benchmarks soak --summarise soak.csv

A round calls the command's entry point in this process: a short run of OpenSU3D and two baselines on a room, the same
run again (nothing to do), a query and the tables; sometimes a page, a run in worker processes, and the command in a
separate process. All folders, including temporary files, are below one scratch folder, so
that leftovers are counted. The result is one line per quantity: its slope per hour with a 95 % interval, over
the medians of 12 equal spans after the warm-up, and whether it grows.
"""

from __future__ import annotations

import argparse
import csv
import gc
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from measured import write_measured

METHODS = ("opensu3d", "sam3d", "conceptgraphs")
SCENES = ("rooms/living0", "rooms/office0")
RUN = ("run", "--methods", *METHODS, "--protocols", "rooms-semantic", "rooms-instance", "--limit", "3", "--quiet")
FRESH_CACHE_EVERY, PAGE_EVERY, WORKERS_EVERY, COMMAND_EVERY = 4, 6, 8, 10
COLUMNS = ("quantity", "median", "range", "slope per hour with 95 % interval", "verdict")
N_SPANS = 12
T_95 = 2.228  # Student's t, 97.5 %, for the 10 degrees of freedom of a line through 12 spans
# Growth over the whole time also requires this, besides an interval above zero: a share of the level, or a count.
TOLERANCE: dict[str, Callable[[float], float]] = {
    "rss_mib": lambda level: 0.02 * level,
    "objects": lambda level: 0.02 * level,
}
ONE_THING = 0.5


class Round:
    """The commands of one round below ``scratch``."""

    def __init__(self, scratch: Path, number: int) -> None:
        self._folder = scratch / "run"
        self._scratch = scratch
        self._number = number
        self._scene = SCENES[number % 2]

    def go(self) -> None:
        if self._is_turn(FRESH_CACHE_EVERY):
            shutil.rmtree(self._scratch / "cache" / "perception", ignore_errors=True)
        pictures = () if self._number % 3 else ("--pictures",)
        run = (*RUN, "--scenes", self._scene, "--jobs", "1", *(pictures or ("--no-pictures",)), "--out", self._folder)
        self._call(*run)
        self._call(*run)
        self._call("query", self._scene, "plant on shelf", "--run", self._folder, "--top", "3")
        self._call("report", "tables", self._folder)
        if self._is_turn(PAGE_EVERY):
            self._call("report", "html", self._folder, "--out", self._folder / "page.html")
        shutil.rmtree(self._folder)
        if self._is_turn(WORKERS_EVERY):
            self._call(*RUN, "--scenes", *SCENES, "--jobs", "2", "--no-pictures", "--out", self._folder)
            shutil.rmtree(self._folder)
        if self._is_turn(COMMAND_EVERY):
            words = [sys.executable, "-m", "su3d_bench", *map(str, run)]
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
            shutil.rmtree(self._folder)

    def _is_turn(self, every: int) -> bool:
        return self._number % every == every - 1

    @staticmethod
    def _call(*words: str | Path) -> None:
        from su3d_bench.cli.main import main

        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            code = main([str(word) for word in words])
        if code != 0:
            raise SystemExit(f"su3d-bench {' '.join(map(str, words))} ended with {code}: {err.getvalue()}")


def measure(scratch: Path) -> dict[str, float]:
    """Resources of this process and files on disk, after garbage collection."""
    import psutil

    gc.collect()
    process = psutil.Process()
    files = [path for path in scratch.rglob("*") if path.is_file()]
    unfinished = [path for path in files if path.name.endswith((".unfinished", ".partial"))]
    shared = Path("/dev/shm")
    return {
        "rss_mib": round(process.memory_info().rss / 2**20, 2),
        "objects": len(gc.get_objects()),
        "open_files": process.num_fds(),
        "threads": process.num_threads(),
        "children": len(process.children(recursive=True)),
        "temporary_files": sum(1 for _ in Path(tempfile.gettempdir()).iterdir()),
        "unfinished_files": len(unfinished),
        "kept_files": len(files),
        "shared_memory": sum(1 for _ in shared.iterdir()) if shared.is_dir() else 0,
    }


def soak(scratch: Path, hours: float, table: Path) -> None:
    """Rounds until ``hours`` are over, one line each in ``table``."""
    for name in ("cache", "temporary"):
        (scratch / name).mkdir()
    os.environ |= {"SU3D_CACHE": str(scratch / "cache"), "TMPDIR": str(scratch / "temporary")}
    tempfile.tempdir = str(scratch / "temporary")
    started = time.monotonic()
    with table.open("w", newline="") as stream:
        writer: csv.DictWriter[str] | None = None
        number = 0
        while time.monotonic() - started < hours * 3600:
            begun = time.monotonic()
            Round(scratch, number).go()
            row: dict[str, Any] = {"round": number, "hours": round((time.monotonic() - started) / 3600, 5)}
            row |= {"seconds": round(time.monotonic() - begun, 2)} | measure(scratch)
            if writer is None:
                writer = csv.DictWriter(stream, list(row))
                writer.writeheader()
            writer.writerow(row)
            stream.flush()
            number += 1


def summarise(table: Path, json_file: Path | None) -> bool:
    """Print and store the trend of each quantity after the first tenth of the time; return whether none grows."""
    with table.open(newline="") as stream:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(stream)]
    hours = np.array([row["hours"] for row in rows])
    # A tenth, but every kind of round at least once.
    is_warm = (hours > 0.1 * hours[-1]) & (np.arange(len(rows)) >= COMMAND_EVERY)
    if is_warm.sum() < 2 * N_SPANS:
        raise SystemExit(f"{table}: {len(rows)} rounds are too few; run it longer")
    span = hours[-1] - hours[is_warm][0]
    print(f"{len(rows)} rounds in {hours[-1]:.2f} h; after the warm-up {int(is_warm.sum())} in {span:.2f} h")
    lines: list[list[str]] = []
    for name in list(rows[0])[3:]:
        values = np.array([row[name] for row in rows])[is_warm]
        slope, half = line(hours[is_warm], values)
        level = float(np.median(values))
        allowed = TOLERANCE.get(name, lambda _: ONE_THING)(level)
        is_growing = slope - half > 0 and slope * span > allowed
        lines.append(
            [
                name,
                f"{level:.1f}",
                f"{values.min():.1f} to {values.max():.1f}",
                f"{slope:+.3f} [{slope - half:+.3f}, {slope + half:+.3f}]",
                "GROWS" if is_growing else "does not grow",
            ]
        )
        print("  ".join(lines[-1]))
    if json_file is not None:
        note = f"{len(rows)} rounds in {hours[-1]:.2f} hours; from the {len(rows) - int(is_warm.sum()) + 1}th on."
        write_measured(json_file, "Long soak", "python benchmarks soak --hours 3", COLUMNS, lines, [note])
    return not any(line[-1] == "GROWS" for line in lines)


def line(hours: Any, values: Any) -> tuple[float, float]:
    """Slope per hour and half of its 95 % interval, from medians of equal spans, which are robust to single rounds."""
    spans = np.array_split(np.arange(len(values)), N_SPANS)
    x = np.array([hours[span].mean() for span in spans])
    y = np.array([np.median(values[span]) for span in spans])
    x = x - x.mean()
    slope = float((x * (y - y.mean())).sum() / (x * x).sum())
    rest = y - y.mean() - slope * x
    error = float(np.sqrt((rest * rest).sum() / (N_SPANS - 2) / (x * x).sum()))
    return slope, T_95 * error


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--out", type=Path, default=Path("soak.csv"), help="CSV file of the rounds (default: soak.csv)")
    parser.add_argument("--summarise", type=Path, metavar="CSV", help="only summarise this file")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the result table to FILE")
    given = parser.parse_args(arguments)
    if given.summarise is not None:
        return 0 if summarise(given.summarise, given.json) else 1
    with tempfile.TemporaryDirectory(prefix="su3d-soak-") as scratch:
        soak(Path(scratch), given.hours, given.out)
    return 0 if summarise(given.out, given.json) else 1


if __name__ == "__main__":
    sys.exit(main())
