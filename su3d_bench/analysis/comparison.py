"""Comparison of two runs: differences per metric, scene and class with intervals and tests, and power analysis.

Numbers are computed over the scenes that both runs have. Significance comes from the exact sign-flip test of per-scene
differences; the interval is a jackknife over scenes. A side of several runs is their mean, reported with the standard
deviation over seeds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis import sides
from su3d_bench.core.errors import ConfigError, counted, printable, some
from su3d_bench.core.types import BoolArray, Float64Array, Interval
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import ANSWERED_BY, REFINED_BY, RELATIVE, remarks_starting
from su3d_bench.metrics.scoring import plain_json
from su3d_bench.numerics import statistics
from su3d_bench.runs.verify import read_checked

SCHEMA = 2


@dataclass(frozen=True)
class Difference:
    """One value on both sides, as fractions, NaN if undefined; ``difference`` is the second minus the first.

    ``per_scene`` holds the difference of each scene in which both have a value, ``mean_of_scenes`` their mean, which
    ``test`` tests. ``p_of_all``: its Holm-corrected p, over all values tested with it in which any scene differs: the
    headline metrics of a comparison, or the classes of a protocol. ``deviations_of_seeds``: standard deviation of one
    run's value over seeds, for each side; None if a side is one run.
    """

    left: float
    right: float
    difference: float
    interval: Interval | None
    per_scene: Mapping[str, float]
    mean_of_scenes: float
    test: statistics.SignFlipTest | None
    p_of_all: float | None = None
    deviations_of_seeds: tuple[float | None, float | None] = (None, None)

    @property
    def disagreement(self) -> str | None:
        """An explanation if the interval and the test seem to disagree; None if they agree.

        >>> test = SignFlipTest(p=0.25, smallest_p=0.25, n_pairs=3, is_exact=True)
        >>> Difference(0.5, 0.6, 0.1, (0.02, 0.18), {}, 0.1, test).disagreement
        'the interval excludes 0, but the smallest possible p with 3 scenes is 0.25: no significant difference'
        """
        if self.interval is None or self.test is None:
            return None
        leaves_out_zero = self.interval[0] > 0 or self.interval[1] < 0
        if leaves_out_zero and self.test.p < statistics.ALPHA:
            if (self.interval[0] > 0) == (self.mean_of_scenes > 0):
                return None
            return (
                f"B - A and the mean over scenes have opposite signs, both significant (p {self.test.p:.2g}): the test "
                "uses the mean over scenes, the interval uses B - A, in which scenes are weighted by their contents"
            )
        if leaves_out_zero == (self.test.p < statistics.ALPHA):
            return None
        if not leaves_out_zero:
            return (
                f"the test finds a difference (p {self.test.p:.2g}) of the mean over scenes, but the interval of B - A "
                "contains 0: the interval assumes normally distributed differences, the test does not"
            )
        if self.test.smallest_p >= statistics.ALPHA:
            return (
                f"the interval excludes 0, but the smallest possible p with {counted(self.test.n_pairs, 'scene')} is "
                f"{self.test.smallest_p:.3g}: no significant difference"
            )
        return (
            f"the interval leaves 0 out, but the test does not find a difference (p {self.test.p:.2g}): the interval "
            "takes the scenes' differences for normal, the test does not: no difference is shown"
        )


@dataclass(frozen=True)
class ProtocolComparison:
    """Two methods under one protocol over ``scenes``; ``classes`` is class -> column -> difference."""

    protocol: str
    version: int
    aggregate: str
    left: str
    right: str
    scenes: tuple[str, ...]
    metrics: Mapping[str, Difference]
    classes: Mapping[str, Mapping[str, Difference]]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """``remarks`` apply to whole runs: which are partial or incomplete, and in which settings they differ.

    ``seeds``: the seeds of the runs of each side.
    """

    left: str
    right: str
    seeds: tuple[tuple[int, ...], tuple[int, ...]]
    remarks: tuple[str, ...]
    protocols: tuple[ProtocolComparison, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON values in full precision, null if undefined."""
        return {"schema": SCHEMA, **plain_json({**vars(self), "protocols": list(map(_protocol_json, self.protocols))})}


def compare(
    left: str,
    right: str,
    *,
    method: str | None = None,
    protocols: Sequence[str] = (),
    per_class: bool = False,
    numbers: sides.SideNumbers | None = None,
) -> Comparison:
    """The differences of ``right`` from ``left``, each a run folder or ``FOLDER:METHOD``.

    Comma-separated folders are one side: runs that differ only in their seed, over which values are averaged. By
    default, methods of the same name are compared, or the only ones; pass the same ``numbers`` to repeated calls on the
    same runs. Raises ``ConfigError`` if the two cannot be compared, naming the first field that differs.
    """
    pairs = sides.pair_methods(sides.parse_side(left, method), sides.parse_side(right, method))
    return compare_pairs(pairs, protocols, per_class=per_class, numbers=numbers)


def compare_pairs(
    pairs: Sequence[tuple[sides.Side, sides.Side]],
    protocols: Sequence[str] = (),
    *,
    per_class: bool = False,
    numbers: sides.SideNumbers | None = None,
) -> Comparison:
    """As ``compare``, for pairs of sides that are already read."""
    first, second = pairs[0]
    compared: list[ProtocolComparison] = []
    for pair in pairs:
        compared += _compare_methods(*pair, protocols, per_class, numbers or sides.SideNumbers())
    of_all = _of_all([protocol.metrics for protocol in compared])
    compared = [replace(protocol, metrics=metrics) for protocol, metrics in zip(compared, of_all, strict=True)]
    every = [side for pair in pairs for side in pair]
    remarks = _remarks(first, second, {side.method for side in every})
    remarks += [line for side in every for of_run in side.each for line in _caveats(of_run)]
    left_name, right_name = (", ".join(run.name for run in side.runs) for side in (first, second))
    left_seeds, right_seeds = (tuple(run.record.seed or 0 for run in side.runs) for side in (first, second))
    return Comparison(left_name, right_name, (left_seeds, right_seeds), tuple(dict.fromkeys(remarks)), tuple(compared))


def _compare_methods(
    left: sides.Side, right: sides.Side, wanted: Sequence[str], per_class: bool, numbers: sides.SideNumbers
) -> list[ProtocolComparison]:
    every = [*left.each, *right.each]
    compared = []
    for name in sides.protocols_in_both(left, right, wanted):
        over_scenes = numbers.over_common(name, every)
        if not over_scenes:
            raise ConfigError(
                f"{left.name} and {right.name}: have no common scene scored under {name}; compare runs of the same "
                "scenes"
            )
        rules, common = left.run.rules(name), over_scenes[0].result.scenes
        remarks = _remarks_of_scenes(every, name, [numbers.scores(side)[name] for side in every], common)
        of_left, of_right = over_scenes[: len(left.runs)], over_scenes[len(left.runs) :]
        metrics = {
            metric: difference_of(
                sides.headline_numbers(of_left, metric), sides.headline_numbers(of_right, metric), common
            )
            for metric in rules.headline
        }
        classes = _compare_classes(rules, (of_left, of_right), common) if per_class else {}
        about = (rules.name, rules.version, rules.aggregate, left.method, right.method, common)
        compared.append(ProtocolComparison(*about, metrics, classes, tuple(remarks)))
    return compared


def _compare_classes(
    rules: ProtocolRules,
    halves: tuple[Sequence[sides.OverScenes], Sequence[sides.OverScenes]],
    scenes: Sequence[str],
) -> dict[str, dict[str, Difference]]:
    left, right = (sides.class_numbers(rules, half) for half in halves)
    classes: dict[str, dict[str, Difference]] = {}
    for (name, column), own in left.items():
        if (name, column) in right:
            classes.setdefault(name, {})[column] = difference_of(own, right[name, column], scenes)
    return dict(zip(classes, _of_all(list(classes.values())), strict=True))


def _of_all(tables: Sequence[Mapping[str, Difference]]) -> list[dict[str, Difference]]:
    """The differences of ``tables``, each with its p corrected for all of them.

    A test in which no scene differs is not counted in the correction: there is no sign to flip.
    Source: Tarone, A modified Bonferroni method for discrete data, Biometrics 46 (1990).
    """
    every = [difference for table in tables for difference in table.values()]
    tested = [d.test.p if d.test is not None and any(d.per_scene.values()) else None for d in every]
    corrected = iter(statistics.holm(tested))
    return [{name: replace(value, p_of_all=next(corrected)) for name, value in table.items()} for table in tables]


def difference_of(left: sides.Numbers, right: sides.Numbers, scenes: Sequence[str]) -> Difference:
    """The difference of one value between two sides."""
    differences: Float64Array = right.of_scenes - left.of_scenes
    is_known = ~np.isnan(differences)
    without_each = right.without_each - left.without_each
    return Difference(
        left=left.value,
        right=right.value,
        difference=right.value - left.value,
        interval=statistics.jackknife_interval(without_each, is_known, bounds=statistics.DIFFERENCE),
        per_scene={scene: float(d) for scene, d in zip(scenes, differences, strict=True) if not np.isnan(d)},
        mean_of_scenes=float(differences[is_known].mean()) if is_known.any() else float("nan"),
        test=statistics.sign_flip_test(differences),
        deviations_of_seeds=(left.deviation_of_seeds, right.deviation_of_seeds),
    )


def _remarks_of_scenes(
    every: Sequence[sides.Side], protocol: str, scores: Sequence[Mapping[str, SceneScore]], common: Sequence[str]
) -> list[str]:
    """Remarks on scenes that not all runs have, failed scenes, and the models that answered or named."""
    lines = []
    for side, own in zip(every, scores, strict=True):
        if alone := [printable(scene, 80) for scene in own if scene not in common]:
            lines.append(f"only common scenes are compared; only {side.name} has {some(alone, 3)}")
    for side in every:
        record = side.run.results.get((side.method, protocol))
        if record is not None and record.failed:
            lines.append(
                f"INCOMPLETE: {side.name} failed on {some([printable(scene, 80) for scene in record.failed], 3)}"
            )
        warnings = () if record is None or record.result is None else record.result.warnings
        for start in (RELATIVE, ANSWERED_BY, REFINED_BY):
            lines += [f"{side.name}: {start}{printable(remark, 200)}" for remark in remarks_starting(warnings, start)]
    if every[0].run.rules(protocol).digest != every[0].run.protocols[protocol].digest:
        lines.append(f"the installed rules of {protocol} differ from those that scored both runs (same version)")
    return lines


def _caveats(side: sides.Side) -> list[str]:
    """Caveats on a side's perception, and whether a side is the ground truth itself."""
    if side.method not in side.run.methods:
        return [f"{side.name} is the ground truth itself, not a method"]
    caveats = [record.caveat for (method, _), record in side.run.results.items() if method == side.method]
    return [f"{side.name}: {printable(caveat)}" for caveat in caveats if caveat]


def _remarks(left: sides.Side, right: sides.Side, methods: Set[str]) -> list[str]:
    """Remarks on the runs, of which ``methods`` are compared."""
    lines = []
    for run in {run.name: run for side in (left, right) for run in side.runs}.values():
        if run.record.is_partial:
            lines.append(f"PARTIAL: {run.name} has only the first {counted(run.limit, 'frame')} of each scene")
        if run.is_incomplete:
            lines.append(f"INCOMPLETE: {run.name} lacks scenes that failed")
    aside = ("seed",) if left.others or right.others else ()
    if changed := sides.settings_that_differ(left.run, right.run, methods, aside):
        lines.append(
            "settings that differ: "
            + "; ".join(changed[:6])
            + (f" and {len(changed) - 6} more" if len(changed) > 6 else "")
        )
    if len({run.record.code for side in (left, right) for run in side.runs}) > 1:
        lines.append("the runs were produced by different versions of the code")
    return lines


def _protocol_json(protocol: ProtocolComparison) -> dict[str, Any]:
    metrics = {name: _difference_json(value) for name, value in protocol.metrics.items()}
    classes = {
        name: {column: _difference_json(value) for column, value in columns.items()}
        for name, columns in protocol.classes.items()
    }
    return {**vars(protocol), "metrics": metrics, "classes": classes}


def _difference_json(difference: Difference) -> dict[str, Any]:
    """The JSON values of a difference; a missing test has 0 pairs."""
    values = asdict(difference)
    test = values.pop("test") or {"p": None, "smallest_p": None, "n_pairs": 0, "is_exact": None}
    return {**values, **test, "disagreement": difference.disagreement}


PLAN_SCHEMA = 1
SEEDS = (1, 2, 3, 5, 10)  # numbers of seeds for which scenes are computed, if the runs have several seeds


@dataclass(frozen=True)
class Need:
    """The number of scenes, each with ``n_seeds`` seeds, that detects a difference of ``points`` per cent.

    None if no number does. ``low`` and ``high``: the numbers at the ends of the 95 % interval of the variance.
    """

    points: float
    n_seeds: int
    n_scenes: int | None
    low: int | None
    high: int | None


@dataclass(frozen=True)
class MetricPlan:
    """Power analysis of one metric: ``difference`` (second method minus first, a fraction), its ``interval`` over the
    scenes and seeds that were run, its variance and the scenes needed; no variance if nothing varies or too few scenes
    count."""

    difference: float
    interval: Interval | None
    variance: statistics.Variance | None
    needs: tuple[Need, ...]


@dataclass(frozen=True)
class Plan:
    """``protocols``: protocol -> metric -> plan; ``seeds``: the seeds of the runs."""

    left: str
    right: str
    runs: tuple[str, ...]
    seeds: tuple[int, ...]
    scenes: tuple[str, ...]
    power: float
    protocols: Mapping[str, Mapping[str, MetricPlan]]
    remarks: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """JSON values in full precision, null if undefined."""
        return {"schema": PLAN_SCHEMA, **plain_json(asdict(self))}


def plan(
    runs: Sequence[Path],
    methods: Sequence[str] = (),
    *,
    points: Sequence[float],
    protocols: Sequence[str] = (),
    power: float = statistics.POWER,
) -> Plan:
    """Power analysis for differences of ``points`` per cent between two methods, from ``runs`` differing only in seed.

    ``methods`` defaults to the runs' only two. Raises ``ConfigError`` if the runs do not match, have the same seed
    twice, or have too few scenes to estimate how differences vary.
    """
    for value in points:
        if not 0 < value <= 100:
            raise ConfigError(f"--points {value:g}: expected a percentage above 0 and at most 100")
    if not 0.05 < power < 1:
        raise ConfigError(f"--power {power:g}: expected a probability above 0.05 and below 1, such as 0.8")
    read = [read_checked(path) for path in dict.fromkeys(runs)]
    first = read[0]
    pair = tuple(methods) or first.methods
    if len(pair) != 2 or pair[0] == pair[1]:
        known = ", ".join(printable(name, 80) for name in first.methods)
        raise ConfigError(
            f"{first.name}: expected two different methods; name them with --methods A B (available: {known})"
        )
    every = [sides.Side(run, method) for run in read for method in pair]
    sides.check_same_requests(read, set(pair))
    numbers = sides.SideNumbers()
    plans: dict[str, dict[str, MetricPlan]] = {}
    scenes: dict[str, None] = {}
    for name in sides.protocols_in_both(every[0], every[1], protocols):
        found = numbers.over_common(name, every)
        n_scenes = len(found[0].result.scenes) if found else 0
        if n_scenes < 2:
            raise ConfigError(
                f"{first.name}: {counted(n_scenes, 'scene')} {'is' if n_scenes == 1 else 'are'} scored under {name} "
                "for both methods in every run; at least two scenes are needed"
            )
        over_scenes = list(zip(found[::2], found[1::2], strict=True))
        scenes |= dict.fromkeys(found[0].result.scenes)
        plans[name] = {
            metric: _plan_metric(
                np.array([right.without_each[metric] - left.without_each[metric] for left, right in over_scenes]),
                np.array([right.of_scenes(metric) - left.of_scenes(metric) for left, right in over_scenes]),
                points,
                power,
            )
            for metric in first.rules(name).headline
        }
    seeds = tuple(run.record.seed or 0 for run in read)
    remarks = tuple(dict.fromkeys(line for run in read for line in run.elsewhere_lines()))
    return Plan(pair[0], pair[1], tuple(run.name for run in read), seeds, tuple(scenes), power, plans, remarks)


def _plan_metric(
    without_each: Float64Array, of_scenes: Float64Array, points: Sequence[float], power: float
) -> MetricPlan:
    """``without_each`` (R, 1 + G): each run's jackknifed differences; ``of_scenes`` (R, S): those of single scenes."""
    rows = list(zip(without_each, ~np.isnan(of_scenes), strict=True))
    is_part: BoolArray = np.asarray(np.any([statistics.has_part(*row) for row in rows], axis=0))
    pseudo = np.array([statistics.pseudo_values(values, is_part) for values, _ in rows])
    difference = float(without_each[:, 0].mean())
    if pseudo.shape[1] < 2 or not np.isfinite(pseudo).all():
        return MetricPlan(difference, None, None, ())
    variance = statistics.variance_of(pseudo)
    if variance.error(*pseudo.shape[::-1])[0] <= statistics.NO_SPREAD:
        return MetricPlan(difference, None, None, ())
    seeds = (1,) if variance.of_seeds is None else SEEDS
    least, most = statistics.variance_range(variance)
    needs = tuple(
        Need(
            value,
            n_seeds,
            *(statistics.scenes_needed(one, value / 100.0, n_seeds, power) for one in (variance, least, most)),
        )
        for n_seeds in seeds
        for value in points
    )
    return MetricPlan(difference, statistics.crossed_interval(difference, variance), variance, needs)
