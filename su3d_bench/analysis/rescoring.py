"""The maps of a finished run scored again, and compared with its counts and with the ground truth."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.config import NEUTRAL_SETTINGS, Setting, Settings
from su3d_bench.core.errors import StoreError, Su3dError, counted, printable
from su3d_bench.core.files.atomic import TemporaryFolder, is_file, read_arrays
from su3d_bench.core.system.devices import device_for
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.system.timing import processor_digest
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.scoring import pack_scores
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import SceneJob
from su3d_bench.runs.plan import make_plan
from su3d_bench.runs.scene import scores_again

TOLERANCE = 1e-9  # of a value computed on another machine
LOCAL = {"profile": "embedded", "executor": "auto", "offline": True, "pictures": False, "accept_poses": True}


def rescored(
    run: FinishedRun, progress: Callable[[str, int, int], None] = lambda scene, n_done, n_all: None
) -> Iterator[tuple[int, bool, str | None]]:
    """Number of scores, whether they are identical, and the fault, of every map of ``run`` scored again here."""
    is_same_machine = run.record.processor == processor_digest()
    n_all = len(run.scenes) * len(run.methods)
    for k, (scene, method, scores) in enumerate(_of_predictions(run) if run.record.predictions else _of_maps(run), 1):
        progress(scene, k, n_all)
        counts = read_arrays(io.BytesIO(file_bytes(run.folder.job(scene, method).counts)))
        ours = read_arrays(io.BytesIO(pack_scores(scores)))
        fault = difference(counts, ours, to_the_bit=is_same_machine)
        where = f"{printable(scene, 100)} by {printable(method, 80)}: its counts do not match its map: "
        is_identical = difference(counts, ours, to_the_bit=True) is None
        yield len(scores), is_identical, fault and f"{where}{fault}"


def difference(kept: Mapping[str, NDArray[Any]], ours: Mapping[str, NDArray[Any]], *, to_the_bit: bool) -> str | None:
    """The first array in which two files of counts differ; None if they agree.

    Integers must be equal; other numbers equal to the bit, or within ``TOLERANCE``.

    >>> one, other = {"a": np.array([0.1])}, {"a": np.array([0.1 + 1e-12])}
    >>> difference(one, other, to_the_bit=False), difference(one, other, to_the_bit=True)
    (None, "'a' has 0.1, its map gives 0.100000000001")
    """
    if sorted(kept) != sorted(ours):
        odd = sorted(set(kept) ^ set(ours))[0]
        return f"'{printable(odd, 100)}' is only in the {'stored' if odd in kept else 'recomputed'} counts"
    for name, before in kept.items():
        now = ours[name]
        if before.dtype != now.dtype or before.shape != now.shape:
            forms = f"{before.dtype} of {before.shape}, its map gives {now.dtype} of {now.shape}"
            return f"'{printable(name, 100)}' is {forms}"
        is_near = before.dtype.kind == "f" and not to_the_bit
        if before.tobytes() == now.tobytes() or (
            is_near and np.allclose(before, now, rtol=0, atol=TOLERANCE, equal_nan=True)
        ):
            continue
        places = np.flatnonzero((before != now).ravel())
        k = int(places[0]) if len(places) else 0
        return f"'{printable(name, 100)}' has {_value(before, k)}, its map gives {_value(now, k)}"
    return None


def _value(array: NDArray[Any], k: int) -> str:
    return printable(f"{array.ravel()[k]:.12g}" if array.dtype.kind in "fiu" else str(array.ravel()[k]), 60)


def _of_maps(run: FinishedRun) -> Iterator[tuple[str, str, dict[str, SceneScore]]]:
    """The scores of the maps of a run by this program, on this machine or another."""
    encoder = run.encoder(device_of(run))
    for job in jobs_of(run):
        run.dataset(job.scene)  # raises if the data here differ
        for part in job.methods:
            if is_file(run.folder.job(job.scene, part.name).counts):
                yield job.scene, part.name, scores_again(job, part, encoder)


def jobs_of(run: FinishedRun) -> Sequence[SceneJob]:
    """The jobs of a run with its folder here; machine settings are dropped, no image model is loaded."""
    settings = tuple(
        entry for entry in run.data.settings.entries
        if entry.path[0] not in NEUTRAL_SETTINGS and entry.path[:3] != ("perception", "models", "device")
    )  # fmt: skip
    here = tuple(Setting((name,), value, "verify") for name, value in LOCAL.items())
    with TemporaryFolder("su3d-plan-") as folder:
        plan = make_plan(Settings((*settings, *here)), (), folder / run.folder.path.name)
    wanted = set(run.scenes)
    missing = wanted - {job.scene for job in plan.jobs}
    if missing:
        raise StoreError(f"{counted(len(missing), 'scene')} of the run missing, such as {printable(min(missing), 80)}")
    return [replace(job, folder=run.folder.path) for job in plan.jobs if job.scene in wanted]


def device_of(run: FinishedRun) -> str:
    """The device on which the run encoded texts (other devices give other bits); the CPU if it is not available."""
    try:
        return device_for(str(run.settings.get(("perception", "models", "device"), "cpu")), 0)
    except Su3dError:
        return "cpu"


def check_dataset_ground_truth(run: FinishedRun) -> None:
    """Raise a ``StoreError`` if predictions were scored against ground-truth files instead of a dataset."""
    truth = run.record.ground_truth
    if run.record.predictions and (truth is None or truth.dataset is None):
        raise StoreError("was scored against ground-truth files, which a bundle does not contain; use --dataset")


def _of_predictions(run: FinishedRun) -> Iterator[tuple[str, str, dict[str, SceneScore]]]:
    """The scores of predictions made elsewhere, from the maps stored in the run."""
    check_dataset_ground_truth(run)
    truth = run.record.ground_truth
    assert truth is not None
    for one in run.record.predictions:
        request = Request(
            tuple(run.folder.job(scene, one.method).path for scene in run.scenes),
            dataset=truth.dataset,
            protocols=tuple(run.protocols),
            confidences="file" if one.confidences == "file" else "protocol",
        )
        evaluation = evaluate(request)
        for scene in run.scenes:
            name = scene.partition("/")[2]
            scores = {each.rules.name: each.scores[name] for each in evaluation.protocols if name in each.scores}
            yield scene, one.method, scores
