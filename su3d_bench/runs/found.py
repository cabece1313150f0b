"""What the maps of a run hold, for scenes that nothing scores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.maps import Instances, Partition, Prediction
from su3d_bench.reports.tables.run import Found
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.records import read_updates
from su3d_bench.store.run_folder import RunFolder

MOST_OF_A_NAME = 60  # characters


def found_in(folder: RunFolder, jobs: Iterable[tuple[str, str]]) -> Iterator[Found]:
    """What each of ``jobs`` (scene, method) found, of those whose map is here."""
    for scene, method in jobs:
        job = folder.job(scene, method)
        if is_file(job.prediction):
            where = f"{printable(scene, 120)}: {job.updates.name}"
            columns = read_updates(job.updates, where) if is_file(job.updates) else {}
            times = columns.get("total_ms", np.zeros(0))
            prediction = read_prediction(job.prediction)
            yield Found(
                scene=printable(scene, 200),
                method=printable(method, 200),
                n_points=len(prediction.points),
                n_instances=_n_instances(prediction),
                names=_names(prediction),
                extents_m=_extents_m(prediction),
                n_updates=len(times),
                update_ms=float(np.median(times)) if len(times) else None,
            )


def without_score(run: FinishedRun) -> list[tuple[str, str]]:
    """(scene, method) of what no protocol scored and did not fail."""
    told = {(failure.scene, failure.method) for failure in run.record.failed}
    for (method, _), result in run.results.items():
        told |= {(scene, method) for scene in (result.result.scenes if result.result is not None else ())}
    return [(scene, method) for scene in run.scenes for method in run.methods if (scene, method) not in told]


def _n_instances(prediction: Prediction) -> int | None:
    if isinstance(prediction, Instances):
        return len(prediction)
    return len(prediction.features) if isinstance(prediction, Partition) else None


def _names(prediction: Prediction) -> tuple[tuple[str, int], ...]:
    if not isinstance(prediction, Instances):
        return ()
    labels = prediction.labels or ("",) * len(prediction)
    names = (printable(label or name, MOST_OF_A_NAME) for label, name in zip(labels, prediction.names, strict=True))
    return tuple(Counter(names).most_common())


def _extents_m(prediction: Prediction) -> tuple[float, float, float] | None:
    if not isinstance(prediction, Instances) or not len(prediction):
        return None
    longest = np.sort(np.ptp(prediction.boxes, axis=1).max(axis=1).astype(np.float64))
    return float(longest[0]), float(np.median(longest)), float(longest[-1])
