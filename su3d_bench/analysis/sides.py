"""The two sides of a comparison: their runs and methods, and checks that they are comparable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.core.config import NEUTRAL_SETTINGS
from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import ProtocolResult, combine, metric_of
from su3d_bench.numerics.statistics import leave_one_out
from su3d_bench.questions.query_files import VARIANT as QUERY_OBJECTS
from su3d_bench.runs.finished import FinishedRun, read_run
from su3d_bench.runs.verify import read_checked

# Settings that do not change any number of a common scene.
_SETTINGS_ASIDE = frozenset({"scenes", "methods", "protocols"}) | NEUTRAL_SETTINGS


@dataclass(frozen=True)
class Side:
    """A run and one of its methods; ``others`` are runs with the same method that differ only in their seed."""

    run: FinishedRun
    method: str
    others: tuple[FinishedRun, ...] = ()

    @property
    def name(self) -> str:
        return f"{', '.join(run.name for run in self.runs)}:{self.method}"

    @property
    def runs(self) -> tuple[FinishedRun, ...]:
        return self.run, *self.others

    @property
    def each(self) -> tuple[Side, ...]:
        """One side per run."""
        return tuple(Side(run, self.method) for run in self.runs)


def parse_side(text: str, method: str | None) -> tuple[tuple[FinishedRun, ...], str | None]:
    """The runs of ``FOLDER`` or ``FOLDER,FOLDER``, and the method if it is named after a colon or by ``method``."""
    if folders := _folders(text):
        return tuple(map(read_checked, folders)), method
    before, colon, name = text.rpartition(":")
    if colon and (folders := _folders(before)):
        if method is not None and method != name:
            raise ConfigError(f"{printable(text, 200)}: names the method '{name}', but --method is '{method}'")
        return tuple(map(read_checked, folders)), name
    for path in (Path(text), Path(before)):
        if path.is_file():
            read_run(path)  # its error says what the file is
    raise ConfigError(f"{printable(text, 200)}: no such folder; give the folder of a run, such as runs/my-run")


def _folders(text: str) -> list[Path]:
    """The folders named by ``text``; empty if one of them is missing."""
    folders = [Path(text)] if Path(text).is_dir() else [Path(part) for part in text.split(",") if part]
    return folders if all(folder.is_dir() for folder in folders) else []


Named = tuple[Sequence[FinishedRun], str | None]  # the runs of a side and the method, if one is named


def pair_methods(left: Named, right: Named) -> list[tuple[Side, Side]]:
    """The pairs of methods to compare: those named, otherwise those of the same name, otherwise the only ones.

    Raises ``ConfigError`` if the runs of a side differ in more than their seed.
    """
    (run, *more), name = left
    (other, *more_others), other_name = right
    folders = [{each.folder.path.resolve() for each in runs} for runs, _ in (left, right)]
    is_one_run = not folders[0].isdisjoint(folders[1])
    if is_one_run and name == other_name:
        shown = run.name if name is None else f"{run.name}:{name}"
        raise ConfigError(
            f"{shown}: both sides are the same; name two runs, or two methods of one run as {run.name}:METHOD"
        )
    methods = [(each, each) for each in run.methods if each in other.methods]
    if name is not None or other_name is not None or (not methods and len(run.methods) == len(other.methods) == 1):
        name = name or _same_or_only(run, other_name or run.methods[0])
        other_name = other_name or _same_or_only(other, name)
        run.check_method(name)
        other.check_method(other_name)
        methods = [(name, other_name)]
        if is_one_run and name == other_name:
            raise ConfigError(f"{run.name}:{name}: both sides are the same; name two methods of the run")
    if not methods:
        raise ConfigError(
            f"{run.name} has {', '.join(run.methods)} and {other.name} has {', '.join(other.methods)}: no common "
            f"method; name one of each, such as {run.name}:{run.methods[0]}"
        )
    for (runs, _), names in zip((left, right), zip(*methods, strict=True), strict=True):
        check_same_requests(runs, set(names))
    return [(Side(run, one, tuple(more)), Side(other, two, tuple(more_others))) for one, two in methods]


def _same_or_only(run: FinishedRun, name: str) -> str:
    return run.methods[0] if name not in run.methods and len(run.methods) == 1 else name


def check_same_requests(runs: Sequence[FinishedRun], methods: Set[str]) -> None:
    """Raise a ``ConfigError`` if a run differs from the first in more than the seed, or two runs have the same seed."""
    seen: dict[int, FinishedRun] = {}
    first = runs[0]
    for run in runs:
        for method in methods:
            run.check_method(method)
        if run.record.is_partial != first.record.is_partial or run.limit != first.limit:
            raise ConfigError(f"{run.name}: has other frames than {first.name}; name runs that differ only in --seed")
        if changed := settings_that_differ(first, run, methods, aside=("seed",)):
            raise ConfigError(
                f"{run.name}: differs from {first.name} in {changed[0]}; name runs that differ only in --seed"
            )
        seed = run.record.seed or 0
        if seed in seen:
            raise ConfigError(
                f"{run.name}: has the same seed ({seed}) as {seen[seed].name}; name runs with different seeds"
            )
        seen[seed] = run


def settings_that_differ(
    left: FinishedRun, right: FinishedRun, methods: Set[str], aside: Sequence[str] = ()
) -> list[str]:
    """The number-changing settings that differ between the two runs, with both values, except the keys ``aside``."""
    if bool(left.record.predictions) != bool(right.record.predictions):
        return []  # predictions made elsewhere have no settings here
    changed = []
    for path in dict.fromkeys([*left.settings, *right.settings]):
        pair = (left.settings.get(path, "not set"), right.settings.get(path, "not set"))
        is_aside = path[0] in _SETTINGS_ASIDE or (path[0] == "method" and methods.isdisjoint(path[1:2]))
        if not is_aside and ".".join(path) not in aside and pair[0] != pair[1]:
            changed.append(printable(f"{'.'.join(path)} {pair[0]} and {pair[1]}", 120))
    return changed


def protocols_in_both(left: Side, right: Side, wanted: Sequence[str]) -> list[str]:
    """The protocols ``wanted``, by default all, that scored every run of both sides."""
    runs = [*left.runs, *right.runs]
    common = [name for name in left.run.protocols if all(name in run.protocols for run in runs)]
    for name in wanted:
        for run in runs:
            run.check_protocol(name)
    if not common:
        raise ConfigError(
            f"{left.run.name} was scored under {', '.join(left.run.protocols) or 'nothing'}, {right.run.name} under "
            f"{', '.join(right.run.protocols) or 'nothing'}: no common protocol; score one again with --protocols"
        )
    return list(dict.fromkeys(wanted)) or common


def check_comparable(left: Side, right: Side, protocol: str, scenes: Sequence[str]) -> None:
    """Raise a ``ConfigError`` naming the first differing field that makes the two sides incomparable.

    The encoder is checked if it named the instances of both, unless predictions were made elsewhere: there it belongs
    to the method.
    """
    where = f"{left.name} and {right.name} cannot be compared"
    rules, others = left.run.protocols[protocol].digest, right.run.protocols[protocol].digest
    if rules != others:
        which = f"digest of protocol {protocol} is {_short(rules)} and {_short(others)}"
        raise ConfigError(f"{where}: {which}; score both again with the same rules")
    for scene in scenes:
        pair = (left.run.record.data_digests.get(scene), right.run.record.data_digests.get(scene))
        if pair[0] != pair[1] or None in pair:
            raise ConfigError(
                f"{where}: data digest of {printable(scene, 100)} is {_short(pair[0])} and {_short(pair[1])}; run both "
                "on the same data"
            )
    truths = [side.run.record.ground_truth for side in (left, right)]
    queries = [None if truth is None else truth.queries for truth in truths]
    if queries[0] != queries[1] and left.run.rules(protocol).ground_truth == QUERY_OBJECTS:
        raise ConfigError(f"{where}: their queries come from different files; evaluate both with the same --queries")
    if CEILING_METHOD not in (left.method, right.method):
        results = [side.run.results.get((side.method, protocol)) for side in (left, right)]
        given = [result and result.labels for result in results]
        if None not in given and given[0] != given[1]:
            raise ConfigError(
                f"{where}: {protocol} uses {given[0]} and {given[1]}; give both predictions the same number of labels"
            )
    records = [side.run.results.get((side.method, protocol)) for side in (left, right)]
    named = [record for record in records if record is not None and record.encoder is not None]
    are_elsewhere = left.method in left.run.external or right.method in right.run.external
    if len(named) == 2 and not are_elsewhere and named[0].encoder_digest != named[1].encoder_digest:
        shown = [f"{record.encoder} ({_short(record.encoder_digest)})" for record in named]
        raise ConfigError(f"{where}: encoder is {printable(' and '.join(shown), 200)}; run both with the same encoder")


def _short(value: int | str | None) -> str:
    return printable(str(value)[:12]) if value is not None else "not recorded"


class SideNumbers:
    """The numbers of sides, computed once for all pairs that they are part of."""

    def __init__(self) -> None:
        self._scores: dict[tuple[Path, str], dict[str, dict[str, SceneScore]]] = {}
        self._over_scenes: dict[tuple[Path, str, str, tuple[str, ...]], OverScenes] = {}

    def scores(self, side: Side) -> dict[str, dict[str, SceneScore]]:
        """Protocol -> scene -> counts."""
        key = side.run.folder.path, side.method
        if key not in self._scores:
            self._scores[key] = side.run.scores(side.method)
        return self._scores[key]

    def over_common(self, protocol: str, sides: Sequence[Side]) -> list[OverScenes]:
        """The numbers of each of ``sides`` over the scenes that all have; empty if there is no such scene.

        Raises ``ConfigError`` if one cannot be compared with the first, ``DataError`` if counts have other classes than
        the installed rules.
        """
        scores = [self.scores(side).get(protocol, {}) for side in sides]
        common = [scene for scene in scores[0] if all(scene in of_side for of_side in scores)]
        for side in sides[1:]:
            check_comparable(sides[0], side, protocol, common)
        if not common:
            return []
        rules = sides[0].run.rules(protocol)
        metric = metric_of(rules)
        found = []
        for side, of_side in zip(sides, scores, strict=True):
            own = {scene: of_side[scene] for scene in common}
            key = side.run.folder.path, side.method, protocol, tuple(common)
            if key not in self._over_scenes:
                result = combine(rules, own, with_intervals=False)
                counts = [own[scene].counts for scene in result.scenes]
                rows = [result.per_scene[scene] for scene in result.scenes]
                without_each = metric.resampled_headline(counts, rows, leave_one_out(len(rows)))
                self._over_scenes[key] = OverScenes(result, counts, without_each)
            found.append(self._over_scenes[key])
        return found


@dataclass(frozen=True)
class OverScenes:
    """``without_each``: each headline metric (1 + G,) over all scenes, then without each in turn."""

    result: ProtocolResult
    counts: Sequence[Counts]
    without_each: Mapping[str, Float64Array]

    def of_scenes(self, metric: str) -> Float64Array:
        """The metric (S,) of each scene, NaN if undefined."""
        return np.array([self.result.per_scene[scene][metric] for scene in self.result.scenes], np.float64)


@dataclass(frozen=True)
class Numbers:
    """A value of a side: over all scenes, of each single scene (S,), and over all, then all but each (1 + G,).

    For several runs it is their mean, and ``deviation_of_seeds`` the standard deviation of the runs' values over all
    scenes; None for one run.
    """

    value: float
    of_scenes: Float64Array
    without_each: Float64Array
    deviation_of_seeds: float | None


def over_seeds(
    values: Sequence[float], of_scenes: Sequence[Float64Array], without_each: Sequence[Float64Array]
) -> Numbers:
    """The mean over runs, with one entry per run in each sequence; undefined if it is undefined in one run.

    >>> alone, left_out = np.array([0.4, 0.6]), np.array([0.5, 0.6, 0.4])
    >>> found = over_seeds([0.5, 0.7], [alone, alone + 0.2], [left_out, left_out + 0.2])
    >>> round(found.value, 3), found.of_scenes.round(3).tolist(), round(found.deviation_of_seeds, 3)
    (0.6, [0.5, 0.7], 0.141)
    """
    if len(values) == 1:
        return Numbers(values[0], of_scenes[0], without_each[0], None)
    deviation = float(np.std(values, ddof=1))
    return Numbers(float(np.mean(values)), np.mean(of_scenes, axis=0), np.mean(without_each, axis=0), deviation)


def headline_numbers(side: Sequence[OverScenes], metric: str) -> Numbers:
    """A headline metric of a side, over its runs."""
    return over_seeds(
        [of_run.result.metrics[metric] for of_run in side],
        [of_run.of_scenes(metric) for of_run in side],
        [of_run.without_each[metric] for of_run in side],
    )


def class_numbers(rules: ProtocolRules, side: Sequence[OverScenes]) -> dict[tuple[str, str], Numbers]:
    """(class, column) -> the value of a side, for the classes that all its runs have."""
    metric = metric_of(rules)
    n_scenes = len(side[0].result.scenes)
    alone = np.eye(n_scenes, dtype=np.int64)
    without_each = [metric.resampled_classes(of_run.counts, leave_one_out(n_scenes)) for of_run in side]
    single = [metric.resampled_classes(of_run.counts, alone) for of_run in side]
    return {
        (name, column): over_seeds(
            [of_run.result.per_class[name][column] for of_run in side],
            [of_run[name][column] for of_run in single],
            [of_run[name][column] for of_run in without_each],
        )
        for name, columns in without_each[0].items()
        for column in columns
        if all(name in of_run for of_run in without_each)
    }
