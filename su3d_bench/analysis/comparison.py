"""Two runs compared: the changes per metric, scene and class, how sure they are, and how many scenes would show them.

Numbers are formed over the scenes that both have. What decides is the exact test, which flips the signs of the
differences of single scenes; the interval is of the differences without each scene in turn. A side of several runs
stands for their mean, and what seeds alone move is said beside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis.sides import (
    Numbers,
    OverScenes,
    Side,
    SideNumbers,
    class_numbers,
    headline_numbers,
    pair_methods,
    parse_side,
    protocols_in_both,
    refuse_other_requests,
    settings_that_differ,
)
from su3d_bench.core.errors import ConfigError, counted, printable
from su3d_bench.core.types import BoolArray, Float64Array, Interval
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import ANSWERED_BY, REFINED_BY, RELATIVE, said_by
from su3d_bench.metrics.scoring import plain_json
from su3d_bench.numerics.statistics import (
    ALPHA,
    DIFFERENCE,
    NO_SPREAD,
    POWER,
    SignFlipTest,
    Variance,
    crossed_interval,
    has_part,
    holm,
    jackknife_interval,
    pseudo_values,
    scenes_needed,
    sign_flip_test,
    variance_of,
    variance_range,
)
from su3d_bench.runs.finished import FinishedRun, read_run

SCHEMA = 2


@dataclass(frozen=True)
class Difference:
    """One value on both sides, as fractions, NaN where undefined; ``difference`` is the second less the first.

    ``per_scene`` holds the difference of each scene in which both have a value, ``mean_of_scenes`` their mean, on which
    ``test`` is. ``p_of_all``: its p corrected by Holm for all that are compared with it and in which any scene differs:
    the headline metrics of a comparison, or the classes of a protocol. ``deviations_of_seeds``: by how much, as a
    standard deviation, the seed alone moves the value of one run of each side; None where a side is one run.
    """

    left: float
    right: float
    difference: float
    interval: Interval | None
    per_scene: Mapping[str, float]
    mean_of_scenes: float
    test: SignFlipTest | None
    p_of_all: float | None = None
    deviations_of_seeds: tuple[float | None, float | None] = (None, None)

    @property
    def disagreement(self) -> str | None:
        """What a reader must know where the interval and the test seem to say different things; None where they agree.

        >>> test = SignFlipTest(p=0.25, smallest_p=0.25, n_pairs=3, is_exact=True)
        >>> Difference(0.5, 0.6, 0.1, (0.02, 0.18), {}, 0.1, test).disagreement
        'the interval leaves 0 out, but 3 scenes can give no p below 0.25: no difference is shown'
        """
        if self.interval is None or self.test is None:
            return None
        leaves_out_zero = self.interval[0] > 0 or self.interval[1] < 0
        if leaves_out_zero and self.test.p < ALPHA:
            if (self.interval[0] > 0) == (self.mean_of_scenes > 0):
                return None
            return (
                f"B - A and the mean over scenes have opposite signs, and neither is chance (p {self.test.p:.2g}): the "
                "test is of the mean over scenes, the interval of B - A, in which scenes count by what they hold"
            )
        if leaves_out_zero == (self.test.p < ALPHA):
            return None
        if not leaves_out_zero:
            return (
                f"the test finds a difference (p {self.test.p:.2g}) of the mean over scenes, though the interval of "
                "B - A holds 0: the interval takes the scenes' differences for normal, the test does not"
            )
        if self.test.smallest_p >= ALPHA:
            return (
                f"the interval leaves 0 out, but {counted(self.test.n_pairs, 'scene')} can give no p below "
                f"{self.test.smallest_p:.3g}: no difference is shown"
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
    """``remarks`` are of the runs as such: partial or incomplete ones, and in which settings they differ.

    ``seeds``: those of the runs of both sides.
    """

    left: str
    right: str
    seeds: tuple[tuple[int, ...], tuple[int, ...]]
    protocols: tuple[ProtocolComparison, ...]
    remarks: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values in full precision, null where undefined."""
        return {
            "schema": SCHEMA,
            "left": self.left,
            "right": self.right,
            "seeds": [list(of_side) for of_side in self.seeds],
            "remarks": list(self.remarks),
            "protocols": [plain_json(_protocol_json(protocol)) for protocol in self.protocols],
        }


def compare(
    left: str,
    right: str,
    *,
    method: str | None = None,
    protocols: Sequence[str] = (),
    per_class: bool = False,
    numbers: SideNumbers | None = None,
) -> Comparison:
    """What ``right`` changes over ``left``, each the folder of a run or ``FOLDER:METHOD``.

    Folders with commas between are one side: runs of one request under several seeds, over which values are averaged.
    Without methods those of one name are compared, or the only ones; ``numbers`` are shared by calls on the same runs.
    Raises ``ConfigError`` where the two cannot be compared, naming the first field that differs.
    """
    pairs = pair_methods(parse_side(left, method), parse_side(right, method))
    first, second = pairs[0]
    compared: list[ProtocolComparison] = []
    for pair in pairs:
        compared += _compare_methods(*pair, protocols, per_class, numbers or SideNumbers())
    of_all = _of_all([protocol.metrics for protocol in compared])
    compared = [replace(protocol, metrics=metrics) for protocol, metrics in zip(compared, of_all, strict=True)]
    sides = [side for pair in pairs for side in pair]
    remarks = _remarks(first, second, {side.method for side in sides})
    remarks += [line for side in sides for of_run in side.each for line in _caveats(of_run)]
    left_name, right_name = (", ".join(run.name for run in side.runs) for side in (first, second))
    left_seeds, right_seeds = (tuple(run.record.seed or 0 for run in side.runs) for side in (first, second))
    return Comparison(left_name, right_name, (left_seeds, right_seeds), tuple(compared), tuple(dict.fromkeys(remarks)))


def _compare_methods(
    left: Side, right: Side, wanted: Sequence[str], per_class: bool, numbers: SideNumbers
) -> list[ProtocolComparison]:
    every = [*left.each, *right.each]
    compared = []
    for name in protocols_in_both(left, right, wanted):
        over_scenes = numbers.over_common(name, every)
        if not over_scenes:
            raise ConfigError(
                f"{left.name} and {right.name}: no scene in common that is scored under {name}; compare runs of the "
                "same scenes"
            )
        rules, common = left.run.rules(name), over_scenes[0].result.scenes
        remarks = [line for of_run in every for line in _scene_remarks(of_run, numbers.scores(of_run)[name], common)]
        remarks += _own_remarks(every, name)
        halves = over_scenes[: len(left.runs)], over_scenes[len(left.runs) :]
        compared.append(_compare_protocol(rules, left.method, right.method, halves, remarks, per_class))
    return compared


def _compare_protocol(
    rules: ProtocolRules,
    left: str,
    right: str,
    sides: tuple[Sequence[OverScenes], Sequence[OverScenes]],
    remarks: Sequence[str],
    per_class: bool,
) -> ProtocolComparison:
    scenes = sides[0][0].result.scenes
    metrics = {
        name: difference_of(headline_numbers(sides[0], name), headline_numbers(sides[1], name), scenes)
        for name in rules.headline
    }
    return ProtocolComparison(
        protocol=rules.name,
        version=rules.version,
        aggregate=rules.aggregate,
        left=left,
        right=right,
        scenes=scenes,
        metrics=metrics,
        classes=_compare_classes(rules, sides, scenes) if per_class else {},
        remarks=tuple(remarks),
    )


def _compare_classes(
    rules: ProtocolRules, sides: tuple[Sequence[OverScenes], Sequence[OverScenes]], scenes: Sequence[str]
) -> dict[str, dict[str, Difference]]:
    left, right = (class_numbers(rules, side) for side in sides)
    classes: dict[str, dict[str, Difference]] = {}
    for (name, column), own in left.items():
        if (name, column) in right:
            classes.setdefault(name, {})[column] = difference_of(own, right[name, column], scenes)
    return dict(zip(classes, _of_all(list(classes.values())), strict=True))


def _of_all(tables: Sequence[Mapping[str, Difference]]) -> list[dict[str, Difference]]:
    """The differences of ``tables``, each with its p among all of them.

    Where no scene differs, no sign can be turned: such a test counts for nothing.
    Source: Tarone, A modified Bonferroni method for discrete data, Biometrics 46 (1990).
    """
    every = [difference for table in tables for difference in table.values()]
    tested = [d.test.p if d.test is not None and any(d.per_scene.values()) else None for d in every]
    corrected = iter(holm(tested))
    return [{name: replace(value, p_of_all=next(corrected)) for name, value in table.items()} for table in tables]


def form_difference(
    values: tuple[float, float],
    scenes: Sequence[str],
    left_of_scene: Float64Array,
    right_of_scene: Float64Array,
    without_each: Float64Array,
) -> Difference:
    """The difference of one value; ``without_each`` (1 + G,) holds it over all scenes, then without each in turn."""
    differences: Float64Array = right_of_scene - left_of_scene
    numbers = differences[~np.isnan(differences)]
    return Difference(
        left=values[0],
        right=values[1],
        difference=values[1] - values[0],
        interval=jackknife_interval(without_each, ~np.isnan(differences), bounds=DIFFERENCE),
        per_scene={s: float(d) for s, d in zip(scenes, differences, strict=True) if not np.isnan(d)},
        mean_of_scenes=float(numbers.mean()) if len(numbers) else float("nan"),
        test=sign_flip_test(differences),
    )


def difference_of(left: Numbers, right: Numbers, scenes: Sequence[str]) -> Difference:
    """The difference of a value of two sides."""
    found = form_difference(
        (left.value, right.value),
        scenes,
        left.of_scenes,
        right.of_scenes,
        right.without_each - left.without_each,
    )
    return replace(found, deviations_of_seeds=(left.deviation_of_seeds, right.deviation_of_seeds))


def _scene_remarks(side: Side, own: Mapping[str, SceneScore], common: Sequence[str]) -> list[str]:
    """Which scenes of one run not all have."""
    alone = [scene for scene in own if scene not in common]
    return [f"only the scenes in common are compared; {side.name} alone has {_some(alone)}"] if alone else []


def _own_remarks(sides: Sequence[Side], protocol: str) -> list[str]:
    lines = []
    for side in sides:
        record = side.run.results.get((side.method, protocol))
        if record is not None and record.failed:
            lines.append(f"INCOMPLETE: {side.name} failed on {_some(record.failed)}")
        warnings = () if record is None or record.result is None else record.result.warnings
        for start in (RELATIVE, ANSWERED_BY, REFINED_BY):
            lines += [f"{side.name}: {start}{printable(said, 200)}" for said in said_by(warnings, start)]
    if sides[0].run.rules(protocol).digest != sides[0].run.protocols[protocol].digest:
        lines.append(f"the rules of {protocol} here are not to the letter those that scored both runs (same version)")
    return lines


def _caveats(side: Side) -> list[str]:
    """What must be known of a side's perception, and that the truth is one."""
    if side.method not in side.run.methods:
        return [f"{side.name} is the truth itself, no system"]
    caveats = [record.caveat for (method, _), record in side.run.results.items() if method == side.method]
    return [f"{side.name}: {printable(caveat)}" for caveat in caveats if caveat]


def _remarks(left: Side, right: Side, methods: Set[str]) -> list[str]:
    """What must be said of the runs of which ``methods`` are compared."""
    lines = []
    for run in {run.name: run for side in (left, right) for run in side.runs}.values():
        if run.record.is_partial:
            lines.append(f"PARTIAL: {run.name} has only the first {counted(run.limit, 'frame')} of each scene")
        if run.is_incomplete:
            lines.append(f"INCOMPLETE: {run.name} lacks scenes that failed")
    aside = ("seed",) if left.others or right.others else ()
    if changed := settings_that_differ(left.run, right.run, methods, aside):
        lines.append("settings that differ: " + "; ".join(changed[:6]) + _more(len(changed) - 6))
    if len({run.record.code for side in (left, right) for run in side.runs}) > 1:
        lines.append("the runs were made by different versions of the code")
    return lines


def _some(names: Sequence[str]) -> str:
    return ", ".join(printable(name, 80) for name in names[:3]) + _more(len(names) - 3)


def _more(n: int) -> str:
    return f" and {n} more" if n > 0 else ""


def _protocol_json(protocol: ProtocolComparison) -> dict[str, Any]:
    return {
        **asdict(protocol),
        "metrics": {name: _difference_json(value) for name, value in protocol.metrics.items()},
        "classes": {
            name: {column: _difference_json(value) for column, value in columns.items()}
            for name, columns in protocol.classes.items()
        },
    }


def _difference_json(difference: Difference) -> dict[str, Any]:
    """A test that there is none of has no pairs."""
    values = asdict(difference)
    test = values.pop("test") or {"p": None, "smallest_p": None, "n_pairs": 0, "is_exact": None}
    return {**values, **test, "disagreement": difference.disagreement}


PLAN_SCHEMA = 1
SEEDS = (1, 2, 3, 5, 10)  # of which the scenes are told, where runs of several seeds say what these move


@dataclass(frozen=True)
class Need:
    """The scenes, each under ``n_seeds`` seeds, that find a difference of ``points`` per cent; None: no number does.

    ``low`` and ``high``: what it would be at the ends of the 95 % interval of the variance.
    """

    points: float
    n_seeds: int
    n_scenes: int | None
    low: int | None
    high: int | None


@dataclass(frozen=True)
class MetricPlan:
    """One metric: the ``difference`` of the second method less the first, as a fraction, with its ``interval`` over the
    scenes and seeds that were run, how it varies, and what is needed; no variance where nothing varies, or too few
    scenes count."""

    difference: float
    interval: Interval | None
    variance: Variance | None
    needs: tuple[Need, ...]


@dataclass(frozen=True)
class Plan:
    """``protocols``: protocol -> metric -> plan; ``seeds`` are those of the runs."""

    left: str
    right: str
    runs: tuple[str, ...]
    seeds: tuple[int, ...]
    scenes: tuple[str, ...]
    power: float
    protocols: Mapping[str, Mapping[str, MetricPlan]]
    remarks: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain values in full precision, null where undefined."""
        return {"schema": PLAN_SCHEMA, **plain_json(asdict(self))}


def plan(
    runs: Sequence[Path],
    methods: Sequence[str] = (),
    *,
    points: Sequence[float],
    protocols: Sequence[str] = (),
    power: float = POWER,
) -> Plan:
    """What shows differences of ``points`` per cent between two methods, from ``runs`` that differ in their seed alone.

    Without ``methods`` the runs' only two. Raises ``ConfigError`` where the runs do not belong together, hold one seed
    twice, or too little to tell how differences vary.
    """
    _check_request(points, power)
    read = [read_run(path) for path in dict.fromkeys(runs)]
    pair = _two_methods(read[0], methods)
    sides = [(Side(run, pair[0]), Side(run, pair[1])) for run in read]
    refuse_other_requests(read, set(pair))
    numbers = SideNumbers()
    plans: dict[str, dict[str, MetricPlan]] = {}
    scenes: dict[str, None] = {}
    for name in protocols_in_both(*sides[0], protocols):
        over_scenes = _over_common_scenes(name, sides, numbers)
        scenes |= dict.fromkeys(over_scenes[0][0].result.scenes)
        plans[name] = {
            metric: _plan_metric(
                np.array([right.without_each[metric] - left.without_each[metric] for left, right in over_scenes]),
                np.array([right.of_scenes(metric) - left.of_scenes(metric) for left, right in over_scenes]),
                points,
                power,
            )
            for metric in sides[0][0].run.rules(name).headline
        }
    seeds = tuple(run.record.seed or 0 for run in read)
    remarks = tuple(dict.fromkeys(line for run in read for line in run.elsewhere_lines()))
    return Plan(*pair, tuple(run.name for run in read), seeds, tuple(scenes), power, plans, remarks)


def _over_common_scenes(
    protocol: str, sides: Sequence[tuple[Side, Side]], numbers: SideNumbers
) -> list[tuple[OverScenes, OverScenes]]:
    """What the two methods of each run come to over the scenes that all have."""
    found = numbers.over_common(protocol, [side for of_run in sides for side in of_run])
    n_scenes = len(found[0].result.scenes) if found else 0
    if n_scenes < 2:
        raise ConfigError(
            f"{sides[0][0].run.name}: {counted(n_scenes, 'scene')} {'is' if n_scenes == 1 else 'are'} scored under "
            f"{protocol} for both methods in every run; at least two tell how a difference varies"
        )
    return list(zip(found[::2], found[1::2], strict=True))


def _check_request(points: Sequence[float], power: float) -> None:
    for value in points:
        if not 0 < value <= 100:
            raise ConfigError(f"--points {value:g}: expected per cent above 0 and at most 100")
    if not 0.05 < power < 1:
        raise ConfigError(f"--power {power:g}: expected a probability above 0.05 and below 1, such as 0.8")


def _two_methods(run: FinishedRun, methods: Sequence[str]) -> tuple[str, str]:
    chosen = list(methods) or list(run.methods)
    if len(chosen) != 2 or chosen[0] == chosen[1]:
        known = ", ".join(printable(name, 80) for name in run.methods)
        raise ConfigError(f"{run.name}: a difference is of two methods; name them with --methods A B (it has {known})")
    return chosen[0], chosen[1]


def _plan_metric(
    without_each: Float64Array, of_scenes: Float64Array, points: Sequence[float], power: float
) -> MetricPlan:
    """``without_each`` (R, 1 + G) of each run's difference, ``of_scenes`` (R, S) that of each scene alone."""
    rows = list(zip(without_each, ~np.isnan(of_scenes), strict=True))
    is_part: BoolArray = np.asarray(np.any([has_part(*row) for row in rows], axis=0))
    pseudo = np.array([pseudo_values(values, is_part) for values, _ in rows])
    difference = float(without_each[:, 0].mean())
    if pseudo.shape[1] < 2 or not np.isfinite(pseudo).all():
        return MetricPlan(difference, None, None, ())
    variance = variance_of(pseudo)
    if variance.error(*pseudo.shape[::-1])[0] <= NO_SPREAD:
        return MetricPlan(difference, None, None, ())
    seeds = (1,) if variance.of_seeds is None else SEEDS
    least, most = variance_range(variance)
    needs = tuple(
        Need(value, n_seeds, *(scenes_needed(one, value / 100.0, n_seeds, power) for one in (variance, least, most)))
        for n_seeds in seeds
        for value in points
    )
    return MetricPlan(difference, crossed_interval(difference, variance), variance, needs)
