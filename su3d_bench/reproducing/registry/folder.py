"""The folder of a registry: which bundles are in it, what they hold together, and how one more comes in."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from su3d_bench.analysis.leaderboard import Refused, in_order, ranked
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, StoreError, Su3dError, counted, printable, reading, shown
from su3d_bench.core.files.atomic import make_folder, replacing
from su3d_bench.core.system.files import opened
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.reproducing.bundle import PIECE
from su3d_bench.reproducing.registry.rows import Row, rows_of_bundle
from su3d_bench.reproducing.verifying import verify_bundle

N_DIGITS = 12  # of a digest, in a message


def why_not_beside(row: Row, held: Sequence[Row]) -> str | None:
    """Why ``row`` cannot stand in a registry that holds the rows ``held``, with what to do; None where it can."""
    for other in held:
        fault = (
            _rules(row, other) or _data(row, other) or _encoder(row, other) or _name(row, other) or _labels(row, other)
        )
        if fault is not None:
            return f"{row.what}: {fault}"
    return None


def _rules(row: Row, other: Row) -> str | None:
    mine, theirs = row, other
    if mine.protocol != theirs.protocol or (mine.version, mine.digest) == (theirs.version, theirs.digest):
        return None
    return (
        f"its protocol is version {mine.version}, digest {mine.digest[:N_DIGITS]}, that of {_where(other)} is version "
        f"{theirs.version}, digest {theirs.digest[:N_DIGITS]}; score it again by those rules, or begin another registry"
    )


def _data(row: Row, other: Row) -> str | None:
    theirs = dict(other.data)
    for scene, digest in row.data:
        if theirs.get(scene, digest) != digest:
            return (
                f"its data of {scene} have the digest {digest[:N_DIGITS]}, those of {_where(other)} "
                f"{theirs[scene][:N_DIGITS]}; run it on the same data, settings of the dataset included"
            )
    return None


def _encoder(row: Row, other: Row) -> str | None:
    """Features are compared with those of texts: under a protocol that names an encoder, of one encoder alone."""
    if row.protocol != other.protocol or None in (row.encoder, other.encoder):
        return None
    if not _names_encoder(row.protocol):
        return None
    if row.encoder != other.encoder:
        return (
            f"its features are of the encoder {row.encoder}, those of {_where(other)} of {other.encoder}, and the "
            "protocol is of one encoder; run it with that one"
        )
    mine, theirs = ({one.model: one.files for one in each.weights if one.files} for each in (row, other))
    for model in mine.keys() & theirs.keys():
        if model_is_encoder(model) and mine[model] != theirs[model]:
            return f"its weights of {model} are not those of {_where(other)} (other SHA-256); run it with the same file"
    return None


def model_is_encoder(model: str) -> bool:
    """Whether a model of the catalogue encodes crops and texts."""
    from su3d_bench.perception.models.catalogue import MODELS

    return model in MODELS and MODELS[model].kind == "encoder"


def _names_encoder(protocol: str) -> bool:
    try:
        return protocol in protocol_names() and load_protocol(protocol).encoder is not None
    except ConfigError:  # somebody's own rules, which their run keeps
        return False


def _name(row: Row, other: Row) -> str | None:
    if row.ranking != other.ranking or row.method.casefold() != other.method.casefold():
        return None
    return (
        f"that name is taken by {_where(other)} over the same scenes; give the variant its own name, such as "
        f"{row.method.partition('@')[0]}@KEY=VALUE, or remove the other bundle first"
    )


def _labels(row: Row, other: Row) -> str | None:
    mine, theirs = row, other
    if mine.ranking != theirs.ranking or mine.is_ceiling or theirs.is_ceiling or mine.labels == theirs.labels:
        return None
    return f"is of {mine.labels}, {_where(other)} of {theirs.labels}; score it with as many labels"


def _where(row: Row) -> str:
    return f"{row.method} in {row.bundle.name}.zip"


BUNDLES = "bundles"
SUFFIX = ".zip"
MOST_BUNDLES = 2000
MOST_NAMED = 3  # reasons of one bundle in its line
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_ANY = "bundle"  # what reproduce calls every one of its archives


@dataclass(frozen=True)
class Registry:
    """All that a folder of bundles holds: rankings, the best first, and what stands in none with its reason."""

    n_bundles: int
    boards: tuple[tuple[Row, ...], ...]
    refused: tuple[Refused, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        return tuple(row for board in self.boards for row in board)


def bundle_files(folder: Path) -> list[Path]:
    """The bundles of a registry by name: those in its folder ``bundles``, or beside each other in ``folder``.

    A ``ConfigError`` where it is no folder.
    """
    if not folder.is_dir():
        raise ConfigError(f"{shown(folder)}: is no folder; begin a registry with: su3d-bench dev registry new DIR")
    place = folder / BUNDLES if (folder / BUNDLES).is_dir() else folder
    try:
        files = sorted(place / name for name in os.listdir(place) if name.lower().endswith(SUFFIX))
    except OSError as error:
        raise StoreError(f"{shown(place)}: cannot be read: {error.strerror or error}") from error
    if len(files) > MOST_BUNDLES:
        raise ConfigError(f"{shown(place)}: holds {len(files)} bundles; a registry has at most {MOST_BUNDLES}")
    return files


def read_registry(folder: Path) -> Registry:
    """What the bundles of ``folder`` hold, each file held against its manifest and each number against its counts.

    Their maps are not scored anew: ``add_bundle`` does. Of two rows that do not go together that of the later name is
    left out. A ``ConfigError`` where the folder holds no bundle and has no place for any.
    """
    files = bundle_files(folder)
    if not files and not (folder / BUNDLES).is_dir():
        raise ConfigError(
            f"{shown(folder)}: holds no bundle; bring one in with: su3d-bench dev registry add BUNDLE --to DIR"
        )
    rows: list[Row] = []
    refused: list[Refused] = []
    for file in files:
        mine, others = _read(file)
        refused += others
        for row in mine:
            reason = why_not_beside(row, rows)
            if reason is None:
                rows.append(row)
            else:
                refused.append(Refused(row.bundle.name, row.what, reason.removeprefix(f"{row.what}: ")))
    return Registry(len(files), tuple(_boards(rows)), tuple(refused))


def _read(file: Path) -> tuple[list[Row], list[Refused]]:
    name = printable(file.name, 120)
    try:
        rows, refused = rows_of_bundle(file)
    except Su3dError as error:
        return [], [Refused(name, "bundle", printable(str(error).replace(f"{shown(file)}: ", ""), 400))]
    return rows, [replace(one, run=f"{name} {one.run}") for one in refused]


def _boards(rows: Sequence[Row]) -> Iterator[tuple[Row, ...]]:
    """The rankings by protocol, those of the most scenes first."""
    rankings = sorted({row.ranking for row in rows}, key=lambda key: (key[0], -len(key[2]), key))
    for ranking in rankings:
        yield ranked(in_order([row for row in rows if row.ranking == ranking]))


@dataclass(frozen=True)
class Added:
    """What became of a bundle: ``reasons`` are why it was refused, none where it is in the registry at ``place``."""

    bundle: str
    place: str
    n_rows: int = 0
    n_scores: int = 0
    is_to_the_bit: bool = False
    reasons: tuple[str, ...] = ()


def add_bundle(file: Path, registry: Path, name: str | None = None) -> Added:
    """Take ``file`` into ``registry`` after it was scored anew, or say why not.

    It is refused where its numbers are not what its maps give by the rule of ``verify_bundle``, where a row of it can
    stand in no ranking, or does not go with the rows that are there. One that lies in the registry already, as in a
    pull request, is held against all others and stays. A ``StoreError`` or ``DataError`` where it is no bundle, a
    ``ConfigError`` where ``name`` is none or the registry holds a damaged bundle.
    """
    others = [one for one in bundle_files(registry) if not _is_same_file(one, file)]
    is_there = len(others) < len(bundle_files(registry))
    before = _digest(file)
    rows, refused = rows_of_bundle(file)
    if is_there and name is not None:
        raise ConfigError(f"--name: {shown(file)} is in the registry already; rename the file itself")
    place = file if is_there else _place(registry, file, rows, name)
    found = Added(printable(file.name, 120), printable(str(place), 300), len(rows))
    reasons = [f"{one.what}: {one.reason}" for one in refused]
    if not rows and not refused:
        reasons.append("holds no run; pack one with: su3d-bench report bundle RUN")
    reasons = reasons or list(_beside(rows, others, before))
    if not reasons and not is_there and os.path.lexists(place):
        reasons.append(f"{printable(place.name, 120)} is taken by another bundle; choose another with --name")
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
    """Why the rows of a bundle of this digest cannot stand beside each other and the bundles ``others``."""
    held: list[Row] = []
    for other in others:
        mine, refused = _read(other)
        if refused:
            first = refused[0]
            raise ConfigError(
                f"{shown(other)}: is in the registry and cannot stand there: {first.what}: {first.reason}; remove it "
                "or make it anew first"
            )
        if mine and mine[0].bundle.sha256 == digest:
            yield f"is there already as {mine[0].bundle.name}{SUFFIX}"
            return
        held += mine
    for row in rows:
        reason = why_not_beside(row, held)
        if reason is not None:
            yield reason
        held.append(row)


def _is_same_file(one: Path, other: Path) -> bool:
    try:
        return os.path.samefile(one, other)
    except OSError:
        return False


def _place(registry: Path, file: Path, rows: Sequence[Row], name: str | None) -> Path:
    """Where a bundle goes; one that has no name of its own is called after its recipe or run, and its digest."""
    if name is None:
        name = file.name[: -len(SUFFIX)] if file.name.lower().endswith(SUFFIX) else file.name
        if name == _ANY and rows:
            first = rows[0]
            name = f"{first.bundle.recipe or re.sub('[^A-Za-z0-9._-]+', '-', first.run)}-{first.bundle.sha256[:8]}"
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"'{printable(name, 100)}' cannot be the name of a bundle: letters, digits, '.', '_' and '-' alone; choose "
            "one with --name"
        )
    folder = registry / BUNDLES if (registry / BUNDLES).is_dir() or not bundle_files(registry) else registry
    return folder / f"{name}{SUFFIX}"


def _digest(file: Path) -> str:
    with reading(shown(file), StoreError):
        return digest_file(file)


def _copy(file: Path, place: Path, digest: str) -> None:
    """The file at ``place``, whole or not at all; a ``StoreError`` where it is not the one that was scored."""
    make_folder(place.absolute().parent)
    with reading(shown(file), StoreError), opened(file) as source, replacing(place) as out:
        while piece := source.read(PIECE):
            out.write(piece)
    if _digest(place) != digest:
        place.unlink(missing_ok=True)
        raise StoreError(f"{shown(file)}: changed while it was scored; add it again")


def lines_of(found: Added) -> list[str]:
    """What is told of a bundle that was added or refused, a line a reason."""
    if not found.reasons:
        how = "to the last bit" if found.is_to_the_bit else "integers the same, values within 1e-9"
        scores = f"{counted(found.n_scores, 'score')} made anew, {how}"
        return [f"{found.bundle}: in the registry as {found.place}: {counted(found.n_rows, 'row')}; {scores}"]
    told = [f"{found.bundle}: refused: {reason}" for reason in found.reasons[:MOST_NAMED]]
    more = len(found.reasons) - len(told)
    return [*told, *([f"{found.bundle}: refused: and {counted(more, 'reason')} more"] if more else [])]
