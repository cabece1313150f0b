"""Check that unchanged repeats of a real run pass the regression check, with real timings of this machine.

``python benchmarks regression_check_repeats [--repeats 50] [--json build/measured/gate_repeats.json]``: a small run
repeatedly, OpenSU3D with perfect masks on the forty updates of a room; the first five create the reference, the
others are checked against it, and each once more with a method made slower by half, which must fail. A few seconds per
run. Exit code 1 if a repeat fails or a slower one passes.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import sys
import tempfile
from pathlib import Path

from measured import write_measured

from su3d_bench.analysis.regression_check import COST_LIMIT, Reference, check, learn, method_cost
from su3d_bench.cli.main import main as su3d_bench
from su3d_bench.core.digests import digest_file
from su3d_bench.reports.regression_check import plain_lines
from su3d_bench.runs.finished import read_run

TAUGHT, N_UPDATES, SLOWER = 5, 40, 1.5


def made(scene: str, folder: Path) -> Path:
    """One run of the request."""
    words = ["run", "--scenes", scene, "--methods", "opensu3d", "--profile", "oracle", "--limit", str(N_UPDATES)]
    words += ["--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--jobs", "1", "--quiet"]
    with contextlib.redirect_stdout(io.StringIO()):
        code = su3d_bench([*words, "--out", str(folder)])
    assert code == 0, f"the run ended with {code}"
    return folder


def slowed(folder: Path) -> Path:
    """The run with its method made slower, as if recorded that way."""
    for path in folder.rglob("updates.csv"):
        rows = list(csv.DictReader(path.open()))
        if not rows:  # of a method without updates
            continue
        for row in rows:
            row["method_ms"] = str(SLOWER * float(row["method_ms"]))
        with path.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        done = path.with_name("done.json")
        record = json.loads(done.read_text())
        record["steps"]["predict"]["files"][path.name] = digest_file(path)
        done.write_text(json.dumps(record))
    return folder


def updates_of(folder: Path) -> float:
    """The cost of the run's updates."""
    cost = method_cost(read_run(folder), "opensu3d")
    assert cost is not None, "the run has no cost"
    return cost.updates


def verdict_of(folder: Path, reference: Reference) -> list[str]:
    verdict = check(read_run(folder), reference)
    return [] if verdict.is_passed else plain_lines(verdict)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=50, help="number of checked runs (default: 50)")
    parser.add_argument("--scene", default="rooms/bathroom0", help="(default: rooms/bathroom0)")
    parser.add_argument("--json", type=Path, help="also write the table to FILE")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        taught = [read_run(made(arguments.scene, folder / f"taught{k}")) for k in range(TAUGHT)]
        reference = learn(taught)
        ratios, failed, n_caught = [], [], 0
        for k in range(arguments.repeats):
            run = made(arguments.scene, folder / f"repeat{k}")
            ratios.append(updates_of(run) / reference.costs["opensu3d"].updates)
            failed += verdict_of(run, reference)
            n_caught += bool(verdict_of(slowed(run), reference))
    low, high = min(ratios), max(ratios)
    print("\n".join([*failed, f"{arguments.repeats} repeats, {len(failed) // 2} failed; cost {low:.2f} to {high:.2f}"]))
    print(f"{n_caught} of them are detected when made slower by half")
    if arguments.json is not None:
        rows = [["unchanged", str(arguments.repeats), str(len(failed) // 2), f"{low:.2f} to {high:.2f}"]]
        rows.append([f"the method {SLOWER:g} times slower", str(arguments.repeats), str(n_caught), "-"])
        notes = [f"The first {TAUGHT} runs created the reference; costs up to {COST_LIMIT:g} times its own pass."]
        write_measured(
            arguments.json, "Regression check on repeats of one run", "python benchmarks regression_check_repeats",
            ["runs", "number", "failed", "cost of the updates, times the reference's"], rows, notes,
        )  # fmt: skip
    return int(bool(failed) or n_caught < arguments.repeats)


if __name__ == "__main__":
    sys.exit(main())
