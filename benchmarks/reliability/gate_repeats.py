"""Whether the gate passes unchanged repeats of a real run, with the times that this machine really takes.

``python benchmarks gate_repeats [--repeats 50] [--json build/measured/gate_repeats.json]``: the same small run again
and again, OpenSU3D with perfect masks on the forty updates of a room; the first five teach the reference, the
others are checked against it, and each once more with a method slower by half, which must fail. Some seconds per run.
Exit code 1 where a repeat fails or a slower one passes.
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

from su3d_bench.analysis.gate import COST_LIMIT, Reference, check, learn, method_cost
from su3d_bench.cli.main import main as su3d_bench
from su3d_bench.core.digests import digest_file
from su3d_bench.reports.gate import plain_lines
from su3d_bench.runs.finished import read_run

TAUGHT, N_UPDATES, SLOWER = 5, 40, 1.5


def made(scene: str, folder: Path) -> Path:
    """One run of the request, made again."""
    words = ["run", "--scenes", scene, "--methods", "opensu3d", "--profile", "oracle", "--limit", str(N_UPDATES)]
    words += ["--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--jobs", "1", "--quiet"]
    with contextlib.redirect_stdout(io.StringIO()):
        code = su3d_bench([*words, "--out", str(folder)])
    assert code == 0, f"the run ended with {code}"
    return folder


def slowed(folder: Path) -> Path:
    """The run with its method made slower, as if it had been written so."""
    for path in folder.rglob("updates.csv"):
        rows = list(csv.DictReader(path.open()))
        if not rows:  # of a method that looks at no frame
            continue
        for row in rows:
            row["method_ms"] = str(SLOWER * float(row["method_ms"]))
        with path.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        done = path.with_name("done.json")
        sealed = json.loads(done.read_text())
        sealed["steps"]["predict"]["files"][path.name] = digest_file(path)
        done.write_text(json.dumps(sealed))
    return folder


def updates_of(folder: Path) -> float:
    """What the updates of the run cost."""
    cost = method_cost(read_run(folder), "opensu3d")
    assert cost is not None, "the run has no cost"
    return cost.updates


def verdict_of(folder: Path, reference: Reference) -> list[str]:
    verdict = check(read_run(folder), reference)
    return [] if verdict.is_passed else plain_lines(verdict)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=50, help="checked runs (default: 50)")
    parser.add_argument("--scene", default="rooms/bathroom0", help="(default: rooms/bathroom0)")
    parser.add_argument("--json", type=Path, help="write what was measured there")
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
    print(f"{n_caught} of them are caught when made slower by half")
    if arguments.json is not None:
        rows = [["unchanged", str(arguments.repeats), str(len(failed) // 2), f"{low:.2f} to {high:.2f}"]]
        rows.append([f"the method {SLOWER:g} times slower", str(arguments.repeats), str(n_caught), "-"])
        notes = [
            f"The first {TAUGHT} of the runs taught the reference; a cost up to {COST_LIMIT:g} times its own passes."
        ]
        write_measured(
            arguments.json, "The gate and repeats of one run", "python benchmarks gate_repeats",
            ["runs", "number", "failed", "cost of the updates, times the reference's"], rows, notes,
        )  # fmt: skip
    return int(bool(failed) or n_caught < arguments.repeats)


if __name__ == "__main__":
    sys.exit(main())
