"""Cost of a scene here, stage by stage, and estimated costs of all of ScanNet and of 100,000 scenes.

    python benchmarks unit_costs --json build/measured/unit_costs.json

Measured: opensu3d under the embedded profile on two rooms with an empty cache and one job, the start of a worker, and
the decoding of a frame at ScanNet's sizes. Not measured: the scans themselves, whose number and sizes are stated by
ScanNet, and the network, whose speed is assumed; rooms are used instead of scans.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import subprocess
import sys
import tempfile
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from measured import write_measured

SCENES = ("rooms/living0", "rooms/office0")
STRIDE = 40  # opensu3d's default
N_CORES = 2  # per machine in the estimate, one job each
SCANS = 1513
SCANNET_FRAMES = 2_492_518  # in 1,513 scans (Dai et al., CVPR 2017, table 2)
SCANNET_BYTES = 1.3e12  # "the entire ScanNet release (1.3TB)" in the instructions that come with download-scannet.py
NETWORK_BYTES_S = 1.25e9  # 10 Gbit/s out of the store, shared by all machines: assumed
MACHINES = (1, 10, 100)
GB, TB = 1e9, 1e12


@dataclass(frozen=True)
class Costs:
    """Seconds and bytes of one update and one scene."""

    stages_ms: dict[str, float]
    decode_ms: float
    scene_s: float
    start_s: float
    result_bytes: float
    cache_bytes: float
    peak_bytes: int

    def seconds(self, n_updates: float) -> float:
        """Cost of a scan on one core, with decoding instead of rendering."""
        update_ms = sum(ms for stage, ms in self.stages_ms.items() if stage != "decode") + self.decode_ms
        return self.start_s + self.scene_s + n_updates * update_ms / 1e3


def measure(folder: Path) -> Costs:
    environment = os.environ | {"SU3D_CACHE": str(folder / "cache")}
    words = ["run", "--scenes", *SCENES, "--methods", "opensu3d", "--profile", "embedded", "--no-pictures", "--quiet"]
    words += ["--jobs", "1", "--protocols", "rooms-semantic", "rooms-instance", "--out", str(folder / "run")]
    start_s = min(_seconds(["-c", "import su3d_bench.runs.scene, open3d"], environment) for _ in range(2))
    run_s = _seconds(["-m", "su3d_bench", *words], environment)
    jobs = sorted((folder / "run" / "scenes").glob("*/opensu3d"))
    rows = [row for job in jobs for row in csv.DictReader((job / "updates.csv").open())]
    stages = [name for name in rows[0] if name.endswith("_ms") and name != "total_ms"]
    updates_s = sum(float(row["total_ms"]) for row in rows) / 1e3
    files = [path for job in jobs for path in job.rglob("*") if path.is_file()]
    cached = [path for path in (folder / "cache" / "perception").rglob("*") if path.is_file()]
    return Costs(
        stages_ms={name[:-3]: sum(float(row[name]) for row in rows) / len(rows) for name in stages},
        decode_ms=_decode_ms(),
        scene_s=(run_s - start_s - updates_s) / len(SCENES),
        start_s=start_s,
        result_bytes=sum(path.stat().st_size for path in files) / len(SCENES),
        cache_bytes=sum(path.stat().st_size for path in cached) / len(rows),
        peak_bytes=max(int(row["rss_bytes"]) for row in rows),
    )


def _seconds(words: list[str], environment: dict[str, str]) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, *words], check=True, env=environment, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def _decode_ms() -> float:
    """A colour JPEG of 1296x968 and a depth image of 640x480, as stored in a ``.sens``; the best of five."""
    noise = np.random.default_rng(0)
    smooth = cv2.resize(noise.integers(0, 255, (121, 162, 3), np.uint8), (1296, 968), interpolation=cv2.INTER_CUBIC)
    colour = cv2.imencode(".jpg", smooth)[1]
    depth = zlib.compress((1000 + np.add.outer(np.arange(480), np.arange(640))).astype(np.uint16).tobytes())
    times = []
    for _ in range(5):
        start = time.perf_counter()
        cv2.imdecode(colour, cv2.IMREAD_COLOR)
        zlib.decompress(depth)
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def unit_rows(costs: Costs) -> list[list[str]]:
    rows = [[f"an update: {stage}", f"{ms:.1f} ms"] for stage, ms in costs.stages_ms.items()]
    return [
        *rows,
        ["decoding a ScanNet frame", f"{costs.decode_ms:.1f} ms"],
        ["a scene: reading, finishing, scoring", f"{costs.scene_s:.1f} s"],
        ["starting a worker", f"{costs.start_s:.1f} s"],
        ["results of a scene", f"{costs.result_bytes / 1e6:.1f} MB"],
        ["perception cache of an update", f"{costs.cache_bytes / 1e6:.2f} MB"],
        ["memory of a worker", f"{costs.peak_bytes / GB:.2f} GB"],
    ]


def plan_rows(costs: Costs) -> list[list[str]]:
    """Both runs, on 1, 10 and 100 machines."""
    n_updates = math.ceil(SCANNET_FRAMES / SCANS / STRIDE)
    rows = []
    for n_scenes in (SCANS, 100_000):
        core_s = n_scenes * costs.seconds(n_updates)
        data = n_scenes * SCANNET_BYTES / SCANS
        results, cache = n_scenes * costs.result_bytes, n_scenes * n_updates * costs.cache_bytes
        for n_machines in MACHINES:
            compute_s, network_s = core_s / N_CORES / n_machines, data / NETWORK_BYTES_S
            hours = max(compute_s, network_s) / 3600
            rows.append(
                [
                    f"{n_scenes:,} scenes, {n_machines} machines",
                    f"{core_s / N_CORES / 3600:,.1f}",
                    f"{hours:,.1f}",
                    f"{data / TB:.1f} + {results / TB:.2f} + {cache / TB:.2f}",
                    "compute" if compute_s > network_s else "the store's network",
                ]
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the table to FILE")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="su3d-costs-") as folder:
        costs = measure(Path(folder))
    for row in [*unit_rows(costs), *plan_rows(costs)]:
        print(" | ".join(row))
    if arguments.json is not None:
        units = "; ".join(f"{what} {value}" for what, value in unit_rows(costs))
        write_measured(
            arguments.json,
            "All of ScanNet, and 100,000 scenes, estimated",
            "python benchmarks unit_costs --json build/measured/unit_costs.json",
            ["what", "machine hours (2 cores)", "hours", "storage: data + results + cache (TB)", "bottleneck"],
            plan_rows(costs),
            [
                f"Unit costs, measured here: {units}.",
                "Not measured: the scans (1,513 with 2,492,518 frames: Dai et al., CVPR 2017, table 2; 1.3 TB: the "
                "instructions with ScanNet's download-scannet.py; every 40th frame is an update; a room is used for a "
                "scan) and the store's network (10 Gbit/s assumed).",
            ],
        )


if __name__ == "__main__":
    main()
