"""Tables of run comparisons, power analyses and protocol comparisons, from their JSON forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import counted, printable
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, bracketed, percent, signed, text_table
from su3d_bench.reports.tables.model import few_scenes

HEADER = ["p", "adjusted p", "smallest p", "better / equal / worse", "A", "B", "B - A", "mean over scenes"]
SEEDS = "SD over seeds, A / B"


def comparison_tables(comparison: Mapping[str, Any]) -> list[Table | Prose]:
    """Return one table per protocol and pair of methods, and one of its classes; numbers are percentages."""
    parts: list[Table | Prose] = [Prose((f"A: {comparison['left']}", f"B: {comparison['right']}"))]
    for compared in comparison["protocols"]:
        parts += _protocol_parts(compared, comparison["seeds"])
    return [*parts, *([Prose(tuple(comparison["remarks"]), is_list=True)] if comparison["remarks"] else [])]


def _protocol_parts(compared: Mapping[str, Any], seeds: Sequence[Sequence[int]]) -> list[Table | Prose]:
    left, right, name = compared["left"], compared["right"], compared["protocol"]
    pair = left if left == right else f"{left} (A), {right} (B)"
    title = f"{name} (version {compared['version']}): {pair}, {counted(len(compared['scenes']), 'scene')}"
    has_seeds = max(map(len, seeds)) > 1
    header = ["metric", *HEADER, *([SEEDS] if has_seeds else [])]
    rows = [[metric, *_cells(value, has_seeds)] for metric, value in compared["metrics"].items()]
    class_rows = [
        [class_name, column, *_cells(value, has_seeds)]
        for class_name, columns in compared["classes"].items()
        for column, value in columns.items()
        if any(value["per_scene"].values())
    ]
    parts: list[Table | Prose] = [text_table(f"{name}-{left}-{right}", [header, *rows], heading=title)]
    if class_rows:
        parts.append(text_table(f"{name}-{left}-{right}-classes", [["class", *header], *class_rows]))
    notes = (*compared["remarks"], *_notes(compared), *([_of_seeds(seeds)] if has_seeds else []))
    return [*parts, *([Prose(notes, is_list=True)] if notes else [])]


def _of_seeds(seeds: Sequence[Sequence[int]]) -> str:
    lines = [f"{side} over {counted(len(of_side), 'seed')}" for side, of_side in zip("AB", seeds, strict=True)]
    return (
        f"each scene's value is the mean of {' and of '.join(lines)}; {SEEDS}: standard deviation of a run's value due "
        "to the seed, in percentage points. Test and interval are over scenes and ignore seed effects common to "
        "all scenes; su3d-bench report power includes them"
    )


def _cells(value: Mapping[str, Any], has_seeds: bool) -> list[str]:
    difference = f"{signed(value['difference'])} {bracketed(value['interval'], signed)}".rstrip()
    changes = list(value["per_scene"].values())
    counts = (sum(d > 0 for d in changes), sum(d == 0 for d in changes), sum(d < 0 for d in changes))
    return [
        _probability(value["p"]),
        _probability(value["p_of_all"]),
        _probability(value["smallest_p"]),
        " / ".join(map(str, counts)),
        percent(value["left"]),
        percent(value["right"]),
        difference,
        signed(value["mean_of_scenes"]),
        *([" / ".join(map(percent, value["deviations_of_seeds"]))] if has_seeds else []),
    ]


def _probability(value: float | None) -> str:
    return NOT_MEASURED if value is None else f"{value:.3g}"


def _notes(compared: Mapping[str, Any]) -> Sequence[str]:
    tests = [value for value in compared["metrics"].values() if value["p"] is not None]
    notes = []
    if len(compared["scenes"]) < 2:
        notes.append("a single scene says nothing about other scenes: no interval, and p is always 1")
    elif tests:
        how = "all sign patterns" if all(value["is_exact"] for value in tests) else "100000 random sign patterns"
        notes.append(
            f"p: two-sided sign-flip test of the mean over scenes, {how}, assuming symmetric differences; adjusted p: "
            "Holm's correction over all metrics compared here, or all classes; [..]: 95 % confidence interval "
            "(jackknife t over scenes)"
        )
        notes += [line for line in (few_scenes(len(compared["scenes"])),) if line]
        notes += [f"{name}: {d['disagreement']}" for name, d in compared["metrics"].items() if d["disagreement"]]
    if compared["classes"]:
        values = [(name, v) for name, columns in compared["classes"].items() for v in columns.values()]
        n_equal = sum(not any(v["per_scene"].values()) for _, v in values)
        notes.append(f"{n_equal} values of classes without a difference in any scene are omitted")
        odd = dict.fromkeys(name for name, v in values if v["disagreement"])
        if odd:
            notes.append(f"interval and test disagree (the test decides) for {', '.join(odd)}")
    return notes


def plan_tables(plan: Mapping[str, Any]) -> list[Table | Prose]:
    """Return one table per protocol, one row per metric and number of seeds; in percentage points, or scenes."""
    n_seeds = len(plan["seeds"])
    seeds = "seed " + ", ".join(map(str, plan["seeds"]))
    title = f"{plan['left']} (A), {plan['right']} (B): {counted(len(plan['scenes']), 'scene')}, {seeds}"
    tables = [_protocol_table(name, metrics, title) for name, metrics in plan["protocols"].items()]
    notes = [
        f"columns of points: scenes needed to detect a true difference of that size with a power of "
        f"{100 * plan['power']:g} %, two-sided paired test at 5 %; at least 6, for a sign-flip p below 0.05",
        f"[..] after it: at the bounds of the 95 % confidence interval of the variance, which is wide for "
        f"{len(plan['scenes'])} scenes; {NOT_MEASURED}: more than 100,000 scenes with that number of seeds",
        "SD: standard deviation of B - A over scenes, over seeds, and the residual; in percentage points",
    ]
    if any(one["variance"] is None for metrics in plan["protocols"].values() for one in metrics.values()):
        notes.append("no SD: the difference is the same in every scene and run, or there is only one scene")
    if n_seeds < 2:
        notes.append("one seed: the effect of seeds on the difference is unknown; add runs with other seeds")
    if n_seeds == 2:
        notes.append("two seeds: no interval, because its coverage would be too low; add a run with a third seed")
    notes += plan["remarks"]
    notes += [line for line in (few_scenes(len(plan["scenes"])),) if line]
    return [*tables, Prose(tuple(notes), is_list=True)]


def _protocol_table(protocol: str, metrics: Mapping[str, Any], title: str) -> Table:
    asked = list(dict.fromkeys(need["points"] for plan in metrics.values() for need in plan["needs"]))
    header = ["metric", "B - A", "SD over scenes", "SD over seeds", "residual SD", "seeds"]
    rows = [[*header, *(f"{points:g} {'point' if points == 1 else 'points'}" for points in asked)]]
    for name, plan in metrics.items():
        variance = plan["variance"]
        difference = f"{signed(plan['difference'])} {bracketed(plan['interval'], signed)}".rstrip()
        is_one_seed = variance is None or variance["of_seeds"] is None
        known = ("of_scenes", "", "") if is_one_seed else ("of_scenes", "of_seeds", "of_rest")
        parts = [
            NOT_MEASURED if not variance or variance.get(key) is None else f"{100 * variance[key] ** 0.5:.1f}"
            for key in known
        ]
        seeds = list(dict.fromkeys(need["n_seeds"] for need in plan["needs"]))
        for n_seeds in seeds:
            needs = []
            for need in (need for need in plan["needs"] if need["n_seeds"] == n_seeds):
                n, *ends = (NOT_MEASURED if need[k] is None else str(need[k]) for k in ("n_scenes", "low", "high"))
                needs.append(n if need["n_scenes"] is None else f"{n} [{', '.join(ends)}]")
            first = [name, difference, *parts] if n_seeds == seeds[0] else [""] * 5
            rows.append([*first, str(n_seeds), *needs])
        if not seeds:
            rows.append([name, difference, *parts, *[NOT_MEASURED] * (1 + len(asked))])
    return text_table(protocol, rows, heading=protocol, caption=f": {title}")


MAX_RULE_CHARACTERS = 60  # characters


def rules_tables(difference: Mapping[str, Any]) -> list[Table | Prose]:
    """Return the rules in which two protocols differ, with the value of each."""
    first, second = difference["first"], difference["second"]
    if not difference["differing"]:
        return [Prose((f"{first} and {second}: no rule that affects the numbers differs",))]
    rows = [["rule", first, second]]
    rows += [[one["rule"], *_sides(one["rule"], one["first"], one["second"])] for one in difference["differing"]]
    return [text_table("rules", rows, heading=f"{first} and {second}")]


def _sides(rule: str, first: Any, second: Any) -> list[str]:
    """Return both values; for long lists their length and what the other side lacks."""
    if rule == "classes":
        names = [[entry["name"] for entry in side] for side in (first, second)]
        return [f"{len(mine)} classes{_alone(mine, other)}" for mine, other in (names, names[::-1])]
    if isinstance(first, list) and isinstance(second, list) and max(len(first), len(second)) > 4:
        return [f"{len(mine)} entries{_alone(mine, other)}" for mine, other in ((first, second), (second, first))]
    return [_shown(value) for value in (first, second)]


def _alone(mine: Sequence[Any], other: Sequence[Any]) -> str:
    own = [str(item) for item in mine if item not in other]
    if not own:
        return ""
    rest = f" and {len(own) - 3} more" if len(own) > 3 else ""
    return f", only here: {printable(', '.join(own[:3]), MAX_RULE_CHARACTERS)}{rest}"


def _shown(value: Any) -> str:
    if value is None or value in ([], {}):
        return "none"
    if isinstance(value, Mapping):
        return printable(", ".join(f"{key} = {_shown(item)}" for key, item in value.items()), MAX_RULE_CHARACTERS)
    return printable(toml_value(value), MAX_RULE_CHARACTERS)
