"""The two sides of a comparison: which runs and methods they are, and whether they may be compared at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.metrics.protocols import ProtocolRules, load_protocol
from su3d_bench.metrics.scoring import SceneScore, metric_of
from su3d_bench.runs.finished import FinishedRun, read_run


@dataclass(frozen=True)
class Side:
    """A run and one of its methods."""

    run: FinishedRun
    method: str

    @property
    def name(self) -> str:
        return f"{self.run.name}:{self.method}"


def parse_side(text: str, method: str | None) -> tuple[FinishedRun, str | None]:
    """The run of ``FOLDER`` or ``FOLDER:METHOD``, and the method if one is named there or by ``method``."""
    if Path(text).is_dir():
        return read_run(Path(text)), method
    folder, colon, name = text.rpartition(":")
    if colon and Path(folder).is_dir():
        if method is not None and method != name:
            raise ConfigError(f"{printable(text, 200)}: names the method '{name}', --method names '{method}'")
        return read_run(Path(folder)), name
    raise ConfigError(f"{printable(text, 200)}: there is no such folder; name that of a run, such as runs/my-run")


def pair_methods(
    left: tuple[FinishedRun, str | None], right: tuple[FinishedRun, str | None]
) -> list[tuple[Side, Side]]:
    """The methods that are compared with each other: those named, else those of one name, else the only ones."""
    (run, name), (other, other_name) = left, right
    is_one_run = run.folder.path.resolve() == other.folder.path.resolve()
    if is_one_run and name == other_name:
        shown = run.name if name is None else f"{run.name}:{name}"
        raise ConfigError(
            f"{shown}: both sides are the same; name two runs, or two methods of one as {run.name}:METHOD"
        )
    if name is None and other_name is None:
        common = [each for each in run.methods if each in other.methods]
        if not common and len(run.methods) == len(other.methods) == 1:
            name, other_name = run.methods[0], other.methods[0]
        elif not common:
            raise ConfigError(
                f"{run.name} has {', '.join(run.methods)} and {other.name} {', '.join(other.methods)}: no method in "
                f"common; name one of each, such as {run.name}:{run.methods[0]}"
            )
        else:
            return [(Side(run, each), Side(other, each)) for each in common]
    name = name or _same_or_only(run, str(other_name))
    other_name = other_name or _same_or_only(other, name)
    run.check_method(name)
    other.check_method(other_name)
    if is_one_run and name == other_name:
        raise ConfigError(f"{run.name}:{name}: both sides are the same; name two methods of the run")
    return [(Side(run, name), Side(other, other_name))]


def _same_or_only(run: FinishedRun, name: str) -> str:
    return run.methods[0] if name not in run.methods and len(run.methods) == 1 else name


def protocols_in_both(left: Side, right: Side, wanted: Sequence[str]) -> list[str]:
    """The protocols ``wanted``, or else all, that scored both sides."""
    common = [name for name in left.run.protocols if name in right.run.protocols]
    for name in wanted:
        for side in (left, right):
            side.run.check_protocol(name)
    if not common:
        raise ConfigError(
            f"{left.run.name} was scored under {', '.join(left.run.protocols) or 'nothing'}, {right.run.name} under "
            f"{', '.join(right.run.protocols) or 'nothing'}: no protocol in common; score one again with --protocols"
        )
    return list(dict.fromkeys(wanted)) or common


def refuse_unlike(left: Side, right: Side, protocol: str, scenes: Sequence[str]) -> None:
    """A ``ConfigError`` that names the first field in which the two differ and that forbids to compare them.

    The encoder counts where it named the instances of both.
    """
    where = f"{left.name} and {right.name} cannot be compared"
    rules, others = left.run.protocols[protocol], right.run.protocols[protocol]
    for what in ("version", "digest"):
        rule, other = getattr(rules, what), getattr(others, what)
        if rule != other:
            raise ConfigError(
                f"{where}: {what} of protocol {protocol} is {_short(rule)} and {_short(other)}; score both again with "
                "the same rules"
            )
    for scene in scenes:
        pair = (left.run.record.data_digests.get(scene), right.run.record.data_digests.get(scene))
        if pair[0] != pair[1] or None in pair:
            raise ConfigError(
                f"{where}: data digest of {printable(scene, 100)} is {_short(pair[0])} and {_short(pair[1])}; run both "
                "on the same data"
            )
    records = [side.run.results.get((side.method, protocol)) for side in (left, right)]
    named = [record for record in records if record is not None and record.encoder is not None]
    if len(named) == 2 and named[0].encoder_digest != named[1].encoder_digest:
        shown = [f"{record.encoder} ({_short(record.encoder_digest)})" for record in named]
        raise ConfigError(f"{where}: encoder is {printable(' and '.join(shown), 200)}; run both with the same one")


def _short(value: int | str | None) -> str:
    return printable(str(value)[:12]) if value is not None else "not recorded"


def rules_of(side: Side, protocol: str) -> ProtocolRules:
    """The rules here, which must be those of the run as far as a version says so."""
    rules = load_protocol(protocol)
    version = side.run.protocols[protocol].version
    if rules.version != version:
        raise ConfigError(
            f"{side.run.name}: was scored under {protocol} version {version}, here is version {rules.version}; score "
            "both runs again"
        )
    return rules


def check_shapes(rules: ProtocolRules, side: Side, scores: Mapping[str, SceneScore]) -> None:
    """A ``DataError`` where counts are of other classes than the rules here have."""
    for scene, score in scores.items():
        metric_of(rules).check(f"{side.name}: {printable(scene, 100)}", score.counts)
