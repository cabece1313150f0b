"""What a run of many jobs rests on: each file read a bounded number of times, sums that give the same numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.files import atomic
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.runs import runner
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.executors import Report
from su3d_bench.runs.job import SceneJob
from su3d_bench.store import run_folder as store

WORDS = ["run", "--scenes", f"{SCENES}/painted.py:Painted/[ab]", "--methods", f"{SCENES}/painted.py:Collector"]
PROTOCOLS = ["--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--out", "out"]


@pytest.fixture
def finished(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A run that is done, in the folder ``out`` below the current one."""
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.chdir(tmp_path)
    assert main([*WORDS, *PROTOCOLS, "--jobs", "1"]) == 0
    return tmp_path / "out"


def test_a_finished_run_starts_no_worker_and_reads_each_seal_twice(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (finished / "metrics.json").read_bytes()
    reads = count_seals_read(monkeypatch)

    monkeypatch.setattr(runner, "run_scene", None)
    assert main([*WORDS, *PROTOCOLS]) == 0
    assert (finished / "metrics.json").read_bytes() == before
    n_jobs = len(list(finished.glob("scenes/*/*/done.json")))
    assert n_jobs > 2
    assert len(reads) <= 2 * n_jobs


def test_a_scene_with_a_damaged_file_is_run_again_to_the_same_numbers(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def seen(job: SceneJob, report: Report) -> Any:
        asked.append(job.scene)
        return scene_run.run_scene(job, report)

    before = (finished / "metrics.json").read_bytes()
    monkeypatch.setattr(runner, "run_scene", seen)
    for name in ("prediction.npz", "counts.npz", "updates.csv", "log.txt", "done.json"):
        damaged = finished / "scenes" / "painted.a" / "collector" / name
        damaged.write_bytes(damaged.read_bytes()[: -1 if name != "done.json" else -7])
        assert main([*WORDS, *PROTOCOLS, "--jobs", "1"]) == 0
        assert asked.pop() == "painted/a" and not asked
        assert (finished / "metrics.json").read_bytes() == before


def count_seals_read(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Grows by the path of every ``done.json`` that is read."""
    reads: list[Path] = []
    read_json = atomic.read_json

    def counted(path: Path) -> Any:
        reads.extend([path] if path.name == "done.json" else [])
        return read_json(path)

    monkeypatch.setattr(store, "read_json", counted)
    return reads


N_CLASSES = 21  # more than numpy sums one after another, so that the order of sums counts


def made_scene(rng: np.random.Generator, n_rows: int, has_ties: bool) -> instance_ap.InstanceCounts:
    """Counts of ``n_rows`` counted predictions; the last class never has an instance."""
    has_truth = rng.random(N_CLASSES) < 0.7
    has_truth[0], has_truth[-1] = True, False
    class_index = rng.integers(0, N_CLASSES, n_rows).astype(np.int32)
    threshold_index = rng.integers(0, 10, n_rows).astype(np.int32)
    is_true = (rng.random(n_rows) < 0.5) & has_truth[class_index]
    n_met = np.zeros((N_CLASSES, 10), np.int64)
    np.add.at(n_met, (class_index[is_true], threshold_index[is_true]), 1)
    n_truth = (n_met.max(axis=1) + rng.integers(1, 4, N_CLASSES)) * has_truth
    return instance_ap.InstanceCounts(
        class_index=class_index,
        threshold_index=threshold_index,
        score=rng.integers(0, 5, n_rows) / 4 if has_ties else rng.random(n_rows),
        is_true=is_true,
        n_missed=n_truth[:, None] - n_met,
        n_truth=n_truth,
        n_small_truth=np.zeros(N_CLASSES, np.int64),
        n_predictions=np.full(N_CLASSES, n_rows),
    )


@pytest.mark.parametrize(("n_scenes", "n_rows", "has_ties"), [(1, 3, False), (7, 90, True), (5, 6000, False)])
def test_compiled_curves_give_the_same_bits(
    n_scenes: int, n_rows: int, has_ties: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(n_rows)
    counts = [made_scene(rng, n_rows, has_ties) for _ in range(n_scenes)]
    weights = rng.multinomial(n_scenes, np.full(n_scenes, 1 / n_scenes), size=90)
    found = {}
    for many in (10**9, 0):
        monkeypatch.setattr(instance_ap, "MANY_ROWS", many)
        together, each = instance_ap.combine(counts), instance_ap.combine_each(counts)
        assert not np.isnan(together.ap)
        drawn = instance_ap.resampled_ap(counts, weights)
        values = [(one.ap, one.ap50, one.ap25) for one in (together, *each)]
        found[many] = [*(one.table for one in (together, *each)), values, *drawn.values()]
    for plain, compiled in zip(*found.values(), strict=True):
        np.testing.assert_array_equal(plain, compiled)
