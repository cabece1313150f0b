"""Memory of a dense map from the first image to its score: fused, written, read again, scored.

    python benchmarks dense_memory
    python benchmarks dense_memory --points 400000 --dimensions 256 --features-in memory

Images of a long wall are fused by ConceptFusion, each twice, so that every point is created once and averaged once:
with features on disk and, for comparison, in memory. A separate process for each reports its peak memory in
each step (resident set, including mapped files) and before the first; one line of JSON per step.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from folders import BENCHMARKS
from measured import write_measured

from su3d_bench.baselines.conceptfusion.method import ConceptFusion, ConceptFusionConfig
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.system.timing import Timer, peak_memory_bytes, start_memory_watch
from su3d_bench.core.types import Detections, Float32Array, Frame, GroundTruth, LabelSet, SceneInfo, UInt8Array
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.runs.frame_loop import warm_up
from su3d_bench.store.predictions import read_prediction, write_prediction

SIDE_PX = 500
FOCAL_PX = 500.0
WALL_M = 2.0
N_STRIPES = 20
RULES = load_protocol("rooms-semantic")
WHERE = {"disk": "features on disk", "memory": "features in memory"}


@dataclass
class RandomDirections:
    """An encoder that gives every text a distinct direction."""

    dim: int
    name: str = "random-directions"
    digest: str = "random-directions"

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("images are not used here")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        rows = [np.random.default_rng(list(text.encode())).normal(size=self.dim) for text in texts]
        return np.array([row / np.linalg.norm(row) for row in rows], np.float32)


def stripes(n_dimensions: int) -> tuple[tuple[str, ...], Float32Array]:
    """The class of each stripe of the wall and the feature of its prompt."""
    names = [entry.name for entry in RULES.classes if not RULES.is_ignored(entry.name)][:N_STRIPES]
    return tuple(names), RandomDirections(n_dimensions).encode_texts([RULES.texts_of(name)[0] for name in names])


def update(index: int, n_dimensions: int) -> tuple[Frame, Detections]:
    """Image ``index`` of a camera moving along the wall without overlap, and its stripes as regions."""
    pose = np.eye(4)
    pose[0, 3] = index * SIDE_PX / FOCAL_PX * WALL_M
    centre = (SIDE_PX - 1) / 2
    intrinsics = np.array([[FOCAL_PX, 0, centre], [0, FOCAL_PX, centre], [0, 0, 1]])
    depth_m = np.full((SIDE_PX, SIDE_PX), WALL_M, np.float32)
    frame = Frame(index, 0.0, np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8), depth_m, pose, intrinsics)
    names, features = stripes(n_dimensions)
    stripe = np.arange(SIDE_PX) * len(names) // SIDE_PX
    masks = np.repeat((stripe == np.arange(len(names))[:, None])[:, None], SIDE_PX, axis=1)
    found = Detections(
        frame_index=index,
        masks=masks,
        boxes=np.tile(np.array([0, 0, SIDE_PX, SIDE_PX], np.float32), (len(names), 1)),
        scores=np.ones(len(names), np.float32),
        names=names,
        captions=names,
        crop_ratios=(1.0,),
        crop_features=features[:, None],
        global_feature=(features.mean(axis=0) / np.linalg.norm(features.mean(axis=0))).astype(np.float32),
    )
    return frame, found


def truth_of(n_images: int) -> GroundTruth:
    """Points on the wall every 2 cm, labelled with their stripe."""
    labels = LabelSet("replica", tuple(entry.id for entry in RULES.classes), tuple(c.name for c in RULES.classes))
    names, _ = stripes(8)
    ids = np.array([labels.ids[labels.names.index(name)] for name in names], np.int32)
    pixel = np.arange(2, SIDE_PX, 5)
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(n_images * SIDE_PX)[2::5], pixel))
    inside = column % SIDE_PX
    image = column // SIDE_PX
    metres = WALL_M / FOCAL_PX
    x = (inside - (SIDE_PX - 1) / 2) * metres + image * SIDE_PX * metres
    points = np.stack([x, (row - (SIDE_PX - 1) / 2) * metres, np.full(len(x), WALL_M)], axis=1).astype(np.float32)
    stripe = inside * len(names) // SIDE_PX
    return GroundTruth(points, ids[stripe], (stripe + 1).astype(np.int32), labels, RULES.ground_truth, "made")


@contextmanager
def reported(step: str) -> Iterator[dict[str, Any]]:
    """Print the step's costs once it is done, with its results."""
    start_memory_watch()
    start = time.perf_counter()
    found: dict[str, Any] = {}
    yield found
    line = {"step": step, "peak_bytes": peak_memory_bytes(), "seconds": round(time.perf_counter() - start, 1)} | found
    print(json.dumps(line), flush=True)


def work(n_points: int, n_dimensions: int, feature_storage: str, folder: Path) -> None:
    """All steps in this process."""
    n_images = -(-n_points // SIDE_PX**2)
    config: Callable[..., ConceptFusionConfig] = ConceptFusionConfig
    method = ConceptFusion(config(height=SIDE_PX, width=SIDE_PX, sigma=2.0, feature_storage=feature_storage))
    warm_up(ConceptFusion(config(height=SIDE_PX, width=SIDE_PX, sigma=2.0, feature_storage="memory")))  # as in a run
    method.start(SceneInfo("made", "wall", 2 * n_images, 1, "rendered-rooms"))
    with reported("start"):
        pass
    with reported("fuse") as found:
        for index in [*range(n_images), *range(n_images)]:
            method.update(*update(index, n_dimensions), Timer())
        found["n_points"] = method.n_points
    with reported("write"):
        write_prediction(folder / "prediction.npz", method.finish())
        method.close()
    with reported("read and score") as found:
        prediction = read_prediction(folder / "prediction.npz")
        assert isinstance(prediction, DenseFeatures)
        score = score_scene(RULES, truth_of(n_images), prediction, RandomDirections(n_dimensions))
        found |= combine(RULES, {"wall": score}).metrics
        found["features_bytes"] = prediction.features.nbytes


def in_a_process(feature_storage: str, n_points: int, n_dimensions: int, folder: Path) -> list[dict[str, Any]]:
    """The report of each step, in order; the prediction stays in ``folder``."""
    words = ["--points", str(n_points), "--dimensions", str(n_dimensions), "--features-in", feature_storage]
    command = [sys.executable, str(BENCHMARKS), "dense_memory", *words, "--folder", str(folder), "--here"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    steps = [{"feature_storage": feature_storage} | json.loads(line) for line in done.stdout.splitlines()]
    print(*map(json.dumps, steps), sep="\n", flush=True)
    return steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2_000_000)
    parser.add_argument("--dimensions", type=int, default=1024)
    parser.add_argument("--features-in", nargs="+", default=["disk", "memory"], choices=("disk", "memory"))
    parser.add_argument("--folder", type=Path, help="existing folder for the prediction, which is kept")
    parser.add_argument("--json", type=Path, help="write the table for benchmarks/measured.md")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.here:
        work(arguments.points, arguments.dimensions, arguments.feature_storage[0], arguments.folder)
        return
    series: dict[str, list[dict[str, Any]]] = {}
    for where in arguments.feature_storage:
        with tempfile.TemporaryDirectory(prefix="dense-memory-") as made:
            series[where] = in_a_process(where, arguments.points, arguments.dimensions, arguments.folder or Path(made))
    if arguments.json:
        columns = ["step", *(f"{what}, {WHERE[word]}" for word in series for what in ("resident, MiB", "seconds"))]
        rows = [
            [
                steps[0]["step"],
                *(cell for one in steps for cell in (f"{one['peak_bytes'] / 2**20:.0f}", str(one["seconds"]))),
            ]
            for steps in zip(*series.values(), strict=True)
        ]
        n_points, n_bytes = (
            next(iter(series.values()))[step][key] for step, key in ((1, "n_points"), (3, "features_bytes"))
        )
        title = f"A dense map of {n_points:,} points with {arguments.dimensions} features each"
        notes = [f"The features take {n_bytes / 2**20:.0f} MiB in half precision on disk."]
        write_measured(arguments.json, title, "python benchmarks dense_memory", columns, rows, notes)


if __name__ == "__main__":
    main()
