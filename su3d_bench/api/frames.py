"""Records of runs as pandas tables.

Every number is bit-identical to the record; missing values are NaN, or NA in integer columns. Texts are made printable,
because they may come from untrusted files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple
from typing import TYPE_CHECKING, Any

from su3d_bench.core.errors import printable
from su3d_bench.reports.tables.instances import COLUMNS, InstanceRow

if TYPE_CHECKING:
    import pandas

    from su3d_bench.analysis.attribution import RunAttribution
    from su3d_bench.metrics.costs import UpdateTimes
    from su3d_bench.store.records import MetricsRecord

TEXT, WHOLE, NUMBER, TRUTH, WHOLE_OR_NONE = "string", "int64", "float64", "bool", "Int64"
# The column types, by table.
METRICS = {
    **dict.fromkeys(("method", "protocol", "metric"), TEXT),
    "is_headline": TRUTH,
    **dict.fromkeys(("value", "low", "high", "ceiling"), NUMBER),
    "n_scenes": WHOLE,
}
SCENE_DTYPES = {**dict.fromkeys(("method", "protocol", "scene", "metric"), TEXT), "value": NUMBER}
CLASS_DTYPES = {**dict.fromkeys(("method", "protocol", "class_name", "metric"), TEXT), "value": NUMBER}
UPDATES = {"method": TEXT, "scene": TEXT, "update": WHOLE, "frame": WHOLE_OR_NONE}  # all others are numbers
ERRORS = {
    **dict.fromkeys(("method", "protocol", "metric"), TEXT),
    **{"value": NUMBER, "part": TEXT, "kind": TEXT, "n": WHOLE_OR_NONE, "gain": NUMBER},
}
DIFFERENCES = {
    **dict.fromkeys(("protocol", "left", "right", "class_name", "metric"), TEXT),
    **dict.fromkeys(("value_left", "value_right", "difference", "low", "high", "p", "p_of_all"), NUMBER),
    "n_scenes": WHOLE,
}
_OF_KIND = {"text": TEXT, "whole number": WHOLE, "number": NUMBER, "yes or no": TRUTH}
INSTANCES = {
    one.name: WHOLE_OR_NONE if one.may_lack and one.kind == "whole number" else _OF_KIND[one.kind] for one in COLUMNS
}


def metrics_frame(metrics: MetricsRecord) -> pandas.DataFrame:
    """One row per method, protocol and metric over all scenes; none for methods without a score."""
    rows = []
    for result in metrics.results:
        numbers, ceiling = result.result, result.ceiling or {}
        if numbers is None:
            continue
        for metric, value in numbers.metrics.items():
            low, high = numbers.intervals.get(metric) or (None, None)
            where = (result.method, result.protocol, metric, metric in result.headline)
            rows.append((*where, value, low, high, ceiling.get(metric), len(numbers.scenes)))
    return frame(METRICS, rows)


def scenes_frame(metrics: MetricsRecord) -> pandas.DataFrame:
    """One row per method, protocol, scene and metric."""
    return frame(SCENE_DTYPES, _inner_rows(metrics, "per_scene"))


def classes_frame(metrics: MetricsRecord) -> pandas.DataFrame:
    """One row per method, protocol, class and metric, for classes with a value."""
    return frame(CLASS_DTYPES, _inner_rows(metrics, "per_class"))


def _inner_rows(metrics: MetricsRecord, name: str) -> list[tuple[Any, ...]]:
    return [
        (result.method, result.protocol, inner, metric, value)
        for result in metrics.results
        if result.result is not None
        for inner, values in getattr(result.result, name).items()
        for metric, value in values.items()
    ]


def updates_frame(times: Iterable[UpdateTimes]) -> pandas.DataFrame:
    """One row per update, with every column of any ``updates.csv``; NaN if a method has no such column."""
    import pandas

    tables = [pandas.DataFrame({"method": one.method, "scene": one.scene, **one.columns}) for one in times]
    names = dict.fromkeys([*UPDATES, *(name for table in tables for name in table.columns)])
    last = [name for name in ("method_ms", "total_ms") if name in names]
    order = [*(name for name in names if name not in last), *last]
    whole = (pandas.concat(tables, ignore_index=True) if tables else pandas.DataFrame()).reindex(columns=order)
    for name in ("method", "scene"):
        whole[name] = [printable(str(text)) for text in whole[name]]
    return whole.astype({name: UPDATES.get(name, NUMBER) for name in order})


def instances_frame(rows: Sequence[InstanceRow]) -> pandas.DataFrame:
    """One row per instance; ``report instances --describe-columns`` describes the columns."""
    return frame(INSTANCES, [astuple(row) for row in rows])


def errors_frame(attributions: Iterable[RunAttribution]) -> pandas.DataFrame:
    """One row per method, protocol, metric and kind of error; value and gains, except those of stages, sum to 1."""
    rows: list[tuple[Any, ...]] = []
    for one in attributions:
        for of_protocol in one.protocols:
            for metric, value in of_protocol.values.items():
                where = (one.method, of_protocol.protocol, metric, value)
                for kind, cause in of_protocol.causes.items():
                    rows.append((*where, "error", kind, cause.n, cause.gains[metric]))
                rows.append((*where, "overlap", "", None, of_protocol.overlap[metric]))
                rows.append((*where, "rest", "", None, of_protocol.rest[metric]))
                for stage, values in of_protocol.stages.items():
                    rows.append((*where, "stage", stage, None, values[metric] - value))
    return frame(ERRORS, rows)


def differences_frame(comparison: Mapping[str, Any]) -> pandas.DataFrame:
    """One row per protocol and metric, and per class if classes were compared; ``comparison`` is its JSON."""
    rows = []
    for protocol in comparison["protocols"]:
        pairs = [("", metric, value) for metric, value in protocol["metrics"].items()]
        for name, columns in protocol["classes"].items():
            pairs += [(name, metric, value) for metric, value in columns.items()]
        for name, metric, value in pairs:
            low, high = value["interval"] or (None, None)
            where = (protocol["protocol"], protocol["left"], protocol["right"], name, metric)
            numbers = (value["left"], value["right"], value["difference"], low, high, value["p"], value["p_of_all"])
            rows.append((*where, *numbers, len(protocol["scenes"])))
    return frame(DIFFERENCES, rows)


def frame(columns: Mapping[str, str], rows: Sequence[Sequence[Any]]) -> pandas.DataFrame:
    """A table of these columns, with printable texts."""
    import pandas

    texts = [place for place, kind in enumerate(columns.values()) if kind == TEXT]
    plain = [list(row) for row in rows]
    for row in plain:
        for place in texts:
            row[place] = printable(str(row[place]))
    return pandas.DataFrame(plain, columns=list(columns)).astype(dict(columns))
