"""Results on a GPU compared with the CPU: similarity, every kind of model, a run; differences and times.

    python benchmarks on_gpu --json build/measured/on_gpu.json
    python benchmarks on_gpu --device cpu

About two minutes on a machine with a GPU; without one it ends immediately with one line and code 2. ``--device cpu``
uses torch on the CPU, which tests everything but the GPU. Models have the tests' small configurations and
random weights; ``paper_profile_speed.py --device cuda`` has the full sizes. The code is 1 if a difference is larger
than its tolerance. Times are the best of five (of the whole run: the second), from host arrays to host arrays.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measured import write_measured
from numpy.typing import NDArray
from tiny_models import DINO_PX, SAM_PX, blocks, noise_images, tiny_dino, tiny_sam, tiny_tokenizer, write_tiny_clip

from su3d_bench.cli.main import main as command_line
from su3d_bench.core.errors import ConfigError, ModelMissing
from su3d_bench.core.system.devices import device_for, make_deterministic
from su3d_bench.core.system.timing import synchronise_device
from su3d_bench.metrics.matching.labelling import cosines, most_similar
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.loading import load_encoder
from su3d_bench.perception.models.masks.grounding_dino import GroundingDino
from su3d_bench.perception.models.masks.sam import Sam, TorchSam

REPEATS = 5
TORCH_ON_CPU = "cpu:0"  # not "cpu", for which the package does not use torch
CLIP = "clip-vit-h-14"
TEXTS = ("a chair in a scene", "the lamp", "tv screen", "a red cup on the table")
Arrays = Iterable[NDArray[Any]]


@dataclass(frozen=True)
class Comparison:
    """``on(device)`` returns the work there; ``tolerance`` limits the largest difference, or the share that differs."""

    what: str
    on: Callable[[str], Callable[[], Arrays]]
    tolerance: float
    is_share: bool = False
    repeats: int = REPEATS


def difference(one: Comparison, here: Arrays, there: Arrays) -> float:
    """The largest difference of any entry, or the largest share of entries that differ."""
    found = 0.0
    for a, b in zip(here, there, strict=True):
        if a.shape != b.shape:
            return float("inf")
        if one.is_share:
            found = max(found, float((a != b).mean()) if a.size else 0.0)
        else:
            found = max(found, float(np.abs(a.astype(np.float64) - b.astype(np.float64)).max(initial=0.0)))
    return found


def measured(work: Callable[[], Arrays], repeats: int) -> tuple[Arrays, float]:
    """The result of ``work``, and its best time in milliseconds after one warm-up run."""
    best = float("inf")
    for k in range(repeats + 1):
        synchronise_device()
        start = time.perf_counter()
        found = work()
        synchronise_device()
        if k:
            best = min(best, time.perf_counter() - start)
    return found, best * 1e3


def similarities() -> Iterator[Comparison]:
    """Labels of points, and cosines of units and prompts."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(100_000, 512)).astype(np.float32)
    text = rng.normal(size=(200, 512)).astype(np.float32)

    yield Comparison(
        "labels of 100,000 x 512 among 200", lambda device: lambda: (most_similar(features, text, device),), 0.0, True
    )
    yield Comparison(
        "cosines of 8,192 x 512 with 200",
        lambda device: lambda: (cosines(features[:8192], text, device),),
        1e-12,
    )


def encoders(folder: Path) -> Iterator[Comparison]:
    """A small CLIP by torch in two precisions."""
    images = noise_images(32)

    write_tiny_clip(folder / CLIP)

    def clip(**settings: Any) -> Callable[[str], Callable[[], Arrays]]:
        def on(device: str) -> Callable[[], Arrays]:
            place = {"device": "cpu" if device.startswith("cpu") else device}
            if device == "cpu":  # the reference for all
                place["precision"] = "float32"
            config = ModelsConfig(encoder=CLIP, folder=folder, **(settings | place))
            return lambda: (load_encoder(config).encode_images(images), load_encoder(config).encode_texts(TEXTS))

        return on

    yield Comparison("CLIP by torch, float32, 32 images", clip(precision="float32"), 1e-4)
    yield Comparison("CLIP by torch, float16 (the CPU: float32), 32 images", clip(precision="float16"), 2e-2)


def networks(folder: Path) -> Iterator[Comparison]:
    """SAM's masks of boxes and GroundingDINO's probabilities and boxes."""
    rgb = blocks(60, 100)
    boxes = np.array([[5, 5, 60, 50], [0, 0, 100, 60], [40, 10, 90, 40]], np.float32)
    tokenizer = tiny_tokenizer(folder)

    def sam(device: str) -> Callable[[], Arrays]:
        segmenter = Sam(TorchSam(copy.deepcopy(tiny_sam()).to(device)))
        return lambda: (segmenter.from_boxes(segmenter.look(rgb), boxes, is_single=False)[0],)

    def dino(device: str) -> Callable[[], Arrays]:
        detector = GroundingDino(copy.deepcopy(tiny_dino()).to(device), tokenizer, *DINO_PX)
        pixels = detector.pixels(rgb)
        return lambda: detector.answer(pixels, "cat. coffee table. lamp.")[:2]

    yield Comparison(f"SAM ({SAM_PX} px) by torch, masks of 3 boxes", sam, 0.01, is_share=True)
    yield Comparison("GroundingDINO by torch, probabilities and boxes", dino, 1e-3)


def runs(folder: Path) -> Iterator[Comparison]:
    """Metrics of a complete run of five updates, by the command line."""

    def run(device: str) -> Callable[[], Arrays]:
        name = "cpu" if device.startswith("cpu") else device
        words = ["run", "--scenes", "rooms/living0", "--limit", "5", "--no-pictures", "--jobs", "1", "--json"]
        words += ["--device", name, "--set", "perception.cache=false", "--quiet"]

        def work() -> Arrays:
            output = io.StringIO()
            with contextlib.redirect_stdout(output), tempfile.TemporaryDirectory(dir=folder) as out:
                if command_line([*words, "--out", f"{out}/run"]) != 0:
                    raise SystemExit(f"su3d-bench {' '.join(words)}: failed")
            return (np.array(list(numbers(json.loads(output.getvalue())))),)

        return work

    yield Comparison("run: rooms/living0, 5 updates, all metrics", run, 1e-3, repeats=1)


def numbers(content: Any) -> Iterator[float]:
    """All numbers in JSON, in order, except times."""
    if isinstance(content, dict):
        for key, value in content.items():
            if not key.endswith(("_ms", "_s", "_bytes")):
                yield from numbers(value)
    elif isinstance(content, list):
        for value in content:
            yield from numbers(value)
    elif isinstance(content, int | float):
        yield float(content)


def compare(one: Comparison, device: str) -> tuple[list[str], bool]:
    """A row of the table, and whether the difference is within its tolerance."""
    here, here_ms = measured(one.on("cpu"), one.repeats)
    try:
        there, there_ms = measured(one.on(device), one.repeats)
    except ModelMissing as error:
        return [one.what, f"{here_ms:.1f} ms", "not run", "-", str(error)], True
    found = difference(one, here, there)
    kind = " of entries" if one.is_share else ""
    row = [one.what, f"{here_ms:.1f} ms", f"{there_ms:.1f} ms", f"{found:.1e}{kind}", f"{one.tolerance:g}{kind}"]
    return row, found <= one.tolerance


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0", help="cuda:0, another GPU, or cpu: torch on the CPU")
    parser.add_argument("--json", type=Path, help="write the table for benchmarks/measured.md")
    arguments = parser.parse_args()
    try:
        device = device_for(arguments.device, 0)
    except (ConfigError, ModelMissing) as error:
        print(f"on_gpu.py: {error}", file=sys.stderr)
        return 2
    import torch

    where = f"torch on the CPU, {torch.get_num_threads()} threads" if device == "cpu" else torch.cuda.get_device_name()
    make_deterministic(device)
    rows: list[list[str]] = []
    is_within = True
    with tempfile.TemporaryDirectory(prefix="on-gpu-") as name:
        folder = Path(name)
        parts: Sequence[Iterator[Comparison]] = (
            similarities(), encoders(folder), networks(folder), runs(folder)
        )  # fmt: skip
        for one in (each for part in parts for each in part):
            row, is_good = compare(one, TORCH_ON_CPU if device == "cpu" else device)
            is_within &= is_good
            rows.append(row)
            print("  ".join(row), "" if is_good else "  TOO LARGE", flush=True)
    if arguments.json:
        columns = ["what", "CPU", where, "largest difference", "tolerance"]
        notes = [
            f"torch {torch.__version__}, {os.cpu_count()} CPU cores.",
            "RAM++ is not among the models: its architecture is in its own package.",
            "The networks are small: their times are dominated by starting work on the device.",
        ]
        words = f"python benchmarks on_gpu --device {arguments.device}"
        write_measured(arguments.json, f"{where} compared with the CPU", words, columns, rows, notes)
    return 0 if is_within else 1


if __name__ == "__main__":
    sys.exit(main())
