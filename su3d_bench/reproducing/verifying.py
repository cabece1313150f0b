"""Whether a bundle's numbers are what its own predictions give, scored anew against the ground truth that is here.

On the machine that made it to the last bit; on another integer counts are the same and values within 1e-9.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core import registry
from su3d_bench.core.config import MOVES_NO_NUMBER, Setting, Settings
from su3d_bench.core.errors import StoreError, Su3dError, counted, printable
from su3d_bench.core.files.atomic import TemporaryFolder, is_file, read_arrays, read_json
from su3d_bench.core.system.devices import device_for
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.system.timing import processor_digest
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.scoring import pack_scores
from su3d_bench.reproducing.bundle import COMPARED, RECIPE, Unpacked, unpack
from su3d_bench.reproducing.differences import Results, compared_all, compared_json
from su3d_bench.reproducing.recipe import parse_recipe
from su3d_bench.runs.finished import FinishedRun, encoder_of, read_run
from su3d_bench.runs.job import SceneJob
from su3d_bench.runs.plan import make_plan
from su3d_bench.runs.scene import scores_again
from su3d_bench.runs.verify import wrong_files

TOLERANCE = 1e-9  # of a value on another machine
OF_THE_VERIFIER = {"profile": "embedded", "executor": "auto", "offline": True, "pictures": False, "accept_poses": True}


@dataclass
class Verified:
    """What was looked at in a bundle: ``faults`` are lines, none where it holds; ``is_to_the_bit``: every count was."""

    bundle: str
    n_files: int = 0
    n_scores: int = 0
    n_cells: int = 0
    is_to_the_bit: bool = True
    faults: list[str] = field(default_factory=list)


def verify_bundle(bundle: Path) -> Verified:
    """Unpack, look at every digest, score every map anew, and form every number again.

    A ``StoreError`` where it cannot be unpacked or holds no run.
    """
    with TemporaryFolder("su3d-bundle-") as folder:
        unpacked = unpack(bundle, folder)
        found = Verified(bundle.name, n_files=len(unpacked.manifest.files))
        for place in unpacked.runs:
            name = place.relative_to(folder).as_posix()
            try:
                found.faults += [f"{name}: {line}" for line in _faults_of(read_run(place), found, folder)]
            except Su3dError as error:
                found.faults.append(f"{name}: {str(error).replace(str(folder), '').lstrip('/')}")
        if not found.faults:
            found.faults += _cells(unpacked, found)
        found.faults = [line.replace(f"{folder}/", "") for line in found.faults]
        return found


def _faults_of(run: FinishedRun, found: Verified, folder: Path) -> Iterator[str]:
    wrong = [f"{where}: {what}" for where, what in wrong_files(run) if not what.startswith("done.json")]
    yield from wrong
    if not wrong:
        yield from _rescored(run, found, folder)


def _rescored(run: FinishedRun, found: Verified, folder: Path) -> Iterator[str]:
    """Every count that is not what the map gives when it is scored anew."""
    is_same_machine = run.record.processor == processor_digest()
    anew = _of_predictions(run) if run.record.predictions else _of_maps(run, folder)
    for scene, method, scores in anew:
        counts = run.folder.job(scene, method).counts
        kept = read_arrays(io.BytesIO(file_bytes(counts)))
        ours = read_arrays(io.BytesIO(pack_scores(scores)))
        found.n_scores += len(scores)
        fault = difference(kept, ours, to_the_bit=is_same_machine)
        found.is_to_the_bit &= difference(kept, ours, to_the_bit=True) is None
        if fault is not None:
            yield f"{printable(scene, 100)} by {printable(method, 80)}: its counts are not those of its map: {fault}"


def difference(kept: Mapping[str, NDArray[Any]], ours: Mapping[str, NDArray[Any]], *, to_the_bit: bool) -> str | None:
    """The first array in which two files of counts differ; None where they agree.

    Integers are the same; other numbers to the bit, or within ``TOLERANCE``.

    >>> one, other = {"a": np.array([0.1])}, {"a": np.array([0.1 + 1e-12])}
    >>> difference(one, other, to_the_bit=False), difference(one, other, to_the_bit=True)
    (None, "'a' has 0.1, its map gives 0.100000000001")
    """
    if sorted(kept) != sorted(ours):
        odd = sorted(set(kept) ^ set(ours))[0]
        return f"'{printable(odd, 100)}' is {'kept' if odd in kept else 'found'} alone"
    for name, before in kept.items():
        now = ours[name]
        if before.dtype != now.dtype or before.shape != now.shape:
            forms = f"{before.dtype} of {before.shape}, its map gives {now.dtype} of {now.shape}"
            return f"'{printable(name, 100)}' is {forms}"
        if before.tobytes() == now.tobytes():
            continue
        if (
            before.dtype.kind == "f"
            and not to_the_bit
            and np.allclose(before, now, rtol=0, atol=TOLERANCE, equal_nan=True)
        ):
            continue
        places = np.flatnonzero((before != now).ravel())
        k = int(places[0]) if len(places) else 0
        return f"'{printable(name, 100)}' has {_one(before, k)}, its map gives {_one(now, k)}"
    return None


def _one(array: NDArray[Any], k: int) -> str:
    return printable(f"{array.ravel()[k]:.12g}" if array.dtype.kind in "fiu" else str(array.ravel()[k]), 60)


def _of_maps(run: FinishedRun, folder: Path) -> Iterator[tuple[str, str, dict[str, SceneScore]]]:
    """The scores of the maps of a run that was made here or elsewhere by this program."""
    refuse_own_code(run)
    encoder = encoder_of(run.folder, device_of(run))
    for job in _jobs(run, folder):
        run.dataset(job.scene)  # raises where the data here are others
        for part in job.methods:
            if is_file(run.folder.job(job.scene, part.name).counts):
                yield job.scene, part.name, scores_again(job, part, encoder)


def _jobs(run: FinishedRun, folder: Path) -> Sequence[SceneJob]:
    """The jobs of a run with its folder here; nothing of where it ran is kept, and no model is loaded to see images."""
    settings = tuple(
        entry for entry in run.data.settings.entries
        if entry.path[0] not in MOVES_NO_NUMBER and entry.path[:3] != ("perception", "models", "device")
    )  # fmt: skip
    here = tuple(Setting((name,), value, "verify") for name, value in OF_THE_VERIFIER.items())
    plan = make_plan(Settings((*settings, *here)), (), folder / "planned" / run.folder.path.name)
    wanted = set(run.scenes)
    missing = wanted - {job.scene for job in plan.jobs}
    if missing:
        raise StoreError(f"{counted(len(missing), 'scene')} of the run not here, such as {printable(min(missing), 80)}")
    return [replace(job, folder=run.folder.path) for job in plan.jobs if job.scene in wanted]


def device_of(run: FinishedRun) -> str:
    """Where the run encoded texts, for other bits come of another device; the CPU where there is none such here."""
    try:
        return device_for(str(run.settings.get(("perception", "models", "device"), "cpu")), 0)
    except Su3dError:
        return "cpu"


def refuse_own_code(run: FinishedRun) -> None:
    """A ``StoreError`` where scoring would load a file of code that the bundle names."""
    asked = {name: run.settings.get((name,), ()) for name in ("methods", "scenes", "protocols")}
    for name, texts in asked.items():
        for text in texts if isinstance(texts, list | tuple) else (texts,):
            base = str(text).partition("@")[0].partition("/")[0]
            known = registry.METHODS if name == "methods" else registry.DATASETS if name == "scenes" else None
            if ".py" in str(text) or str(text).endswith(".toml") or (known is not None and base not in known):
                raise StoreError(f"names somebody's own '{printable(str(text), 80)}', which a bundle does not bring")


def refuse_own_truth(run: FinishedRun) -> None:
    """A ``StoreError`` where predictions were held against files of ground truth in place of a dataset."""
    truth = run.record.ground_truth
    if run.record.predictions and (truth is None or truth.dataset is None):
        raise StoreError("was scored against files of ground truth, which a bundle does not bring; use --dataset")


def _of_predictions(run: FinishedRun) -> Iterator[tuple[str, str, dict[str, SceneScore]]]:
    """The scores of predictions that were made elsewhere, from the maps that the run kept of them."""
    refuse_own_truth(run)
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


def _cells(unpacked: Unpacked, found: Verified) -> Iterator[str]:
    """Every cell of ``compared.json`` that the runs do not give."""
    if not is_file(unpacked.folder / COMPARED):
        return
    recipe = parse_recipe(file_bytes(unpacked.folder / RECIPE), RECIPE)
    kept = read_json(unpacked.folder / COMPARED)
    cells = kept.get("cells") if isinstance(kept, dict) else None
    if not isinstance(cells, list) or not all(isinstance(cell, dict) for cell in cells):
        raise StoreError(f"{COMPARED} is not as a reproduction writes it")
    names = [one.name for one in recipe.experiments if any(cell.get("experiment") == one.name for cell in cells)]
    again = compared_json(recipe, compared_all(recipe.chosen(names) if names else (), Results(unpacked.runs)))["cells"]
    found.n_cells = len(cells)
    if len(again) != len(cells):
        yield f"{COMPARED}: has {counted(len(cells), 'cell')}, the recipe and runs give {len(again)}"
        return
    for before, now in zip(cells, again, strict=True):
        for key in ("reported", "measured", "interval", "difference", "protocol", "n_scenes"):
            if not _agree(before.get(key), now[key]):
                what = f"{now['experiment']} {now['row']} {now['metric']}"
                yield f"{COMPARED}: {what}: {key} is {printable(str(before.get(key)), 60)}, the runs give {now[key]}"
                return


def _agree(before: object, now: object) -> bool:
    if isinstance(before, list | tuple) and isinstance(now, list | tuple):
        return len(before) == len(now) and all(map(_agree, before, now))
    if isinstance(before, int | float) and isinstance(now, int | float):
        return abs(before - now) <= 100 * TOLERANCE
    return before == now
