"""Costs of a map of 20 million points and 5,000 instances: update, finish, write, read, score.

    python benchmarks big_map
    python benchmarks big_map --points 1000000 --instances 250 --json build/measured/big_map.json

Objects are on a grid: boxes with points at most 2 cm apart on their faces, each seen in three images; one is
clustered as one. Then the wall of ``wall.py`` is fused repeatedly: those updates
are timed. Memory is the peak resident set in each step.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from dense_memory import RandomDirections
from measured import write_measured
from wall import view

from su3d_bench.core.system.timing import Timer, peak_memory_bytes, start_memory_watch
from su3d_bench.core.types import Detections, Float32Array, Float64Array, GroundTruth, Int32Array, LabelSet, SceneInfo
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.opensu3d.tracking import View, record_of
from su3d_bench.store.predictions import read_prediction, write_prediction

RULES = load_protocol("rooms-semantic")
CLASSES = [entry for entry in RULES.classes if not RULES.is_ignored(entry.name)]
PER_IMAGE = 20  # objects
N_VIEWS = 3  # of an object
DIMENSIONS = 512
SIDES_M = np.array([1.0, 0.7, 0.5])
APART_M = 2.0
Rows = list[list[str]]


@contextmanager
def measured(rows: Rows, step: str) -> Iterator[list[str]]:
    """Add a row: the step, its seconds, its peak memory and the remarks that the block appends to the yielded list."""
    found: list[str] = []
    start_memory_watch()
    start = time.perf_counter()
    yield found
    seconds = time.perf_counter() - start
    rows.append([step, f"{seconds:.1f} s", f"{(peak_memory_bytes() or 0) / 2**20:.0f}", "; ".join(found)])
    print(*rows[-1], sep="  ", flush=True)


def faces(generator: np.random.Generator, n: int) -> Float64Array:
    """``n`` points on the faces of a box at the origin."""
    points = generator.uniform(-0.5, 0.5, (n, 3))
    face = generator.integers(0, 3, n)
    points[np.arange(n), face] = np.copysign(0.5, points[np.arange(n), face])
    return points * SIDES_M


def detections_of(position: int, objects: range, features: Float32Array, names: tuple[str, ...]) -> Detections:
    """One image of ``objects``; only fields used by the map are filled."""
    n = len(objects)
    own = features[[k % len(features) for k in objects]]
    return Detections(
        frame_index=position,
        masks=np.zeros((n, 1, 1), np.bool_),
        boxes=np.zeros((n, 4), np.float32),
        scores=np.full(n, 0.9, np.float32),
        names=tuple(names[k % len(names)] for k in objects),
        captions=("",) * n,
        crop_ratios=(0.8, 1.0, 1.2),
        crop_features=np.repeat(own[:, None], 3, axis=1),
        global_feature=own[0],
    )


def fill(method: OpenSU3D, n_points: int, n_instances: int) -> GroundTruth:
    """Put the objects into the map of ``method``, as many updates would have; returns the ground truth at each 20th."""
    generator = np.random.default_rng(0)
    names = tuple(entry.name for entry in CLASSES)
    features = RandomDirections(DIMENSIONS).encode_texts([RULES.texts_of(name)[0] for name in names])
    truths: list[tuple[Float32Array, Int32Array, Int32Array]] = []
    side = int(np.ceil(n_instances**0.5))
    for first in range(0, n_instances, PER_IMAGE):
        objects = range(first, min(first + PER_IMAGE, n_instances))
        hits = []
        for k in objects:
            n = n_points * (k + 1) // n_instances - n_points * k // n_instances
            points = faces(generator, n) + np.array([APART_M * (k % side), APART_M * (k // side), -10.0])
            hits.append(method._map.insert(points, np.full(n, k + 1, np.int32)))
            ids = np.full(len(points[::20]), CLASSES[k % len(CLASSES)].id, np.int32)
            truths.append((points[::20].astype(np.float32), ids, np.full(len(ids), k + 1, np.int32)))
        segment = np.repeat(np.arange(len(objects), dtype=np.int32), [len(each) for each in hits])
        for part in range(N_VIEWS):
            position = len(method._images)
            found = detections_of(position, objects, features, names)
            seen = slice(part, None, 2 * N_VIEWS)  # half of its points in total
            record = record_of(found, method.config.fusion, segment[seen], np.concatenate(hits)[seen], method._scratch)
            method._images.append(record)
            for row, k in enumerate(objects):
                method._table[k + 1].append(View(position, row))
    method._next_id = n_instances + 1
    labels = LabelSet("replica", tuple(entry.id for entry in RULES.classes), tuple(c.name for c in RULES.classes))
    points, ids, instances = (np.concatenate(column) for column in zip(*truths, strict=True))
    return GroundTruth(points, ids, instances, labels, RULES.ground_truth, "made")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=20_000_000)
    parser.add_argument("--instances", type=int, default=5_000)
    parser.add_argument("--json", type=Path, help="write the table for benchmarks/measured.md")
    arguments = parser.parse_args()
    rows: Rows = []
    method = OpenSU3D()
    method.start(SceneInfo("made", "objects", 1, 1, "rendered-rooms"))
    with measured(rows, "fill") as found:
        truth = fill(method, arguments.points, arguments.instances)
        found.append(f"{method.n_points:,} points, {method.n_instances:,} instances")
    with measured(rows, "22 updates") as found:
        spent = []
        frame, detections = view()
        n = len(detections)
        detections = replace(
            detections,
            crop_features=np.ones((n, 3, DIMENSIONS), np.float32),
            global_feature=np.ones(DIMENSIONS, np.float32),
        )
        for _ in range(22):
            start = time.perf_counter()
            method.update(frame, detections, Timer())
            spent.append(time.perf_counter() - start)
        found.append(f"the median of the last 20 is {np.median(spent[2:]) * 1e3:.0f} ms")
    with measured(rows, "finish") as found:
        instances = method.finish()
        found.append(f"{len(instances.points):,} points, {len(instances.ids):,} instances")
    method.close()
    with tempfile.TemporaryDirectory(prefix="big-map-") as folder:
        path = Path(folder) / "prediction.npz"
        with measured(rows, "write") as found:
            write_prediction(path, instances)
            found.append(f"{path.stat().st_size / 2**20:.0f} MiB")
        del instances
        with measured(rows, "read"):
            prediction = read_prediction(path)
        with measured(rows, "score") as found:
            score = score_scene(RULES, truth, prediction, RandomDirections(DIMENSIONS))
            metrics = combine(RULES, {"objects": score}).metrics
            found.append(", ".join(f"{name} {value:.3g}" for name, value in list(metrics.items())[:2]))
    if arguments.json:
        title = f"A map of {arguments.points / 1e6:g} million points and {arguments.instances:,} instances"
        notes = [
            "Memory is the peak resident set in each step. The score is that of rooms-semantic; for instance "
            "AP the ground truth of a scene may have at most 999 instances."
        ]
        columns = ["step", "time", "peak memory, MiB", "result"]
        write_measured(arguments.json, title, "python benchmarks big_map", columns, rows, notes)


if __name__ == "__main__":
    main()
