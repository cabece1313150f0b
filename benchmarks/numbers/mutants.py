"""Mutation testing of metrics, statistics, comparison and regression check: do the module's tests notice a fault?

    python benchmarks mutants --mutants 600
    python benchmarks mutants --mutants 40 --seed 3 --modules analysis/regression_check.py

Every place in a module where one operator, constant, condition or statement can be replaced is a mutant; a sample of
them is drawn by ``--seed``. Each is written into a copy of the files tracked by git, and the module's tests are run
there until one fails. A mutant that passes all tests survives. ``mutants.toml`` next to this file explains
survivors that no test can or need kill; the exit status is 1 if a survivor has no explanation, or if more than
``MAX_SURVIVE`` survive. Uncommitted changes of tracked files count.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from folders import ROOT
from measured import write_measured
from planted_faults import Mutant, mutants_of, planted

REASONS = Path(__file__).with_suffix(".toml")
PACKAGE = "su3d_bench"
MAX_SURVIVE = 0.05
LONGEST = 10.0  # times the normal duration of the module's tests: longer is an infinite loop, which is noticed
MIN_S = 60.0

_EVERY = ("test_every_protocol", "test_counts")
_CURVES = ("test_metrics_instance", "test_metrics_kernels", "test_metrics_class_agnostic", "test_metrics_undefined")
_SCORES = ("test_metrics_scoring", "test_metrics_results", *_EVERY, "numerics/test_statistics")
_TRANSFER = ("test_metrics_transfer", "test_metrics_neighbours", *_SCORES)
_TEXTS = ("test_metrics_queries", "test_metrics_openlex3d", *_EVERY, "test_openlex3d_original")
_QUESTIONS = (
    "test_annotation_protocol", "test_retrieval_protocol", "test_presence_protocol", "test_grounding_protocol",
    "test_counts", "questions/test_reasoning_solver",
)  # fmt: skip
_PROTOCOLS = ("test_protocols", "test_protocol_files", "test_metrics_scoring", "evaluation/test_evaluate")
_COMPARE = tuple(f"analysis/test_compare{name}" for name in ("_pairs", ""))
_GATE = tuple(f"analysis/regression_check/test_regression_{name}" for name in ("check", "costs"))
# For each module, or all in a folder, the tests that must notice: the fast ones first. Names without a folder are
# in tests/metrics or below.
GUARDS: dict[str, tuple[str, ...]] = {
    "metrics/graphs.py": ("test_hovsg_graphs", "test_counts"),
    "metrics/instance/": (*_CURVES, *_SCORES),
    "metrics/semantic/": ("test_metrics_semantic", "test_metrics_undefined", "test_metrics_hovsg", *_SCORES),
    "metrics/semantic/panoptic.py": ("test_panoptic_protocol", "test_panoptic_labelled_points", *_EVERY),
    "metrics/semantic/top_k.py": ("test_metrics_scannetpp", *_EVERY),
    "metrics/relations.py": ("test_relation_protocol", *_EVERY),
    "metrics/protocols/loading.py": ("test_originals",),
    "metrics/matching/checks.py": (*_SCORES, "evaluation/test_evaluate_checks", "evaluation/test_evaluate"),
    "metrics/matching/labelling.py": (*_TRANSFER, "test_metrics_hovsg", "opensu3d/test_device_results"),
    "metrics/matching/": _TRANSFER,
    "metrics/open_vocabulary/": _TEXTS,
    "metrics/questions/grounding.py": ("test_chain_protocol", "test_grounding_protocol", "questions/test_beacon3d"),
    "metrics/questions/": _QUESTIONS,
    "metrics/attribution/": ("analysis/test_attribution", "analysis/test_attribution_runs"),
    "metrics/identity.py": ("test_identity",),
    "metrics/changes.py": ("metrics/test_changes", "analysis/test_changes_report"),
    "metrics/tracked_points.py": ("test_identity",),
    "metrics/seen.py": ("test_seen_truth", "runs/test_seen_so_far"),
    "metrics/costs.py": ("reports/test_timing_report", "analysis/test_cost_quality"),
    "metrics/compatibility.py": (*_PROTOCOLS, "evaluation/test_labels_counted"),
    "metrics/protocols/": _PROTOCOLS,
    "metrics/metric.py": ("test_metrics_undefined", *_SCORES, "analysis/test_compare_pairs"),
    "metrics/scoring.py": ("test_metrics_undefined", *_SCORES),
    "numerics/statistics.py": (
        "numerics/test_statistics", "test_metrics_undefined", *_COMPARE,
    ),
    "analysis/comparison.py": (*_COMPARE, "analysis/test_planning"),
    "analysis/sides.py": (*_COMPARE, "analysis/test_planning"),
    "analysis/regression_check.py": _GATE,
    "runs/verify.py": ("analysis/regression_check/test_regression_check", "analysis/test_leaderboard"),
}  # fmt: skip


def _turn(mutant: Mutant, seed: int) -> str:
    """Its position in the draw: a separate number, so that changes in other code do not affect the draw."""
    return hashlib.sha256(repr((seed, *mutant.key)).encode()).hexdigest()


def guards_of(module: str) -> tuple[str, ...]:
    """The test files that must notice a fault in a module."""
    inside = module.removeprefix(f"{PACKAGE}/")
    row = max((one for one in GUARDS if inside == one or (one.endswith("/") and inside.startswith(one))), key=len)
    return tuple(_test_file(name) for name in dict.fromkeys(GUARDS[row]))


def _test_file(name: str) -> str:
    tests = ROOT / "tests"
    path = tests / f"{name}.py" if "/" in name else next((tests / "metrics").rglob(f"{name}.py"))
    return str(path.relative_to(ROOT))


def modules_of(wanted: Sequence[str]) -> list[str]:
    """The guarded modules whose path contains one of ``wanted``, or all."""
    found = []
    for row in GUARDS:
        path = ROOT / PACKAGE / row
        files = sorted(path.rglob("*.py")) if row.endswith("/") else [path]
        found += [str(file.relative_to(ROOT)) for file in files if file.stat().st_size]
    chosen = [module for module in dict.fromkeys(found) if not wanted or any(word in module for word in wanted)]
    return sorted(chosen)


# ---- copies in which the tests run


def copy_tree(target: Path) -> None:
    """Copy the files tracked by git as they are on disk, links as links."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode()
    for name in filter(None, listed.split("\0")):
        source = ROOT / name
        if not source.is_symlink() and not source.is_file():
            continue
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target / name, follow_symlinks=False)


class Copy:
    """A copy of the tree into which one fault at a time is planted."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stamp = int(time.time())
        copy_tree(folder)

    def write(self, module: str, text: str) -> None:
        path = self.folder / module
        path.write_text(text, encoding="utf-8")
        # compiled modules are identified by size and this time in whole seconds, and mutants follow fast
        self._stamp += 2
        os.utime(path, (self._stamp, self._stamp))

    def passes(self, tests: Sequence[str], limit_s: float) -> bool | None:
        """Whether all ``tests`` pass; None if they take longer than ``limit_s``."""
        options = ["-x", "-q", "-p", "no:cacheprovider", f"--basetemp={self.folder / '.tests'}"]
        environment = os.environ | {"PYTHONPATH": str(self.folder), "HYPOTHESIS_STORAGE_DIRECTORY": os.devnull}
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return process.wait(timeout=limit_s) == 0
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


@dataclass(frozen=True)
class Verdict:
    """The result of a mutant: ``killed``, ``timed out`` (and so noticed) or ``survived``."""

    mutant: Mutant
    outcome: str
    seconds: float


def run_mutants(mutants: Sequence[Mutant], n_copies: int, folder: Path) -> Iterator[Verdict]:
    """Verdicts as they come; ``RuntimeError`` if the tests fail without any fault."""
    copies: queue.Queue[Copy] = queue.Queue()
    for index in range(n_copies):
        copies.put(Copy(folder / f"copy{index}"))
    limits: dict[tuple[str, ...], float] = {}
    first = copies.get()
    for tests in dict.fromkeys(guards_of(mutant.module) for mutant in mutants):
        begin = time.monotonic()
        if not first.passes(tests, 3600.0):
            raise RuntimeError(f"these fail without a fault: {' '.join(tests)}")
        limits[tests] = max(MIN_S, LONGEST * (time.monotonic() - begin))
    copies.put(first)

    def judge(mutant: Mutant) -> Verdict:
        copy, begin = copies.get(), time.monotonic()
        source = (ROOT / mutant.module).read_text(encoding="utf-8")
        tests = guards_of(mutant.module)
        try:
            copy.write(mutant.module, planted(source, mutant))
            passed = copy.passes(tests, limits[tests])
        finally:
            copy.write(mutant.module, source)
            copies.put(copy)
        outcome = "timed out" if passed is None else "survived" if passed else "killed"
        return Verdict(mutant, outcome, time.monotonic() - begin)

    with ThreadPoolExecutor(n_copies) as threads:
        yield from threads.map(judge, mutants)


# ---- reasons and report


def read_reasons(path: Path) -> dict[tuple[str, str, str, str], str]:
    """Explanations of survivors, by key."""
    if not path.is_file():
        return {}
    rows = tomllib.loads(path.read_text(encoding="utf-8")).get("survivor", [])
    return {(row["module"], row["where"], row["before"], row["after"]): row["why"] for row in rows}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=600, help="number of mutants to draw")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--modules", nargs="+", default=[], help="only modules whose path contains one of these")
    parser.add_argument("--copies", type=int, default=os.cpu_count() or 1, help="number of parallel copies")
    parser.add_argument("--json", type=Path, help="JSON file for the table")
    parser.add_argument("--list", action="store_true", help="print the drawn mutants and exit")
    arguments = parser.parse_args()
    every = [
        mutant
        for module in modules_of(arguments.modules)
        for mutant in mutants_of(module, (ROOT / module).read_text(encoding="utf-8"))
    ]
    drawn = sorted(every, key=lambda mutant: _turn(mutant, arguments.seed))[: arguments.mutants]
    print(
        f"{len(drawn)} of {len(every)} mutants of {len(modules_of(arguments.modules))} modules, seed {arguments.seed}"
    )
    if arguments.list:
        print(*drawn, sep="\n")
        return 0
    verdicts = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for verdict in run_mutants(drawn, arguments.copies, Path(folder)):
            verdicts.append(verdict)
            if verdict.outcome != "killed":
                print(f"{verdict.outcome}: {verdict.mutant}", flush=True)
    return report(verdicts, arguments)


def report(verdicts: Sequence[Verdict], arguments: argparse.Namespace) -> int:
    """Print survivors with their explanations; 1 if one has none or there are too many."""
    reasons = read_reasons(REASONS)
    survivors = [verdict.mutant for verdict in verdicts if verdict.outcome == "survived"]
    unexplained = [mutant for mutant in survivors if mutant.key not in reasons]
    share = len(survivors) / max(1, len(verdicts))
    print(f"\n{len(survivors)} of {len(verdicts)} survived ({100 * share:.1f} %; {100 * MAX_SURVIVE:g} % may)")
    for mutant in survivors:
        print(f"  {mutant}\n      {reasons.get(mutant.key, 'NO REASON in benchmarks/numbers/mutants.toml')}")
    if arguments.json:
        rows: list[list[str]] = []
        for module in dict.fromkeys(sorted(verdict.mutant.module for verdict in verdicts)):
            own = [verdict.outcome for verdict in verdicts if verdict.mutant.module == module]
            counts = [own.count(outcome) for outcome in ("killed", "timed out", "survived")]
            rows.append([module, str(len(own)), *map(str, counts)])
        command = f"python benchmarks mutants --mutants {arguments.mutants} --seed {arguments.seed}"
        notes = [
            f"`{mutant.module}`, `{mutant.where}`: `{mutant.before}` as `{mutant.after}`: "
            f"{reasons.get(mutant.key, 'no reason given')}"
            for mutant in survivors
        ]
        columns = ("module", "mutants", "killed", "timed out", "survived")
        write_measured(arguments.json, "Planted faults", command, columns, rows, notes)
    return int(bool(unexplained) or share > MAX_SURVIVE)


if __name__ == "__main__":
    sys.exit(main())
