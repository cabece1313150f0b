"""Coverage of 95 % intervals, over benchmarks drawn from worlds with known true values, and errors of the paired test.

``python benchmarks coverage_of_intervals [--simulations 2000] [--write docs/numbers/interval-coverage.md]`` prints the
tables of that page and, with ``--write``, updates them; four minutes on one idle core. Exit code 1: a cell of the first
table is below 90.

The true value is that of the metric over very many scenes and, for AP of rare classes, also its expectation over as
many scenes as were measured. ``coverage_worlds`` has the worlds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from coverage_worlds import AlikeRooms, Instances, ReplicaRooms, SceneMeans, Semantic, Shares, sigmoid

from su3d_bench.core.types import BoolArray, Float64Array, Interval
from su3d_bench.human_eval.answers import krippendorff_alphas
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.numerics.statistics import (
    ALPHA,
    DIFFERENCE,
    MIN_ITEMS,
    SHARE,
    jackknife_interval,
    leave_one_out,
    mean_interval,
    pseudo_values,
    share_interval,
    sign_flip_test,
    t_quantile,
)
from su3d_bench.reports.tables.formats import aligned

BEGIN, END = "<!-- coverage: written by benchmarks/numbers/coverage_of_intervals.py -->", "<!-- end of coverage -->"
LOW, HIGH, MIN_COVERAGE = 93.0, 97.0, 90.0  # per cent: target range, and the minimum to show an interval
N_ALTERNATIVES, N_RESAMPLES = 8, 400  # scenes at which other intervals are simulated, and resamples of the bootstraps
WORLDS: tuple[Callable[[], Any], ...] = (Semantic, SceneMeans, Shares, Instances)
REASONS: Mapping[str, str] = {
    "mAcc": "a class in few scenes weighs as much as any other",
    "F-mIoU": "a few large classes dominate",
    "pooled AP": "AP of few instances is biased upwards",
    "pooled AP50": "AP of few instances is biased upwards",
    "mean of scenes": "the scenes' values are skewed",
    "correct answers": "scenes with many questions dominate",
}
AP = "pooled AP"
RARE: Mapping[str, Callable[[], Instances]] = {"rooms differ": ReplicaRooms, "rooms alike": AlikeRooms}


@dataclass
class Simulated:
    """The values of simulated benchmarks, and their intervals by kind; (NaN, NaN) for none."""

    values: list[float] = field(default_factory=list)
    intervals: dict[str, list[Interval]] = field(default_factory=dict)

    def add(self, kind: str, interval: Interval | None) -> None:
        self.intervals.setdefault(kind, []).append(interval or (np.nan, np.nan))

    def coverage(self, kind: str, true_value: float) -> float:
        """The percentage of the intervals that contain ``true_value``; NaN without intervals."""
        low, high = np.array(self.intervals.get(kind, [])).reshape(-1, 2).T
        return 100.0 * float(((low <= true_value) & (true_value <= high)).mean()) if len(low) else float("nan")


JACKKNIFE, PSEUDO, LOGIT = "jackknife t (used)", "bias-corrected jackknife t", "jackknife t of the logit"
PERCENTILE, BCA, BY_CLASS = "percentile bootstrap", "BCa bootstrap", "jackknife per class"
KINDS = (JACKKNIFE, PSEUDO, LOGIT, PERCENTILE, BCA, BY_CLASS)


def add_alternatives(found: Simulated, without_each: Float64Array, resampled: Float64Array) -> None:
    """Add the other intervals of a value, from its ``without_each`` (1 + S,) and bootstrap values (B,)."""
    pseudo = pseudo_values(without_each)
    half = t_quantile(0.975, len(pseudo) - 1) * pseudo.std(ddof=1) / np.sqrt(len(pseudo))
    found.add(PSEUDO, (max(0.0, pseudo.mean() - half), min(1.0, pseudo.mean() + half)))
    inside = np.clip(without_each, 1e-4, 1 - 1e-4)
    of_logit = jackknife_interval(np.log(inside / (1 - inside)), bounds=(-np.inf, np.inf))
    found.add(LOGIT, None if of_logit is None else tuple(sigmoid(np.array(of_logit))))
    found.add(PERCENTILE, tuple(np.nanquantile(resampled, [0.025, 0.975])))
    found.add(BCA, bca_interval(without_each, resampled))


def bca_interval(without_each: Float64Array, resampled: Float64Array) -> Interval:
    """The bias-corrected and accelerated bootstrap interval (Efron and Tibshirani, 1993, chapter 14)."""
    from scipy.special import ndtr, ndtri

    whole, left_out = without_each[0], without_each[1:]
    below = (np.mean(resampled < whole) + np.mean(resampled <= whole)) / 2
    bias = ndtri(np.clip(below, 1 / len(resampled), 1 - 1 / len(resampled)))
    change = left_out.mean() - left_out
    acceleration = (change**3).sum() / max(6 * (change**2).sum() ** 1.5, 1e-30)
    shifted = bias + ndtri(np.array([0.025, 0.975]))
    low, high = np.nanquantile(resampled, ndtr(bias + shifted / (1 - acceleration * shifted)))
    return float(low), float(high)


def by_class_interval(values: Float64Array, has_class: BoolArray) -> Interval:
    """A t interval whose variance is the sum over independent classes, each jackknifed over the scenes that have it.

    ``values`` (1 + S, C) of the classes, ``has_class`` (S, C). A class in one scene has the variance between classes.
    """
    used = np.flatnonzero(has_class.any(axis=0))
    between = float(values[0, used].var())
    variances = np.full(len(used), between)
    for k, c in enumerate(used):
        own = np.flatnonzero(has_class[:, c])
        if len(own) > 1:
            pseudo = pseudo_values(np.concatenate([values[:1, c], values[1 + own, c]]))
            variances[k] = pseudo.var(ddof=1) / len(own)
    middle = float(values[0, used].mean())
    half = t_quantile(0.975, len(has_class) - 1) * float(np.sqrt(variances.sum())) / len(used)
    return max(0.0, middle - half), min(1.0, middle + half)


def simulate(world: Any, n_scenes: int, n_simulations: int, seed: int) -> dict[str, Simulated]:
    """Metric -> its intervals over ``n_simulations`` benchmarks of ``n_scenes``; all kinds at ``N_ALTERNATIVES``."""
    rng, bootstrap = np.random.default_rng([seed, n_scenes]), np.random.default_rng([seed, n_scenes, 1])
    weights = leave_one_out(n_scenes)
    found = {name: Simulated() for name in (*world.names, *(f"{name}, difference" for name in world.names))}
    for _ in range(n_simulations):
        methods = world.draw(rng, n_scenes)
        values = [world.values(counts, weights) for counts in methods]
        for name in world.names:
            own, change = values[0][name], values[1][name] - values[0][name]
            found[name].values.append(float(own[0]))
            found[name].add(JACKKNIFE, jackknife_interval(own, bounds=SHARE))
            found[f"{name}, difference"].add(JACKKNIFE, jackknife_interval(change, bounds=DIFFERENCE))
        if n_scenes == N_ALTERNATIVES:
            drawn = bootstrap.multinomial(n_scenes, np.full(n_scenes, 1.0 / n_scenes), size=N_RESAMPLES)
            resampled = world.values(methods[0], drawn)
            for name in world.names:
                add_alternatives(found[name], values[0][name], resampled[name])
            if isinstance(world, Instances):
                has_class = np.array([one.n_truth > 0 for one in methods[0]])
                for name, of_class in world.class_values(methods[0]).items():
                    found[name].add(BY_CLASS, by_class_interval(of_class, has_class))
    return found


@dataclass
class Study:
    """The true values of a world by metric, and its simulations by number of scenes and metric."""

    truth: Mapping[str, float]
    of_size: dict[int, dict[str, Simulated]]


def study(world: Any, sizes: Sequence[int], n_simulations: int, seed: int) -> Study:
    of_size = {}
    for n_scenes in sizes:
        print(f"{type(world).__name__}: {n_scenes} scenes", file=sys.stderr)
        of_size[n_scenes] = simulate(world, n_scenes, n_simulations, seed)
    return Study(world.truth(np.random.default_rng([seed, 0])), of_size)


def over_scenes(sizes: Sequence[int], n_simulations: int, seed: int) -> Iterator[str]:
    """The tables of intervals over scenes, and remarks on their cells."""
    studies = [study(make(), sizes, n_simulations, seed) for make in WORLDS]
    rare = {name: study(make(), sizes, n_simulations // 2, seed) for name, make in RARE.items()}
    table = {
        name: {n: one.of_size[n][name].coverage(JACKKNIFE, true_value) for n in sizes}
        for one in studies
        for name, true_value in one.truth.items()
    }
    rows = [[name, *(_marked(table[name][n]) for n in sizes)] for name in table]
    yield from aligned([["coverage, %", *(f"{n} scenes" for n in sizes)], *rows])
    yield f"\n{_error(n_simulations)}"
    missed = {name: [n for n in sizes if _is_missed(row[n])] for name, row in table.items()}
    yield "In italics: outside 93 to 97." if any(missed.values()) else "All are within 93 to 97."
    of_change = [
        one.of_size[n][f"{name}, difference"].coverage(JACKKNIFE, 0.0)
        for one in (*studies, *rare.values())
        for n in sizes
        for name in one.truth
    ]
    yield f"Differences of two equally good methods, also with rare classes: {_range(of_change)}."
    for name, of_sizes in missed.items():
        if of_sizes:
            yield f"\n- {name} at {', '.join(map(str, of_sizes))} scenes: {REASONS[name]}."
    refused = [(name, n) for name, row in table.items() for n in sizes if row[n] < MIN_COVERAGE]
    where = ", ".join(f"{name} at {n} scenes" for name, n in refused)
    yield (f"\nBelow 90: {where}.\n" if refused else "\nAll of these are at least 90.\n")
    yield from rare_classes(rare, sizes)
    if N_ALTERNATIVES in sizes:
        yield from alternatives(studies, rare)


def rare_classes(rare: Mapping[str, Study], sizes: Sequence[int]) -> Iterator[str]:
    """The table of AP of 48 classes: its bias, and the coverage of its two true values."""
    rows = []
    for name, one in rare.items():
        many, found = one.truth[AP], {n: one.of_size[n][AP] for n in sizes}
        own = {n: float(np.mean(found[n].values)) for n in sizes}
        rows.append([f"{name}, S scenes", *(_marked(found[n].coverage(JACKKNIFE, own[n])) for n in sizes)])
        rows.append([f"{name}, very many scenes", *(_marked(found[n].coverage(JACKKNIFE, many)) for n in sizes)])
        rows.append([f"{name}, bias in points", *(f"{100 * (own[n] - many):+.1f}" for n in sizes)])
    yield "AP of 48 classes (see Rare classes); true value: AP of S or of very many scenes:\n"
    yield from aligned([["coverage, %", *(f"{n} scenes" for n in sizes)], *rows])
    yield f"\n{_error(len(found[sizes[0]].values))}"


def alternatives(studies: Sequence[Study], rare: Mapping[str, Study]) -> Iterator[str]:
    """The table of other intervals, at ``N_ALTERNATIVES`` scenes."""
    of_rare = [(one.of_size[N_ALTERNATIVES][AP], one.truth[AP]) for one in rare.values()]
    rows = []
    for kind in KINDS:
        of_worlds = [
            one.of_size[N_ALTERNATIVES][name].coverage(kind, true_value)
            for one in studies
            for name, true_value in one.truth.items()
        ]
        own = [found.coverage(kind, float(np.mean(found.values))) for found, _ in of_rare]
        many = [found.coverage(kind, true_value) for found, true_value in of_rare]
        rows.append([kind, *map(_cell, (float(np.nanmin(of_worlds)), *own, *many))])
    header = [f"{name.removeprefix('rooms ')}, {which}" for which in ("S scenes", "very many") for name in rare]
    yield f"\nIntervals at {N_ALTERNATIVES} scenes, {N_RESAMPLES} resamples (`first table`: its lowest at 8):\n"
    yield from aligned([["coverage, %", "first table", *header], *rows])
    yield ""


DIFFERENCES: Mapping[str, Callable[[np.random.Generator, tuple[int, int]], Float64Array]] = {
    "normal, skewness 0": lambda rng, shape: rng.normal(size=shape),
    "exponential, skewness 2": lambda rng, shape: rng.exponential(size=shape) - 1.0,
    "lognormal, skewness 6": lambda rng, shape: rng.lognormal(size=shape) - np.exp(0.5),
}
PAIRS = (8, 20, 30)


def of_test(n_simulations: int, seed: int) -> Iterator[str]:
    """The table of how often the sign-flip test rejects differences whose mean is 0."""
    rng = np.random.default_rng([seed, 2])
    rows = []
    for name, drawn in DIFFERENCES.items():
        tests = [[sign_flip_test(row) for row in drawn(rng, (n_simulations, n))] for n in PAIRS]
        rows.append([name, *(_cell(100 * float(np.mean([t is not None and t.p < ALPHA for t in of]))) for of in tests)])
    yield "How often the sign-flip test rejects at 5 % if the mean difference is 0:\n"
    yield from aligned([["rejected, %", *(f"{n} scenes" for n in PAIRS)], *rows])
    yield ""


def _error(n: int) -> str:
    return f"{n} simulations per cell (standard error {100 * (0.0475 / n) ** 0.5:.1f})."


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def _cell(value: float) -> str:
    return f"{value:.1f}"


def _is_missed(value: float) -> bool:
    return not LOW <= round(value, 1) <= HIGH


def _marked(value: float) -> str:
    return f"*{_cell(value)}*" if _is_missed(value) else _cell(value)


ITEMS = (10, 20, 50, 200)
RATES = (0.5, 0.9, 0.98)


def over_items(n_simulations: int, seed: int) -> Iterator[str]:
    """The table of intervals over items: Wilson's, computed exactly; those of changes and agreement, simulated."""
    rng = np.random.default_rng([seed, 1])
    rows = [[f"true proportion {rate:g}", *(_marked(100 * wilson(rate, n)) for n in ITEMS)] for rate in RATES]
    for name, simulated in (("paired change", change), ("Krippendorff's alpha, 3 annotators", agreement)):
        rows.append([name, *(_marked(100 * simulated(rng, n, n_simulations)) for n in ITEMS)])
    yield "Intervals over items (see below):\n"
    yield from aligned([["coverage, %", *(f"{n} items" for n in ITEMS)], *rows])
    few = [f"{100 * simulated(rng, 5, n_simulations):.1f}" for simulated in (change, agreement)]
    yield (
        "\nThe coverage of proportions oscillates because counts are integers (Brown, Cai and DasGupta). The other two "
        f"rows have no interval below {MIN_ITEMS} items (with 5, coverage would be {few[0]} and {few[1]} %)."
    )


def wilson(rate: float, n: int) -> float:
    """Coverage of the interval of a share at ``rate``, over all possible observations."""
    from scipy.stats import binom

    covered = [(interval := share_interval(k / n, n)) and interval[0] <= rate <= interval[1] for k in range(n + 1)]
    return float(binom.pmf(np.arange(n + 1), n, rate) @ np.array(covered, np.float64))


def change(rng: np.random.Generator, n: int, n_simulations: int) -> float:
    """Items of which 25 % become correct and 15 % wrong."""
    values = rng.choice([1.0, -1.0, 0.0], (n_simulations, n), p=[0.25, 0.15, 0.6])
    intervals = [mean_interval(row, DIFFERENCE) for row in values]
    return float(np.mean([interval is not None and interval[0] <= 0.1 <= interval[1] for interval in intervals]))


def agreement(rng: np.random.Generator, n: int, n_simulations: int) -> float:
    """Three annotators, correct in 90 % of two equally frequent answers: alpha is 0.8 squared."""
    n_held = 0
    for _ in range(n_simulations):
        truth = rng.random(n) < 0.5
        yes = (truth[:, None] ^ (rng.random((n, 3)) < 0.1)).sum(axis=1)
        counts = np.stack([yes, 3 - yes], axis=1).astype(np.int64)
        interval = jackknife_interval(krippendorff_alphas(counts, leave_one_out(n)), bounds=DIFFERENCE)
        n_held += interval is not None and interval[0] <= 0.64 <= interval[1]
    return n_held / n_simulations


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulations", type=int, default=2000)
    parser.add_argument("--scenes", type=int, nargs="+", default=[2, 4, 8, 20, 100])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, metavar="FILE", help="update the tables between the markers in this page")
    given = parser.parse_args(arguments)
    instance_ap.MANY_ROWS = 0  # use the compiled loops of large runs, ten times as fast
    size = (given.simulations, given.seed)
    lines = [*over_scenes(given.scenes, *size), *of_test(*size), *over_items(*size)]
    text = "\n".join(lines)
    print(text)
    if given.write is not None:
        page = given.write.read_text(encoding="utf-8")
        before, _, rest = page.partition(BEGIN)
        given.write.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}", encoding="utf-8")
    return int("\nBelow 90: " in text)


if __name__ == "__main__":
    sys.exit(main())
