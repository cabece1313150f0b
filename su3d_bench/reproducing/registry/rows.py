"""The rows of a bundle: one a method and protocol of a run, with all that a reader of a ranking asks of it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.analysis.leaderboard import RankingRow, Refused, entries_of
from su3d_bench.core.config import DEFAULT_SOURCE, MOVES_NO_NUMBER, KeyPath, RunConfig, toml_value
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, StoreError, Su3dError, printable, reading, shown
from su3d_bench.core.files.atomic import TemporaryFolder
from su3d_bench.core.system.files import opened
from su3d_bench.metrics.costs import MAP, TOTAL, WARM_UP, summarise
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.perception.models.catalogue import MODELS, encoder_known_as
from su3d_bench.reproducing.bundle import MANIFEST, RUNS, Unpacked, unpack
from su3d_bench.runs.existing import existing_run
from su3d_bench.runs.finished import FinishedRun, read_run, read_update_times
from su3d_bench.store.run_folder import JOBS, RECORDS

UNKNOWN = "not known: run.toml is not whole"
MOST_CHARACTERS = 2000


def command_of(run: FinishedRun, method: str) -> str:
    """A line for a shell that does what gave the rows of ``method``: ``run`` of it alone, or ``evaluate``.

    What moves no number is left out, and so is what nobody asked for.
    """
    if method in run.made_elsewhere:
        return printable(_evaluation(run, method), MOST_CHARACTERS)
    held = existing_run(run.folder.path)
    if held is None or not held.is_known:
        return UNKNOWN
    asked = {path: value for path, value in held.values.items() if held.remarks.get(path) != DEFAULT_SOURCE}
    words = ["su3d-bench", "run", *_flags(asked, run, method), *_settings(asked, method)]
    return printable(shlex.join(words), MOST_CHARACTERS)


def _flags(asked: Mapping[KeyPath, Any], run: FinishedRun, method: str) -> Iterator[str]:
    scenes = asked.get(("scenes",)) or run.scenes
    yield from ("--scenes", *map(str, scenes), "--methods", method)
    for name in RunConfig.model_fields:
        value = asked.get((name,))
        if name in ("scenes", "methods") or name in MOVES_NO_NUMBER or value is None:
            continue
        yield f"--{name.replace('_', '-')}"
        yield from map(str, value) if isinstance(value, list | tuple) else (str(value),)


def _settings(asked: Mapping[KeyPath, Any], method: str) -> Iterator[str]:
    """``--set`` of what was asked of this method, the datasets and perception; a variant's name says its own."""
    base = method.partition("@")[0]
    pairs = []
    for path, value in asked.items():
        if len(path) > 2 and path[0] in ("method", "dataset"):
            if path[0] == "dataset" or (path[1] == base == method):
                pairs.append(f"{'.'.join(path[1:])}={toml_value(value)}")
        elif len(path) > 1 and path[0] == "perception":
            pairs.append(f"{'.'.join(path)}={toml_value(value)}")
    if pairs:
        yield from ("--set", *pairs)


def _evaluation(run: FinishedRun, method: str) -> str:
    record, truth = run.made_elsewhere[method], run.record.ground_truth
    words = ["su3d-bench", "evaluate", *record.paths]
    if truth is not None and truth.dataset is not None:
        words += ["--dataset", truth.dataset]
    return shlex.join([*words, "--protocols", *run.protocols])


NOT_SAID = "not said"
TOLD_THE_TRUTH = "none: it was told the truth"
NO_WEIGHTS = {"oracle": "none: masks of the ground truth", "stored": f"{NOT_SAID}: detections of another program"}
OF_A_ROW = ("counts.npz", "updates.csv", "done.json")  # what of a job a row needs; its map stays in the archive
LFS_POINTER = b"version https://git-lfs.github.com/spec/"  # the first line of the specification's pointer files


@dataclass(frozen=True)
class BundleFacts:
    """An archive in a registry: the name of its file without suffix, and what its manifest says."""

    name: str
    sha256: str
    n_bytes: int
    program: str
    recipe: str


@dataclass(frozen=True)
class Weights:
    """A model that a row needed; ``files`` is SHA-256 by file name, as far as the run recorded it."""

    model: str
    trained_on: str
    files: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Row(RankingRow):
    """A method of a run under a protocol.

    ``update_s`` and ``map_s``: the median over its frames after the first ones of a scene, with perception and without;
    None where no frame was timed. ``encoder``: whose features named the instances, None where the method did.
    ``values_of_scenes``: scene -> a value for each headline metric.
    """

    bundle: BundleFacts
    values_of_scenes: tuple[tuple[str, tuple[float | None, ...]], ...]
    update_s: float | None
    map_s: float | None
    n_updates: int
    hardware: str
    encoder: str | None
    weights: tuple[Weights, ...]
    said_trained_on: str
    command: str
    code: str
    commit: str
    changed: tuple[str, ...]
    caveat: str
    warnings: tuple[str, ...]

    @property
    def what(self) -> str:
        return f"{self.method} / {self.protocol}"

    @property
    def trained_on(self) -> str:
        """What all weights were trained on, in a line."""
        known = [f"{one.model}: {one.trained_on}" for one in self.weights]
        return self.said_trained_on or "; ".join(known) or (TOLD_THE_TRUTH if self.is_ceiling else NOT_SAID)


def rows_of_bundle(file: Path) -> tuple[list[Row], list[Refused]]:
    """The rows of the bundle in ``file``, and what of it can stand in no ranking.

    A ``StoreError`` where it is no bundle, a ``DataError`` where only a link or a pointer of Git LFS is here.
    """
    _refuse_pointer(file)
    if file.is_symlink():
        raise DataError(f"{shown(file)}: is a link; name or copy the bundle itself")
    with TemporaryFolder("su3d-bundle-") as folder:
        unpacked = unpack(file, folder, keep=_is_of_a_row)
        manifest = unpacked.manifest
        facts = BundleFacts(
            printable(file.stem, 120),
            digest_file(file),
            file.stat().st_size,
            printable(manifest.program, 80),
            printable(manifest.recipe, 80),
        )
        rows: list[Row] = []
        refused: list[Refused] = []
        for each in _rows(unpacked, facts):
            (rows if isinstance(each, Row) else refused).append(each)  # type: ignore[arg-type]
        return rows, [_without(folder, one) for one in refused]


def _refuse_pointer(file: Path) -> None:
    with reading(shown(file), StoreError), opened(file) as stream:
        if stream.read(len(LFS_POINTER)) == LFS_POINTER:
            raise DataError(f"{shown(file)}: is a pointer of Git LFS, not the bundle itself; get it with: git lfs pull")


def _without(folder: Path, one: Refused) -> Refused:
    return Refused(one.run, one.what, one.reason.replace(f"{folder}/", ""))


def _is_of_a_row(name: str) -> bool:
    parts = name.split("/")
    if name == MANIFEST or parts[0] != RUNS:
        return False
    return (len(parts) == 3 and parts[2] in RECORDS) or (parts[2:3] == [JOBS] and parts[-1] in OF_A_ROW)


def _rows(unpacked: Unpacked, bundle: BundleFacts) -> Iterator[Row | Refused]:
    for place in unpacked.runs:
        name = printable(place.name, 120)
        try:
            run = read_run(place)
            # what a protocol does not score, such as the instances of dense features, is no row and no fault
            unscored = {
                f"{printable(method, 80)} / {printable(protocol, 80)}"
                for (method, protocol), record in run.results.items()
                if record.result is None and not record.failed
            }
            for entry in entries_of(name, run):
                if isinstance(entry, Refused):
                    if entry.what not in unscored:
                        yield entry
                elif (entry.method, entry.protocol) in run.results and is_plain(entry.method):
                    yield _row(run, entry, unpacked, bundle)
                else:
                    yield Refused(name, entry.method, "this is no name of a method; call it by letters and digits")
        except Su3dError as error:
            yield Refused(name, "run", printable(str(error), 300))


def is_plain(name: str) -> bool:
    """Whether a method is called as methods can be, without what no page shows as it is."""
    return printable(name, 120) == name and name.strip(". ") != "" and "/" not in name


def _row(run: FinishedRun, entry: RankingRow, unpacked: Unpacked, bundle: BundleFacts) -> Row:
    record = run.results[entry.method, entry.protocol]
    assert record.result is not None  # or it were no entry
    times = read_update_times(run, entry.method)
    stages = {stage.name: stage for stage in summarise(times, WARM_UP).stages} if times else {}
    per_scene = record.result.per_scene
    is_elsewhere = entry.method in run.made_elsewhere
    return Row(
        **vars(entry),
        bundle=bundle,
        values_of_scenes=tuple(
            (scene, tuple(per_scene[scene].get(metric) for metric in entry.headline)) for scene in entry.scenes
        ),
        update_s=_seconds(stages[TOTAL].p50) if stages else None,
        map_s=_seconds(stages[MAP].p50) if stages else None,
        n_updates=sum(map(len, times)),
        hardware=NOT_SAID if is_elsewhere else printable(run.record.hardware, 200),
        encoder=None if record.encoder is None else printable(record.encoder, 80),
        weights=() if is_elsewhere else tuple(_weights(run, record.encoder, record.profile)),
        said_trained_on=printable(unpacked.manifest.trained_on, 400),
        command=command_of(run, entry.method),
        code=printable(run.record.code, 80),
        commit="" if run.record.git is None else printable(run.record.git.commit, 80),
        changed=run.changed(entry.method),
        caveat=printable(record.caveat or "", 300),
        warnings=tuple(printable(line, 300) for line in record.result.warnings),
    )


def _seconds(ms: float) -> float | None:
    return ms / 1e3 if ms == ms else None


def _weights(run: FinishedRun, encoder: str | None, profile: str | None) -> Iterator[Weights]:
    """The models of the profile and those that the run recorded, and the one whose features named the instances."""
    parts = (profile or "").split(", ")
    yield from (Weights(f"profile {part}", NO_WEIGHTS[part]) for part in parts if part in NO_WEIGHTS)
    known = encoder_known_as(encoder)
    named = [EmbeddedEncoder.name] if "embedded" in parts else []
    named += [encoder] if known is None and encoder is not None else [known.name] if known is not None else []
    for model in dict.fromkeys([*run.record.models, *named]):
        files = tuple(
            (printable(name, 120), printable(sha, 80)) for name, sha in run.record.models.get(model, {}).items()
        )
        if model == EmbeddedEncoder.name:
            yield Weights(model, EmbeddedEncoder.trained_on)
        else:
            yield Weights(printable(model, 80), MODELS[model].trained_on if model in MODELS else NOT_SAID, files)
