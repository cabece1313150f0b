"""A small run for the regression check, with chosen times and planted faults."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.digests import digest_file
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, pack_scores, unpack_scores
from su3d_bench.metrics.semantic.confusion import SemanticCounts

COSTS = {"calibration_ms": 5.0, "start_ms": 10.0, "close_ms": 0.0}


def timed(run: Path, method_ms: Sequence[float] = (40.0,) * 6, finish_ms: float = 60.0, **costs: float) -> Path:
    """Replace the measured times by these, so that the tests do not depend on the machine."""
    for updates in run.rglob("collector/updates.csv"):
        rows = list(csv.DictReader(updates.open()))
        for row, ms in zip(rows, method_ms, strict=True):
            row |= {"method_ms": str(ms), "total_ms": str(ms + 50)}
        with updates.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    for done in run.rglob("collector/done.json"):
        edit(done, lambda value: of_costs(value).update(COSTS | costs))
        edit(done, lambda value: of_costs(value)["maps"][0].update(finish_ms=finish_ms, perception_ms=0.0))
    return record(run)


def of_costs(done: Any) -> Any:
    return done["steps"]["predict"]["remarks"]["costs"]


def record(run: Path) -> Path:
    """The run with completion records that match its files, as if it had been written so."""
    for done in run.rglob("done.json"):

        def mark_complete(value: Any, folder: Path = done.parent) -> None:
            for step in value["steps"].values():
                step["files"] = {name: digest_file(folder / name) for name in step["files"] if (folder / name).exists()}

        edit(done, mark_complete)
    return run


def counted_otherwise(run: Path, n_points: int = 5) -> Path:
    """The run with ``n_points`` chair points called sofa, in both counts and metrics."""
    scores: dict[str, dict[str, Any]] = {}
    for file in run.rglob("collector/counts.npz"):
        of_scene = unpack_scores(file.read_bytes())
        counts = of_scene["rooms-semantic"].counts
        assert isinstance(counts, SemanticCounts)
        chair, other = np.flatnonzero(counts.confusion.any(axis=1))[:2]
        counts.confusion[chair, [chair, other]] += (-n_points, n_points)
        file.write_bytes(pack_scores(of_scene))
        scene = file.parent.parent.name.replace(".", "/")
        scores |= {name: {**scores.get(name, {}), scene: score} for name, score in of_scene.items()}

    def change(metrics: Any) -> None:
        for result in metrics["results"]:
            result["result"] = combine(load_protocol(result["protocol"]), scores[result["protocol"]]).to_json()

    edit(run / "metrics.json", change)
    return record(run)


def edit(path: Path, change: Callable[[Any], None]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def in_metrics(change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda run: edit(run / "metrics.json", change)


def in_record(change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda run: edit(run / "run.json", change)


def lowered(table: str, *keys: str, by: float = 0.001) -> Callable[[Path], None]:
    def change(metrics: Any) -> None:
        row = metrics["results"][0]["result"][table]
        for key in keys[:-1]:
            row = row[key]
        row[keys[-1]] -= by

    return in_metrics(change)


def slower(factor: float) -> Callable[[Path], Path]:
    return lambda run: timed(run, [40.0 * factor] * 6)


def without_calibration(run: Path) -> None:
    for done in run.rglob("collector/done.json"):
        edit(done, lambda value: of_costs(value).update(calibration_ms=None))


def results_in(run: Any) -> Any:
    return run.results["collector", "rooms-semantic"].result
