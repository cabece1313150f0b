"""A registry of results: a folder of bundles from many contributors, compared and ranked, one row per score."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from su3d_bench.analysis.costs import costs_of, machine_of
from su3d_bench.analysis.leaderboard import RankingRow, Refused, entries_of, in_order, ranked
from su3d_bench.core import registry as plugins
from su3d_bench.core.config import NEUTRAL_SETTINGS, KeyPath, RunConfig, toml_value
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, StoreError, Su3dError, counted, printable, reading, shown
from su3d_bench.core.files.atomic import TemporaryFolder, is_file, make_folder, replacing
from su3d_bench.core.system.files import opened
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.perception.models.catalogue import MODELS, encoder_known_as
from su3d_bench.reports.pictures.maps import thumbnail
from su3d_bench.reports.tables.costs import RATE
from su3d_bench.reproducing.bundle import MANIFEST, RUNS, Unpacked, copy_pieces, unpack, verify_bundle
from su3d_bench.runs.catalogue import about_method
from su3d_bench.runs.existing import existing_run
from su3d_bench.runs.finished import FinishedRun, read_run, read_update_times
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.run_folder import JOBS, RECORDS

UNKNOWN = "unknown: run.toml is incomplete"
MAX_CHARACTERS = 2000


def command_of(run: FinishedRun, method: str) -> str:
    """A shell command that reproduces the rows of ``method``: ``run`` with only this method, or ``evaluate``.

    Settings that change no number are omitted, and so are defaults.
    """
    if method in run.external:
        return printable(_evaluation(run, method), MAX_CHARACTERS)
    present = existing_run(run.folder.path)
    if present is None or not present.is_known:
        return UNKNOWN
    asked = present.requested
    words = ["su3d-bench", "run", *_flags(asked, run, method), *_settings(asked, method)]
    return printable(shlex.join(words), MAX_CHARACTERS)


def _flags(asked: Mapping[KeyPath, Any], run: FinishedRun, method: str) -> Iterator[str]:
    scenes = asked.get(("scenes",)) or run.scenes
    yield from ("--scenes", *map(str, scenes), "--methods", method)
    for name in RunConfig.model_fields:
        value = asked.get((name,))
        if name in ("scenes", "methods") or name in NEUTRAL_SETTINGS or value is None:
            continue
        yield f"--{name.replace('_', '-')}"
        yield from map(str, value) if isinstance(value, list | tuple) else (str(value),)


def _settings(asked: Mapping[KeyPath, Any], method: str) -> Iterator[str]:
    """``--set`` with requested settings of this method, datasets and perception; a variant's name has its own."""
    base = plugins.base_name(method)
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
    record, truth = run.external[method], run.record.ground_truth
    words = ["su3d-bench", "evaluate", *record.paths]
    if truth is not None and truth.dataset is not None:
        words += ["--dataset", truth.dataset]
    return shlex.join([*words, "--protocols", *run.protocols])


NOT_STATED = "not stated"
USES_GROUND_TRUTH = "none: it uses ground truth"
NO_WEIGHTS = {"oracle": "none: ground-truth masks", "stored": f"{NOT_STATED}: detections of another program"}
# Files of a job that a row needs; its map stays in the archive.
ROW_FILES = ("counts.npz", "updates.csv", "schedule.csv", "done.json")


@dataclass(frozen=True)
class BundleFacts:
    """An archive in a registry: its file name without suffix, and facts from its manifest."""

    name: str
    sha256: str
    n_bytes: int
    program: str
    recipe: str


@dataclass(frozen=True)
class ModelWeights:
    """A model that a row used; ``files``: file name and SHA-256, as far as the run recorded it."""

    model: str
    trained_on: str
    files: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Row(RankingRow):
    """A method of a run under a protocol.

    ``costs``: time, memory and map size, by the keys of ``COSTS``. ``encoder``: the encoder whose features named the
    instances, None if the method did. ``values_of_scenes``: scene -> one value per headline metric. ``picture``: PNG of
    the first map, if requested.
    """

    bundle: BundleFacts
    values_of_scenes: tuple[tuple[str, tuple[float | None, ...]], ...]
    costs: Mapping[str, float | None]
    n_updates: int
    hardware: str
    encoder: str | None
    weights: tuple[ModelWeights, ...]
    stated_training_data: str
    command: str
    code: str
    commit: str
    changed: tuple[str, ...]
    caveat: str
    warnings: tuple[str, ...]
    authors: str
    link: str
    date: str
    picture: bytes | None

    @property
    def what(self) -> str:
        return f"{self.method} / {self.protocol}"

    @property
    def trained_on(self) -> str:
        """The training data of all weights, on one line."""
        known = [f"{one.model}: {one.trained_on}" for one in self.weights]
        return self.stated_training_data or "; ".join(known) or (USES_GROUND_TRUTH if self.is_ceiling else NOT_STATED)


def rows_of_bundle(file: Path, *, with_pictures: bool = False) -> tuple[list[Row], list[Refused]]:
    """The rows of the bundle in ``file``, and its scores that cannot be ranked.

    Raises ``StoreError`` if it is not a bundle.
    """
    with TemporaryFolder("su3d-bundle-") as folder:
        unpacked = unpack(file, folder, keep=_kept(with_pictures))
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
        return rows, [replace(one, reason=one.reason.replace(f"{folder}/", "")) for one in refused]


def _kept(with_pictures: bool) -> Callable[[str], bool]:
    """Whether a file is needed: records, files of rows, and for pictures the first map of each run and method."""
    drawn = set[tuple[str, str]]()

    def keep(name: str) -> bool:
        parts = name.split("/")
        if name == MANIFEST or parts[0] != RUNS:
            return False
        if with_pictures and parts[-1] == "prediction.npz" and (parts[1], parts[-2]) not in drawn:
            drawn.add((parts[1], parts[-2]))
            return True
        return (len(parts) == 3 and parts[2] in RECORDS) or (parts[2:3] == [JOBS] and parts[-1] in ROW_FILES)

    return keep


def _picture(run: FinishedRun, method: str) -> bytes | None:
    """The picture of the first unpacked map of ``method``; None if there is none or it cannot be drawn."""
    for file in (run.folder.job(scene, method).prediction for scene in run.scenes):
        if is_file(file):
            with suppress(Su3dError):
                return thumbnail(read_prediction(file))
    return None


def _rows(unpacked: Unpacked, bundle: BundleFacts) -> Iterator[Row | Refused]:
    for place in unpacked.runs:
        name = printable(place.name, 120)
        try:
            run = read_run(place)
            # what a protocol cannot score, such as instances of dense features, is neither a row nor a fault
            unscored = {
                f"{printable(method, 80)} / {printable(protocol, 80)}"
                for (method, protocol), record in run.results.items()
                if record.result is None and not record.failed
            }
            for entry in entries_of(name, run):
                if isinstance(entry, Refused):
                    if entry.what not in unscored:
                        yield entry
                else:
                    yield _row(run, entry, unpacked, bundle)
        except Su3dError as error:
            yield Refused(name, "run", printable(str(error), 300))


def _row(run: FinishedRun, entry: RankingRow, unpacked: Unpacked, bundle: BundleFacts) -> Row:
    record = run.results[entry.method, entry.protocol]
    assert record.result is not None  # otherwise there would be no entry
    times = read_update_times(run, entry.method)
    per_scene = record.result.per_scene
    is_elsewhere = entry.method in run.external
    manifest = unpacked.manifest
    name = plugins.base_name(entry.method)
    is_known = not is_elsewhere and name in plugins.names("method")
    about = about_method(name, plugins.load("method", name)) if is_known else {}
    source = re.search(r"https://[^\s;,]+", about.get("source") or "")
    return Row(
        **vars(entry),
        bundle=bundle,
        values_of_scenes=tuple(
            (scene, tuple(per_scene[scene].get(metric) for metric in entry.headline)) for scene in entry.scenes
        ),
        costs=costs_of(run, times, record.result),
        n_updates=sum(map(len, times)),
        hardware=NOT_STATED if is_elsewhere else machine_of(run, times),
        encoder=None if record.encoder is None else printable(record.encoder, 80),
        weights=() if is_elsewhere else tuple(_weights(run, record.encoder, record.profile)),
        stated_training_data=printable(manifest.trained_on, 400),
        authors=printable(manifest.authors or about.get("paper") or NOT_STATED, 400),
        link=manifest.link or (source[0] if source else ""),
        date=manifest.date,
        picture=_picture(run, entry.method),
        command=command_of(run, entry.method),
        code=printable(run.record.code, 80),
        commit="" if run.record.git is None else printable(run.record.git.commit, 80),
        changed=run.changed(entry.method),
        caveat=printable(record.caveat or "", 300),
        warnings=tuple(printable(line, 300) for line in record.result.warnings),
    )


def _weights(run: FinishedRun, encoder: str | None, profile: str | None) -> Iterator[ModelWeights]:
    """The models of the profile, those that the run recorded, and the encoder that named the instances."""
    parts = (profile or "").split(", ")
    yield from (ModelWeights(f"profile {part}", NO_WEIGHTS[part]) for part in parts if part in NO_WEIGHTS)
    known = encoder_known_as(encoder)
    named = [EmbeddedEncoder.name] if "embedded" in parts else []
    named += [encoder] if known is None and encoder is not None else [known.name] if known is not None else []
    for model in dict.fromkeys([*run.record.models, *named]):
        files = tuple(
            (printable(name, 120), printable(sha, 80)) for name, sha in run.record.models.get(model, {}).items()
        )
        if model == EmbeddedEncoder.name:
            yield ModelWeights(model, EmbeddedEncoder.trained_on)
        else:
            yield ModelWeights(printable(model, 80), MODELS[model].trained_on if model in MODELS else NOT_STATED, files)


N_DIGITS = 12  # shown digits of a digest


def conflict_with(row: Row, present: Sequence[Row]) -> str | None:
    """Why ``row`` cannot be added to a registry with the rows ``present``, and what to do; None if it can."""
    return next((f"{row.what}: {fault}" for other in present for fault in _faults_beside(row, other)), None)


def _faults_beside(row: Row, other: Row) -> Iterator[str]:
    where = f"{other.method} in {other.bundle.name}{SUFFIX}"
    is_of_protocol, is_of_ranking = row.protocol == other.protocol, row.ranking == other.ranking
    if is_of_protocol and (row.version, row.digest) != (other.version, other.digest):
        yield (
            f"its protocol has version {row.version}, digest {row.digest[:N_DIGITS]}, that of {where} has version "
            f"{other.version}, digest {other.digest[:N_DIGITS]}; score it again with those rules, or start another "
            "registry"
        )
    theirs = dict(other.data)
    for scene, digest in row.data:
        if theirs.get(scene, digest) != digest:
            yield (
                f"its data of {scene} have the digest {digest[:N_DIGITS]}, those of {where} have "
                f"{theirs[scene][:N_DIGITS]}; run it on the same data with the same dataset settings"
            )
    # features are compared with text features: a protocol that names an encoder allows only one encoder
    if is_of_protocol and None not in (row.encoder, other.encoder) and _names_encoder(row.protocol):
        if row.encoder != other.encoder:
            yield (
                f"its features are from the encoder {row.encoder}, those of {where} from {other.encoder}, but the "
                "protocol requires one encoder; run it with that one"
            )
        mine, known = ({one.model: one.files for one in each.weights if one.files} for each in (row, other))
        for model in mine.keys() & known.keys() & MODELS.keys():
            if MODELS[model].kind == "encoder" and mine[model] != known[model]:
                yield f"its weights of {model} differ from those of {where} (other SHA-256); run it with the same file"
    is_of_rate = row.costs[RATE] == other.costs[RATE]
    if is_of_ranking and is_of_rate and row.method.casefold() == other.method.casefold():
        yield (
            f"the name is taken by {where} on the same scenes; give the variant its own name, such as "
            f"{row.method.partition('@')[0]}@KEY=VALUE, or remove the other bundle first"
        )
    if is_of_ranking and not (row.is_ceiling or other.is_ceiling) and row.labels != other.labels:
        yield f"uses {row.labels}, {where} uses {other.labels}; score it with the same number of labels"


def _names_encoder(protocol: str) -> bool:
    try:
        return protocol in protocol_names() and load_protocol(protocol).encoder is not None
    except ConfigError:  # user-defined rules, which are stored in their run
        return False


BUNDLES = "bundles"
SUFFIX = ".zip"
MAX_BUNDLES = 2000
MAX_NAMED = 3  # reasons listed per bundle
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_ANY = "bundle"  # the name of all archives written by reproduce


@dataclass(frozen=True)
class Registry:
    """The contents of a folder of bundles: rankings, the best first, and what is excluded with its reason."""

    n_bundles: int
    boards: tuple[tuple[Row, ...], ...]
    refused: tuple[Refused, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        return tuple(row for board in self.boards for row in board)


def bundle_files(folder: Path) -> list[Path]:
    """The bundles of a registry by name: those in its folder ``bundles`` if it exists, otherwise those in ``folder``.

    Raises ``ConfigError`` if it is not a folder.
    """
    if not folder.is_dir():
        raise ConfigError(f"{shown(folder)}: is not a folder; create a registry with: su3d-bench dev registry new DIR")
    place = folder / BUNDLES if (folder / BUNDLES).is_dir() else folder
    try:
        files = sorted(place / name for name in os.listdir(place) if name.lower().endswith(SUFFIX))
    except OSError as error:
        raise StoreError(f"{shown(place)}: cannot be read: {error.strerror or error}") from error
    if len(files) > MAX_BUNDLES:
        raise ConfigError(f"{shown(place)}: has {len(files)} bundles; a registry has at most {MAX_BUNDLES}")
    return files


def read_registry(folder: Path, *, with_pictures: bool = False) -> Registry:
    """The registry in ``folder``, with each file checked against its manifest and each number against its counts.

    Maps are only scored again in ``add_bundle``. Of two conflicting rows, the one with the later bundle name is
    excluded. Raises ``ConfigError`` if the folder has neither bundles nor a ``bundles`` folder.
    """
    files = bundle_files(folder)
    if not files and not (folder / BUNDLES).is_dir():
        raise ConfigError(
            f"{shown(folder)}: contains no bundles; add one with: su3d-bench dev registry add BUNDLE --registry DIR"
        )
    rows: list[Row] = []
    refused: list[Refused] = []
    for file in files:
        mine, others = _read(file, with_pictures=with_pictures)
        refused += others
        for row in mine:
            reason = conflict_with(row, rows)
            if reason is None:
                rows.append(row)
            else:
                refused.append(Refused(row.bundle.name, row.what, reason.removeprefix(f"{row.what}: ")))
    return Registry(len(files), tuple(_boards(rows)), tuple(refused))


def _read(file: Path, *, with_pictures: bool = False) -> tuple[list[Row], list[Refused]]:
    name = printable(file.name, 120)
    try:
        rows, refused = rows_of_bundle(file, with_pictures=with_pictures)
    except Su3dError as error:
        return [], [Refused(name, "bundle", printable(str(error).replace(f"{shown(file)}: ", ""), 400))]
    return rows, [replace(one, run=f"{name} {one.run}") for one in refused]


def _boards(rows: Sequence[Row]) -> Iterator[tuple[Row, ...]]:
    """The rankings by protocol, those with the most scenes first."""
    rankings = sorted({row.ranking for row in rows}, key=lambda key: (key[0], -len(key[2]), key))
    for ranking in rankings:
        yield ranked(in_order([row for row in rows if row.ranking == ranking]))


@dataclass(frozen=True)
class Added:
    """The result of adding a bundle: ``reasons`` why it was rejected, empty if it is in the registry at ``place``."""

    bundle: str
    place: str
    n_rows: int = 0
    n_scores: int = 0
    is_to_the_bit: bool = False
    reasons: tuple[str, ...] = ()


def add_bundle(file: Path, registry: Path, name: str | None = None) -> Added:
    """Add ``file`` to ``registry`` after scoring it again, or return why it was rejected.

    It is rejected if its maps do not reproduce its numbers (see ``verify_bundle``), if a row of it cannot be ranked, or
    conflicts with existing rows. A bundle already in the registry, as in a pull request, is checked against all others
    and stays. Raises ``StoreError`` if it is not a bundle, ``ConfigError`` if ``name`` is invalid or
    the registry contains a damaged bundle.
    """
    others = [one for one in bundle_files(registry) if not _is_same_file(one, file)]
    is_there = len(others) < len(bundle_files(registry))
    before = _digest(file)
    rows, refused = rows_of_bundle(file)
    if is_there and name is not None:
        raise ConfigError(f"--bundle-name: {shown(file)} is already in the registry; rename the file itself")
    place = file if is_there else _place(registry, file, rows, name)
    found = Added(printable(file.name, 120), printable(str(place), 300), len(rows))
    reasons = [f"{one.what}: {one.reason}" for one in refused]
    reasons = reasons or list(_beside(rows, others, before))
    if not reasons and not is_there and os.path.lexists(place):
        reasons.append(f"{printable(place.name, 120)} is taken by another bundle; choose another with --bundle-name")
    if reasons:
        return replace(found, reasons=tuple(reasons))
    verified = verify_bundle(file)
    found = replace(found, n_scores=verified.n_scores, is_to_the_bit=verified.is_to_the_bit)
    if verified.faults:
        return replace(found, reasons=tuple(verified.faults))
    if not is_there:
        _copy(file, place, before)
    elif _digest(file) != before:
        raise StoreError(f"{shown(file)}: changed while it was scored; add it again")
    return found


def _beside(rows: Sequence[Row], others: Sequence[Path], digest: str) -> Iterator[str]:
    """Why the rows of a bundle of this digest conflict with each other or with the bundles ``others``."""
    present: list[Row] = []
    for other in others:
        mine, refused = _read(other)
        if refused:
            first = refused[0]
            raise ConfigError(
                f"{shown(other)}: is an invalid bundle in the registry: {first.what}: {first.reason}; remove it or "
                "create it again first"
            )
        if mine and mine[0].bundle.sha256 == digest:
            yield f"is already in the registry as {mine[0].bundle.name}{SUFFIX}"
            return
        present += mine
    for row in rows:
        if reason := conflict_with(row, present):
            yield reason
        present.append(row)


def _is_same_file(one: Path, other: Path) -> bool:
    try:
        return os.path.samefile(one, other)
    except OSError:
        return False


def _place(registry: Path, file: Path, rows: Sequence[Row], name: str | None) -> Path:
    """The path of a bundle in the registry; one with the default name is named after its recipe or run, and digest."""
    if name is None:
        name = file.name[: -len(SUFFIX)] if file.name.lower().endswith(SUFFIX) else file.name
        if name == _ANY and rows:
            first = rows[0]
            name = f"{first.bundle.recipe or re.sub('[^A-Za-z0-9._-]+', '-', first.run)}-{first.bundle.sha256[:8]}"
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"'{printable(name, 100)}' is not a valid bundle name (only letters, digits, '.', '_' and '-'); choose one "
            "with --bundle-name"
        )
    folder = registry / BUNDLES if (registry / BUNDLES).is_dir() or not bundle_files(registry) else registry
    return folder / f"{name}{SUFFIX}"


def _digest(file: Path) -> str:
    with reading(shown(file), StoreError):
        return digest_file(file)


def _copy(file: Path, place: Path, digest: str) -> None:
    """Copy the file to ``place`` (atomic); ``StoreError`` if it is not the one that was scored."""
    make_folder(place.absolute().parent)
    with reading(shown(file), StoreError), opened(file) as source, replacing(place) as out:
        copied = copy_pieces(source, out)
    if copied != digest:
        place.unlink(missing_ok=True)
        raise StoreError(f"{shown(file)}: changed while it was scored; add it again")


def lines_of(found: Added) -> list[str]:
    """The output lines for a bundle that was added or rejected, one line per reason."""
    if not found.reasons:
        how = "identical to the last bit" if found.is_to_the_bit else "identical integers, values within 1e-9"
        scores = f"{counted(found.n_scores, 'score')} recomputed, {how}"
        return [f"{found.bundle}: in the registry as {found.place}: {counted(found.n_rows, 'row')}; {scores}"]
    messages = [f"{found.bundle}: rejected: {reason}" for reason in found.reasons[:MAX_NAMED]]
    more = len(found.reasons) - len(messages)
    return [*messages, *([f"{found.bundle}: rejected: and {counted(more, 'reason')} more"] if more else [])]
