"""Whether a recording's poses are what its depth says, looked at on a few frames before a scene's work begins.

What wrong poses look like is known to ``datasets.recordings.pose_convention`` alone, which ``datasets check`` asks too.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import RendersFrames
from su3d_bench.datasets.recordings.pose_convention import Verdict, judge_scene
from su3d_bench.runs.job import SceneJob, build_dataset, build_method
from su3d_bench.store.run_folder import RunFolder

ALL_THE_SAME = "--accept-poses runs it all the same"
REMARK = "doubts"  # beside the seal of a prediction


class PosesContradicted(DataError):
    """Another reading of poses or depth agrees clearly better than the one that a run would take."""


def judged(jobs: Sequence[SceneJob]) -> tuple[SceneJob, ...]:
    """The jobs with what is to be said of their poses; ``PosesContradicted`` where one of them must not be run."""
    with _unheard(), ThreadPoolExecutor(min(len(jobs), os.cpu_count() or 1)) as threads:
        verdicts = list(threads.map(_verdict, jobs))
    wrong = [verdict.line for job, verdict in zip(jobs, verdicts, strict=True) if _is_refused(job, verdict)]
    if wrong:
        others = f" (and {len(wrong) - 1} more of {len(jobs)} scenes)" if len(wrong) > 1 else ""
        raise PosesContradicted(f"{wrong[0]}{others}; {ALL_THE_SAME}")
    return tuple(
        replace(job, doubts=(verdict.line,) if verdict.line else ())
        for job, verdict in zip(jobs, verdicts, strict=True)
    )


def _is_refused(job: SceneJob, verdict: Verdict) -> bool:
    return verdict.is_wrong and not job.accepts_poses


NOTHING_TO_SAY = Verdict(False, "")


def _verdict(job: SceneJob) -> Verdict:
    """The verdict on a scene whose frames are files and will be read; of a scene that was begun, what was said then."""
    try:
        reading = [part for part in job.methods if build_method(part).needs.frames]
        if not reading:
            return NOTHING_TO_SAY
        for part in reading:
            said = RunFolder(job.folder).job(job.scene, part.name).remarks("predict").get(REMARK)
            if said is not None:
                return Verdict(False, str(said[0])) if said else NOTHING_TO_SAY
        dataset = build_dataset(job.dataset, job.data_root)
        if isinstance(dataset, RendersFrames) and dataset.renders_frames:
            return NOTHING_TO_SAY
        return judge_scene(dataset, job.scene_name) or NOTHING_TO_SAY
    except Exception:  # noqa: BLE001 - a plug-in may raise anything; the scene's own work meets it and records it
        return NOTHING_TO_SAY


@contextmanager
def _unheard() -> Iterator[None]:
    """What readers say of a scene's data in the block is left to its work, which says it again."""
    package = logging.getLogger("su3d_bench")
    package.addHandler(handler := logging.NullHandler())
    try:
        yield
    finally:
        package.removeHandler(handler)
