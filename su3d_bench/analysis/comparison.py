"""Two runs side by side: what the second changes over the first, per metric, scene and class, and how sure that is.

Numbers are formed over the scenes that both have. What decides is the exact test, which flips the signs of the
differences of single scenes; the interval is of the differences without each scene in turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis.sides import (
    Side,
    check_shapes,
    pair_methods,
    parse_side,
    protocols_in_both,
    refuse_unlike,
    rules_of,
)
from su3d_bench.core.config import MOVES_NO_NUMBER
from su3d_bench.core.errors import ConfigError, counted, printable
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols import ProtocolRules, load_protocol
from su3d_bench.metrics.questions.score import ANSWERED_BY, REFINED_BY, RELATIVE, said_by
from su3d_bench.metrics.scoring import ProtocolResult, combine, metric_of, plain_json
from su3d_bench.numerics.statistics import (
    ALPHA,
    DIFFERENCE,
    Interval,
    SignFlipTest,
    holm,
    jackknife_interval,
    leave_one_out,
    sign_flip_test,
)
from su3d_bench.runs.finished import FinishedRun

SCHEMA = 2
# They move no number of a common scene.
_SETTINGS_ASIDE = frozenset({"scenes", "methods", "protocols"}) | MOVES_NO_NUMBER


@dataclass(frozen=True)
class Difference:
    """One value on both sides, as fractions, NaN where undefined; ``difference`` is the second less the first.

    ``per_scene`` holds the difference of each scene in which both have a value, ``mean_of_scenes`` their mean, on which
    ``test`` is. ``p_of_all``: its p corrected by Holm for all that are compared with it and in which any scene differs:
    the headline metrics of a comparison, or the classes of a protocol.
    """

    left: float
    right: float
    difference: float
    interval: Interval | None
    per_scene: Mapping[str, float]
    mean_of_scenes: float
    test: SignFlipTest | None
    p_of_all: float | None = None

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
            "takes the scenes' differences for normal, the test does not; none is shown"
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
    """``remarks`` are of the runs as such: partial or incomplete ones, and in which settings they differ."""

    left: str
    right: str
    protocols: tuple[ProtocolComparison, ...]
    remarks: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values in full precision, null where undefined."""
        return {
            "schema": SCHEMA,
            "left": self.left,
            "right": self.right,
            "remarks": list(self.remarks),
            "protocols": [plain_json(_protocol_json(protocol)) for protocol in self.protocols],
        }


class SideNumbers:
    """What sides give, made once for all pairs that they are in."""

    def __init__(self) -> None:
        self._scores: dict[tuple[Path, str], dict[str, dict[str, SceneScore]]] = {}
        self._over_scenes: dict[tuple[Path, str, str, tuple[str, ...]], OverScenes] = {}

    def scores(self, side: Side) -> dict[str, dict[str, SceneScore]]:
        """Protocol -> scene -> counts."""
        key = side.run.folder.path, side.method
        if key not in self._scores:
            self._scores[key] = side.run.scores(side.method)
        return self._scores[key]

    def over_scenes(self, rules: ProtocolRules, side: Side, scores: Mapping[str, SceneScore]) -> OverScenes:
        """The numbers over the scenes of ``scores``, and without each of them."""
        key = side.run.folder.path, side.method, rules.name, tuple(scores)
        if key not in self._over_scenes:
            result = combine(rules, scores, with_intervals=False)
            counts = [scores[scene].counts for scene in result.scenes]
            rows = [result.per_scene[scene] for scene in result.scenes]
            without_each = metric_of(rules).resampled_headline(counts, rows, leave_one_out(len(rows)))
            self._over_scenes[key] = OverScenes(result, counts, without_each)
        return self._over_scenes[key]


@dataclass(frozen=True)
class OverScenes:
    """``without_each``: each headline metric (1 + G,) over all scenes, then without each in turn."""

    result: ProtocolResult
    counts: Sequence[Counts]
    without_each: Mapping[str, Float64Array]

    def of_scenes(self, metric: str) -> Float64Array:
        """The metric (S,) of each scene alone, NaN where undefined."""
        return np.array([self.result.per_scene[scene][metric] for scene in self.result.scenes], np.float64)


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
    remarks = _remarks(first.run, second.run, {side.method for side in sides})
    remarks += [line for side in sides for line in _caveats(side)]
    return Comparison(first.run.name, second.run.name, tuple(compared), tuple(dict.fromkeys(remarks)))


def _compare_methods(
    left: Side, right: Side, wanted: Sequence[str], per_class: bool, numbers: SideNumbers
) -> list[ProtocolComparison]:
    counts, others = numbers.scores(left), numbers.scores(right)
    names = protocols_in_both(left, right, wanted)
    compared = []
    for name in names:
        common = [scene for scene in counts.get(name, {}) if scene in others.get(name, {})]
        refuse_unlike(left, right, name, common)
        if not common:
            raise ConfigError(
                f"{left.name} and {right.name}: no scene in common that is scored under {name}; compare runs of the "
                "same scenes"
            )
        rules = rules_of(left, name)
        sides = [{scene: scores[name][scene] for scene in common} for scores in (counts, others)]
        check_shapes(rules, left, sides[0])
        check_shapes(rules, right, sides[1])
        remarks = [*_scene_remarks(left, right, counts[name], others[name]), *_own_remarks(left, right, name)]
        each = [numbers.over_scenes(rules, *pair) for pair in zip((left, right), sides, strict=True)]
        compared.append(_compare_protocol(rules, left, right, each[0], each[1], remarks, per_class))
    return compared


def _compare_protocol(
    rules: ProtocolRules,
    left: Side,
    right: Side,
    own: OverScenes,
    other: OverScenes,
    remarks: Sequence[str],
    per_class: bool,
) -> ProtocolComparison:
    results = own.result, other.result
    scenes = results[0].scenes
    metrics = {
        name: form_difference(
            (results[0].metrics[name], results[1].metrics[name]),
            scenes,
            own.of_scenes(name),
            other.of_scenes(name),
            other.without_each[name] - own.without_each[name],
        )
        for name in rules.headline
    }
    return ProtocolComparison(
        protocol=rules.name,
        version=rules.version,
        aggregate=rules.aggregate,
        left=left.method,
        right=right.method,
        scenes=scenes,
        metrics=metrics,
        classes=_compare_classes(rules, results, (own.counts, other.counts)) if per_class else {},
        remarks=tuple(remarks),
    )


def _compare_classes(
    rules: ProtocolRules, results: Sequence[ProtocolResult], counts: Sequence[Sequence[Counts]]
) -> dict[str, dict[str, Difference]]:
    scenes = results[0].scenes
    alone = np.eye(len(scenes), dtype=np.int64)
    metric = metric_of(rules)
    without_each = [metric.resampled_classes(own, leave_one_out(len(scenes))) for own in counts]
    single = [metric.resampled_classes(own, alone) for own in counts]
    classes = {
        name: {
            column: form_difference(
                (results[0].per_class[name][column], results[1].per_class[name][column]),
                scenes,
                single[0][name][column],
                single[1][name][column],
                without_each[1][name][column] - values,
            )
            for column, values in columns.items()
        }
        for name, columns in without_each[0].items()
        if name in without_each[1]
    }
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


def _scene_remarks(
    left: Side, right: Side, counts: Mapping[str, SceneScore], others: Mapping[str, SceneScore]
) -> list[str]:
    """Which scenes one of the two alone has."""
    lines = []
    for side, own, other in ((left, counts, others), (right, others, counts)):
        alone = [scene for scene in own if scene not in other]
        if alone:
            lines.append(f"only the scenes in common are compared; {side.name} alone has {_some(alone)}")
    return lines


def _own_remarks(left: Side, right: Side, protocol: str) -> list[str]:
    lines = []
    for side in (left, right):
        record = side.run.results.get((side.method, protocol))
        if record is not None and record.failed:
            lines.append(f"INCOMPLETE: {side.name} failed on {_some(record.failed)}")
        warnings = () if record is None or record.result is None else record.result.warnings
        for start in (RELATIVE, ANSWERED_BY, REFINED_BY):
            lines += [f"{side.name}: {start}{printable(said, 200)}" for said in said_by(warnings, start)]
    if load_protocol(protocol).digest != left.run.protocols[protocol].digest:
        lines.append(f"the rules of {protocol} here are not to the letter those that scored both runs (same version)")
    return lines


def _caveats(side: Side) -> list[str]:
    """What must be known of a side's perception, and that the truth is one."""
    if side.method not in side.run.methods:
        return [f"{side.name} is the truth itself, no system"]
    caveats = [record.caveat for (method, _), record in side.run.results.items() if method == side.method]
    return [f"{side.name}: {printable(caveat)}" for caveat in caveats if caveat]


def _remarks(left: FinishedRun, right: FinishedRun, methods: Set[str]) -> list[str]:
    """What must be said of two runs of which ``methods`` are compared."""
    lines = []
    for run in dict.fromkeys((left.name, right.name)):
        side = left if run == left.name else right
        if side.record.is_partial:
            lines.append(f"PARTIAL: {run} has only the first {side.limit} frames of each scene")
        if side.is_incomplete:
            lines.append(f"INCOMPLETE: {run} lacks scenes that failed")
    if changed := settings_that_differ(left, right, methods):
        lines.append("settings that differ: " + "; ".join(changed[:6]) + _more(len(changed) - 6))
    if left.record.code != right.record.code:
        lines.append("the runs were made by different versions of the code")
    return lines


def settings_that_differ(
    left: FinishedRun, right: FinishedRun, methods: Set[str], aside: Sequence[str] = ()
) -> list[str]:
    """What moves numbers and is set otherwise in the two runs, with both values, but for the keys ``aside``."""
    changed = []
    for path in dict.fromkeys([*left.settings, *right.settings]):
        pair = (left.settings.get(path, "not set"), right.settings.get(path, "not set"))
        is_aside = path[0] in _SETTINGS_ASIDE or (path[0] == "method" and methods.isdisjoint(path[1:2]))
        if not is_aside and ".".join(path) not in aside and pair[0] != pair[1]:
            changed.append(printable(f"{'.'.join(path)} {pair[0]} and {pair[1]}", 120))
    return changed


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
