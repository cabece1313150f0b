"""Runs of many jobs: each file is read a bounded number of times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.files import atomic
from su3d_bench.runs import runner
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.executors import Report
from su3d_bench.runs.job import SceneJob
from su3d_bench.store import run_folder as store

WORDS = ["run", "--scenes", f"{SCENES}/painted.py:Painted/[ab]", "--methods", f"{SCENES}/painted.py:Collector"]
PROTOCOLS = ["--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--out", "out"]


@pytest.fixture
def finished(painted_place: Path) -> Path:
    """A finished run, in the folder ``out`` below the current one."""
    assert main([*WORDS, *PROTOCOLS, "--jobs", "1"]) == 0
    return painted_place / "out"


def test_finished_run_starts_no_worker_and_reads_each_completion_record_at_most_twice(
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


def test_scene_with_a_damaged_file_is_run_again_with_the_same_numbers(
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
    """A list that grows by the path of every ``done.json`` that is read."""
    reads: list[Path] = []
    read_json = atomic.read_json

    def counted(path: Path) -> Any:
        reads.extend([path] if path.name == "done.json" else [])
        return read_json(path)

    monkeypatch.setattr(store, "read_json", counted)
    return reads
