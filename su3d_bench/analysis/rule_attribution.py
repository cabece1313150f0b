"""Rule attribution: how much each rule contributes to the difference between two protocols' scores of a prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from su3d_bench.analysis.attribution import Inputs, method_of, truth_of_scene
from su3d_bench.analysis.sides import parse_side
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, printable, some
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.matching.memory import remembering
from su3d_bench.metrics.protocols.mixtures import Mixtures, RuleDifference, differing
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combined_metrics, pack_scores, plain_json, score_scene, unpack_scores
from su3d_bench.numerics.statistics import EXACT_STEPS, N_ORDERS, Share, choices, shares
from su3d_bench.runs.executors import SCENE_DONE, Event, Report, run_inline, run_processes
from su3d_bench.runs.finished import FinishedRun, read_run

SCHEMA = 1
# These kinds need only the ground truth of a dataset, and score a prediction without questions.
KINDS = ("semantic", "instance", "panoptic")


@dataclass(frozen=True)
class Step:
    """Rules that change together, and what they add to each value, by its name."""

    rules: tuple[str, ...]
    adds: Mapping[str, Share]


@dataclass(frozen=True)
class RulePath:
    """Rule attribution from ``start``, the values under the first protocol, to ``end``: start plus all shares.

    ``scenes``: the scenes of ``run`` whose predictions by ``method`` were scored; ``n_orders`` None: all orders.
    """

    run: str
    method: str
    scenes: tuple[str, ...]
    start: Mapping[str, float]
    end: Mapping[str, float]
    steps: tuple[Step, ...]
    n_orders: int | None


@dataclass(frozen=True)
class RulesApart:
    """The rules in which two protocols differ, and their attribution if a prediction was given."""

    first: str
    second: str
    differing: tuple[RuleDifference, ...]
    walk: RulePath | None

    def to_json(self) -> dict[str, Any]:
        """JSON values, fractions in full precision."""
        return {"schema": SCHEMA, **plain_json(asdict(self))}


@dataclass(frozen=True)
class _Unit:
    """The work of one process: a scene under all ``choices`` of rules."""

    folder: Path
    method: str
    scene: str
    mixtures: Mixtures
    choices: tuple[int, ...]


# Choice of rules -> packed scores of a scene, as in files: 256 confusion matrices of 200 classes are 82 MB.
Scores = Mapping[int, bytes]


def rules_apart(first: ProtocolRules, second: ProtocolRules, walk: RulePath | None = None) -> RulesApart:
    """The rules in which two protocols differ, with the attribution ``walk``; ``ConfigError`` if their kinds differ."""
    return RulesApart(first.name, second.name, tuple(differing(first, second)), walk)


@dataclass(frozen=True)
class RuleStepper:
    """A prediction to be scored under all protocols between two."""

    mixtures: Mixtures
    run: FinishedRun
    method: str
    scenes: tuple[str, ...]

    @classmethod
    def of(cls, first: ProtocolRules, second: ProtocolRules, prediction: str) -> RuleStepper:
        """For ``prediction``, a ``RUN[:METHOD]``.

        Raises ``ConfigError`` if the protocols have different kinds or label sets or ask questions, or if the run lacks
        a map.
        """
        mixtures = Mixtures(first, second)
        if first.kind not in KINDS:
            raise ConfigError(f"--run needs protocols of kind {' or '.join(KINDS)}, these are '{first.kind}'")
        runs, named = parse_side(prediction, None)
        if len(runs) > 1:
            raise ConfigError(f"{printable(prediction, 200)}: names several runs; give one")
        (run,) = runs
        method = method_of(run, named)
        lacking = [scene for scene in run.scenes if not run.folder.job(scene, method).prediction.is_file()]
        if lacking:  # numbers of other scenes would mislead
            raise ConfigError(f"{run.name}: has no map by {printable(method, 80)} of {some(lacking, 3)}; run it again")
        return cls(mixtures, run, method, run.scenes)

    def walk(self, jobs: int = 1, report: Report = lambda event: None) -> RulePath:
        """Score every choice of rules, ``jobs`` scenes in parallel.

        Raises ``PredictionError`` or ``DataError`` if a prediction cannot be scored, or has no value, under a protocol
        between the two.
        """
        mixtures, n = self.mixtures, len(self.mixtures.groups)
        asked = tuple(choices(n))
        units = [_Unit(self.run.folder.path, self.method, scene, mixtures, asked) for scene in self.scenes]
        n_workers = min(jobs, len(units))
        if n_workers > 1:
            of_scene = dict(run_processes(_score, units, report, jobs=n_workers, lost=_lost))
        else:
            of_scene = dict(run_inline(_score, units, report))
        inputs = Inputs(self.run, self.method)

        @cache
        def values(bits: int) -> Mapping[str, float]:
            rules = inputs.rules(mixtures.of(_chosen(bits, n)))
            scores = {scene: unpack_scores(of_scene[scene][bits])[rules.name] for scene in self.scenes}
            found = combined_metrics(rules, scores)
            undefined = [name for name in mixtures.values if not math.isfinite(found[name])]
            if undefined:
                raise PredictionError(
                    f"{self.run.name}: {undefined[0]} is undefined under {rules.name}; cannot attribute rules"
                )
            return found

        def value(name: str, bits: int) -> float:
            return values(bits)[name]

        adds = {name: shares(n, partial(value, name)) for name in mixtures.values}
        return RulePath(
            run=self.run.name,
            method=printable(self.method, 80),
            scenes=tuple(printable(scene, 120) for scene in self.scenes),
            start={name: values(0)[name] for name in mixtures.values},
            end={name: values((1 << n) - 1)[name] for name in mixtures.values},
            steps=tuple(
                Step(group, {name: adds[name][k] for name in mixtures.values})
                for k, group in enumerate(mixtures.groups)
            ),
            n_orders=None if n <= EXACT_STEPS else N_ORDERS,
        )


def _chosen(bits: int, n: int) -> list[int]:
    return [k for k in range(n) if bits >> k & 1]


def _score(unit: _Unit, report: Report) -> tuple[str, Scores]:
    run = read_run(unit.folder)
    inputs, truth_of = Inputs(run, unit.method), cache(partial(truth_of_scene, run, unit.scene))
    own = cache(run.encoder)
    scores: dict[int, bytes] = {}
    with remembering():
        for k, bits in enumerate(unit.choices):
            report(Event(unit.scene, "scoring", k, len(unit.choices)))
            rules = inputs.rules(unit.mixtures.of(_chosen(bits, len(unit.mixtures.groups))))
            truth, prediction = inputs.of_scene(unit.scene, rules, truth_of)
            if (reason := kind_incompatibility(rules, prediction)) is not None:
                raise PredictionError(f"{printable(unit.scene, 120)}: under {rules.name}: {reason}")
            score = score_scene(rules, truth, prediction, inputs.encoder(rules, prediction, own))
            scores[bits] = pack_scores({rules.name: score})
    report(Event(unit.scene, SCENE_DONE, len(unit.choices), len(unit.choices)))
    return unit.scene, scores


def _lost(unit: _Unit, cause: str) -> tuple[str, Scores]:
    raise DataError(f"{printable(unit.scene, 120)}: {cause}")
