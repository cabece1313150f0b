"""Memory over a long sequence: 5,578 frames (as in ScanNet's scene0000_00) at stride 1, the camera going to and fro.

    python benchmarks long_sequence
    python benchmarks long_sequence --frames 1200 --features 64

Once the camera has been everywhere the map stops growing, and so should memory. Frames are synthetic (160x120; 20 m
of the corridor of ``corridor.py``, perfect masks, features as long as CLIP's) and processed as in a run: read ahead,
fed to OpenSU3D, timed. Every 500 frames: points of the map, resident set, size of the scratch file.
"""

from __future__ import annotations

import argparse
import csv
import io
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from corridor import Corridor, Walk
from measured import write_measured

from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.system.timing import MethodClock
from su3d_bench.core.types import BoolArray, Detections, Float32Array, Frame, PerceptionNeeds, SceneInfo
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.runs.frame_loop import MethodFeed, ReadAhead

N_FRAMES = 5578
LENGTH_M, STEP_M = 20, 0.25
N_PLACES = round(LENGTH_M / STEP_M)
N_THINGS = 300  # more than the corridor has
MAX_MASKS, MIN_PIXELS = 24, 40
SAMPLE_EVERY, SHOW_EVERY = 100, 500


@dataclass(frozen=True)
class Place:
    """The view from one place: a frame, and the masks of the largest objects in it with their numbers."""

    frame: Frame
    masks: BoolArray
    things: tuple[int, ...]


def seen_from(walk: Walk, number: int) -> Place:
    frame: Frame = walk[number]
    owner = walk._cast(number)[1]
    pixels = np.bincount(owner.ravel(), minlength=N_THINGS)
    largest = [int(k) for k in np.argsort(-pixels, kind="stable")[:MAX_MASKS] if pixels[k] >= MIN_PIXELS]
    masks = np.array([(owner == k) & (frame.depth_m > 0) for k in largest])
    return Place(frame, masks, tuple(largest))


class Pacing(Sequence[Frame]):
    """Frames of a camera that moves to the end of the corridor and back repeatedly, with fixed orientation."""

    def __init__(self, n_frames: int) -> None:
        self._n_frames = n_frames
        walk = Walk(LENGTH_M, Corridor.Options(width=160, height=120, step_m=STEP_M), 1)
        self._places = [seen_from(walk, number) for number in range(N_PLACES)]

    def __len__(self) -> int:
        return self._n_frames

    def place_of(self, index: int) -> Place:
        return self._places[abs((index + N_PLACES - 1) % (2 * N_PLACES - 2) - (N_PLACES - 1))]

    def __getitem__(self, index: Any) -> Any:
        frame = self.place_of(index).frame
        return replace(frame, index=index, timestamp_s=index / 30.0, depth_m=frame.depth_m.copy())


class Faultless:
    """Perception that knows every object: its mask, and its feature with noise in every view."""

    def __init__(self, frames: Pacing, n_dimensions: int) -> None:
        self._frames = frames
        self._generator = np.random.default_rng(0)
        self._features = self._generator.normal(size=(N_THINGS, n_dimensions)).astype(np.float32)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        place = self._frames.place_of(frame.index)
        n = len(place.things)
        noise = self._generator.normal(0, 0.1, (n, len(needs.crop_ratios), self._features.shape[1]))
        features: Float32Array = (self._features[list(place.things)][:, None] + noise).astype(np.float32)
        return Detections(
            frame_index=frame.index,
            masks=place.masks,
            boxes=np.zeros((n, 4), np.float32),
            scores=self._generator.uniform(0.5, 1.0, n).astype(np.float32),
            names=tuple(f"thing {k}" for k in place.things),
            captions=tuple(f"a photo of thing {k}" for k in place.things),
            crop_ratios=needs.crop_ratios,
            crop_features=features,
            global_feature=features.mean(axis=(0, 1)),
        )


def bytes_per_frame(frames: Sequence[int], rss_bytes: Sequence[int]) -> float:
    """Slope of a straight line through memory at ``frames``."""
    return float(np.polyfit(frames, rss_bytes, 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=N_FRAMES)
    parser.add_argument("--features", type=int, default=768)
    parser.add_argument("--json", type=Path, help="write the table for benchmarks/measured.md")
    arguments = parser.parse_args()
    frames = Pacing(arguments.frames)
    method = OpenSU3D()
    feeding = MethodFeed("long", method, Faultless(frames, arguments.features), lambda event: None, MethodClock())
    method.start(SceneInfo("made", "long", arguments.frames, 1, "rendered-rooms"))
    scratch_mib: dict[int, float] = {}
    start = time.perf_counter()
    with ReadAhead(frames, arguments.frames) as reading:
        for n_fed in [*range(SHOW_EVERY, arguments.frames, SHOW_EVERY), arguments.frames]:
            feeding.up_to(n_fed, reading, arguments.frames)
            scratch_mib[n_fed] = method._scratch.n_bytes / 2**20
            print(f"{n_fed} frames after {time.perf_counter() - start:.0f} s", flush=True)
    updates = list(csv.DictReader(io.StringIO(feeding.updates_text())))
    rows = [
        [
            f"{n:,}",
            f"{int(updates[n - 1]['n_points']):,}",
            f"{sum(int(one['n_detections']) for one in updates[:n]):,}",
            f"{int(updates[n - 1]['rss_bytes']) / 2**20:.1f}",
            f"{mib:.0f}",
            f"{np.median([float(one['total_ms']) for one in updates[max(n - SHOW_EVERY, 0) : n]]):.1f}",
        ]
        for n, mib in scratch_mib.items()
    ]
    settled = range(len(updates) // 2, len(updates), SAMPLE_EVERY)
    slope = bytes_per_frame(settled, [int(updates[k]["rss_bytes"]) for k in settled])
    start = time.perf_counter()
    instances = method.finish()
    notes = [
        f"In the second half memory grows by {slope:,.0f} bytes per frame (a straight line through every "
        f"{SAMPLE_EVERY}th): its row of the update table and at most {MAX_MASKS} views of objects.",
        f"The map at the end: {len(instances.ids):,} instances after {time.perf_counter() - start:.1f} s.",
    ]
    method.close()
    columns = ["frames", "points", "views", "resident set, MiB", "on disk, MiB", "an update, ms"]
    for row in [columns, *rows]:
        print("  ".join(cell.rjust(18) for cell in row))
    print(*notes, sep="\n")
    if arguments.json:
        title = f"{arguments.frames:,} frames at stride 1"
        write_measured(arguments.json, title, "python benchmarks long_sequence", columns, rows, notes)


if __name__ == "__main__":
    main()
