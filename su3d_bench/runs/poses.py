"""Whether a recording's poses agree with its depth, checked on a few frames before a scene's work begins.

How wrong poses and a different up axis are detected is in ``datasets.recordings``, which ``datasets check`` uses too.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

from su3d_bench.core.errors import DataError, error_line
from su3d_bench.core.interfaces import ProvidesUpAxis
from su3d_bench.core.registry import DATASETS
from su3d_bench.datasets.recordings.pose_convention import judge_scene
from su3d_bench.runs.job import SceneJob, build_dataset, build_method
from su3d_bench.store.run_folder import RunFolder

ACCEPT_POSES_HINT = "--accept-poses runs it anyway"
REMARK = "doubts"  # key in the completion record of a prediction


class PosesContradicted(DataError):
    """Another interpretation of poses or depth agrees clearly better than the one that a run would use."""


Remarks = tuple[tuple[str, ...], bool]  # warnings about a scene, and whether it must not be run
NOTHING: Remarks = ((), False)


def judged(jobs: Sequence[SceneJob]) -> tuple[SceneJob, ...]:
    """The jobs with the warnings about their poses; ``PosesContradicted`` if one of them must not be run."""
    with silent(), ThreadPoolExecutor(os.cpu_count()) as threads:
        remarks = list(threads.map(_remarks, jobs))
    pairs = list(zip(jobs, remarks, strict=True))
    wrong = [lines[0] for job, (lines, is_wrong) in pairs if is_wrong and not job.config.accept_poses]
    if wrong:
        others = f" (and {len(wrong) - 1} more of {len(jobs)} scenes)" if len(wrong) > 1 else ""
        raise PosesContradicted(f"{wrong[0]}{others}; {ACCEPT_POSES_HINT}")
    return tuple(replace(job, doubts=lines) for job, (lines, _) in pairs)


def judged_where_read_here(jobs: Sequence[SceneJob]) -> tuple[SceneJob, ...]:
    """The jobs, judged here only for built-in datasets: a user-defined reader may crash its process, so that its scenes
    are judged by their workers."""
    known = {job.scene: job for job in judged([job for job in jobs if job.dataset.target in DATASETS])}
    return tuple(known.get(job.scene, job) for job in jobs)


def _remarks(job: SceneJob) -> Remarks:
    """The remarks on a scene whose frames are files and will be read; those recorded earlier if it was begun."""
    try:
        reading = [part for part in job.methods if build_method(part).needs.frames]
        for part in reading:
            remark = RunFolder(job.folder).job(job.scene, part.name).remarks("predict").get(REMARK)
            if remark is not None:
                return tuple(map(str, remark)), False
        dataset = build_dataset(job.dataset, job.data_root)
        if not reading or getattr(dataset, "renders_frames", False):
            return NOTHING
        verdict = judge_scene(dataset, job.scene_name)
        lines = [] if verdict is None else [verdict.line]
        if isinstance(dataset, ProvidesUpAxis) and (doubt := dataset.up(job.scene_name).doubt) is not None:
            lines.append(f"{job.scene}: {doubt}")
        return tuple(lines), verdict is not None and verdict.is_wrong
    except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything; a scene that cannot be read fails later
        return (f"{job.scene}: poses and depth could not be checked: {error_line(error)}",), False


@contextmanager
def silent() -> Iterator[None]:
    """Hide log messages about a scene's data in the block, because its own job repeats them."""
    package = logging.getLogger("su3d_bench")
    package.addHandler(handler := logging.NullHandler())
    try:
        yield
    finally:
        package.removeHandler(handler)
