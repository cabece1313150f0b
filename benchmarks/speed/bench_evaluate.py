"""Time of an evaluation of 8 scenes: 200,000 points, 150 masks each, 48 classes.

From masks in memory, compared with a plain version (one bincount per mask, identical results); then the whole
evaluation of the same masks in the text files of ScanNet's benchmark, including everything reported with the metric:
as a call, as a separate process, and compared with line-by-line reading as in the official script, followed by that
plain version. All give the same AP.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from as_installed import as_installed
from numpy.typing import NDArray

from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.instance.average_precision import (
    MIN_REGION_SIZE,
    THRESHOLDS,
    InstanceAP,
    InstanceCounts,
    combine,
)
from su3d_bench.metrics.instance.scene_counts import count_class, per_scene
from su3d_bench.metrics.protocols.loading import load_protocol

N_SCENES, N_POINTS, N_MASKS, N_INSTANCES = 8, 200_000, 150, 90
PROTOCOL = "replica-openmask3d"
CLASS_IDS = [entry.id for entry in load_protocol(PROTOCOL).scored]
SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
VOID = 93  # walls
MEMORY, FILES = (
    "instance AP, 8 scenes x 200,000 points x 150 masks: " + source for source in ("in memory", "text files")
)


@dataclass(frozen=True)
class Scene:
    """``values`` per point, masks (K, N), and a label and a score for each."""

    values: NDArray[np.int64]
    masks: NDArray[np.bool_]
    labels: NDArray[np.int64]
    scores: NDArray[np.float64]


def make_scene(seed: int) -> Scene:
    """Instances one after another, with walls between; masks cover parts of them and of their surroundings."""
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.choice(N_POINTS, 2 * N_INSTANCES - 1, replace=False))
    classes = np.array(CLASS_IDS)[rng.integers(0, len(CLASS_IDS), N_INSTANCES)]
    values = np.zeros(2 * N_INSTANCES, np.int64)
    values[::2], values[1::2] = classes * 1000 + np.arange(1, N_INSTANCES + 1), VOID * 1000 + 1
    points = np.repeat(values, np.diff([0, *cuts, N_POINTS]))
    masks, labels = np.zeros((N_MASKS, N_POINTS), bool), np.zeros(N_MASKS, np.int64)
    for k in range(N_MASKS):
        start, length = rng.integers(0, N_POINTS - 6000), rng.integers(200, 6000)
        value = points[start + length // 2]
        masks[k] = points == value if value // 1000 != VOID else False
        masks[k, start : start + length // 4] ^= True
        labels[k] = value // 1000
    return Scene(points, masks, labels, rng.random(N_MASKS))


@pytest.fixture(scope="module")
def scenes() -> Sequence[Scene]:
    return [make_scene(seed) for seed in range(N_SCENES)]


def sparse(scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    indices = [np.flatnonzero(mask).astype(np.int32) for mask in scene.masks]
    return np.concatenate([[0], np.cumsum([len(one) for one in indices])]), np.concatenate(indices)


def ours(scenes: Sequence[Scene], masks: Sequence[tuple[NDArray[np.int64], NDArray[np.int32]]]) -> InstanceAP:
    counts = [
        per_scene(scene.values, indptr, indices, scene.labels, scene.scores, CLASS_IDS)
        for scene, (indptr, indices) in zip(scenes, masks, strict=True)
    ]
    return combine(counts)


def one_bincount_per_mask(scenes: Sequence[Scene]) -> InstanceAP:
    """Overlaps by one bincount per mask over its points, from full masks; curves as in the other version."""
    counts = []
    for scene in scenes:
        values, row = np.unique(scene.values, return_inverse=True)
        size_of_value = np.bincount(row)
        label_of_value = values // 1000
        shared = np.array([np.bincount(row[mask], minlength=len(values)) for mask in scene.masks])
        size = scene.masks.sum(axis=1)
        is_void = ~np.isin(label_of_value, CLASS_IDS)
        parts = []
        for index, class_id in enumerate(CLASS_IDS):
            columns = np.flatnonzero(label_of_value == class_id)
            rows = np.flatnonzero((scene.labels == class_id) & (size >= MIN_REGION_SIZE))
            of_class = shared[np.ix_(rows, columns)]
            is_small = size_of_value[columns] < MIN_REGION_SIZE
            ignored = shared[rows][:, is_void].sum(axis=1) + of_class[:, is_small].sum(axis=1)
            iou = of_class / (size_of_value[columns] + size[rows][:, None] - of_class)
            parts.append(count_class(index, iou, ~is_small, scene.scores[rows], ignored / size[rows], THRESHOLDS))
        counts.append(concatenate_classes(parts))
    return combine(counts)


def concatenate_classes(parts: Sequence[InstanceCounts]) -> InstanceCounts:
    names = [field.name for field in fields(InstanceCounts)]
    return InstanceCounts(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def write_files(folder: Path, scenes: Sequence[Scene]) -> None:
    """The layout of the benchmark: one list per scene, one text file per mask, one digit per line, and ground truth."""
    for part in ("gt", "pred/masks"):
        (folder / part).mkdir(parents=True)
    for name, scene in zip(SCENES, scenes, strict=True):
        (folder / f"gt/{name}.txt").write_text("".join(f"{value}\n" for value in scene.values))
        lines = []
        for k, mask in enumerate(scene.masks):
            text = np.full(2 * N_POINTS, ord("\n"), np.uint8)
            text[::2] = ord("0") + mask
            (folder / f"pred/masks/{name}_{k}.txt").write_bytes(text.tobytes())
            lines.append(f"masks/{name}_{k}.txt {scene.labels[k]} {float(scene.scores[k])!r}\n")
        (folder / f"pred/{name}.txt").write_text("".join(lines))


@pytest.mark.benchmark(group=MEMORY)
def test_from_binary_masks(benchmark: Any, scenes: Sequence[Scene]) -> None:
    masks = [sparse(scene) for scene in scenes]
    assert benchmark(ours, scenes, masks).ap > 0


@pytest.mark.benchmark(group=MEMORY)
def test_one_bincount_per_mask(benchmark: Any, scenes: Sequence[Scene]) -> None:
    found = benchmark(one_bincount_per_mask, scenes)
    assert found.ap == ours(scenes, [sparse(scene) for scene in scenes]).ap


@pytest.fixture(scope="module")
def files(scenes: Sequence[Scene], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Half a gigabyte of text files, deleted at the end."""
    folder = tmp_path_factory.mktemp("files")
    write_files(folder, scenes)
    yield folder
    shutil.rmtree(folder)


def line_by_line(folder: Path) -> InstanceAP:
    """The AP of text files, each read as a list of lines."""
    read = []
    for name in SCENES:
        lines = [line.split(" ") for line in (folder / f"pred/{name}.txt").read_text().splitlines()]
        masks = np.array([numbers(folder / "pred" / file) != 0 for file, _, _ in lines])
        labels = np.array([int(label) for _, label, _ in lines])
        read.append(Scene(numbers(folder / f"gt/{name}.txt"), masks, labels, np.array([float(x) for *_, x in lines])))
    return one_bincount_per_mask(read)


def numbers(file: Path) -> NDArray[np.int64]:
    return np.array(file.read_text().splitlines(), np.int64)


@pytest.mark.benchmark(group=FILES)
def test_from_text_files(benchmark: Any, scenes: Sequence[Scene], files: Path) -> None:
    request = Request((files / "pred",), ground_truth=files / "gt", protocols=(PROTOCOL,))
    found = benchmark.pedantic(evaluate, (request,), rounds=3)
    expected = ours(scenes, [sparse(scene) for scene in scenes])
    assert found.protocols[0].result.metrics["AP"] == expected.ap


@pytest.mark.benchmark(group=FILES)
def test_from_text_files_as_a_whole_process(
    benchmark: Any, scenes: Sequence[Scene], files: Path, tmp_path: Path
) -> None:
    answer = tmp_path / "answer.json"
    words = ["evaluate", str(files / "pred"), "--ground-truth", str(files / "gt"), "--protocols", PROTOCOL]
    command = [sys.executable, "-m", "su3d_bench", *words, f"--json={answer}", "--quiet"]
    form = {"check": True, "stdout": subprocess.DEVNULL, "env": as_installed(tmp_path / "compiled")}
    benchmark.pedantic(subprocess.run, (command,), form, rounds=5, warmup_rounds=1)
    expected = ours(scenes, [sparse(scene) for scene in scenes])
    assert json.loads(answer.read_text())["protocols"][PROTOCOL]["metrics"]["ap"] == expected.ap


@pytest.mark.benchmark(group=FILES)
def test_from_text_files_line_by_line(benchmark: Any, scenes: Sequence[Scene], files: Path) -> None:
    found = benchmark.pedantic(line_by_line, (files,), rounds=1)
    assert found.ap == ours(scenes, [sparse(scene) for scene in scenes]).ap
