"""The run that a folder already contains: its request, whether it equals the present one, and how two are merged.

A run folder belongs to one request. The same request resumes it; a different one is rejected with its first
differences, unless it *extends* the run (the union of scenes, methods and protocols, all other values unchanged) or
*replaces* it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.config import DEFAULT_SOURCE, NEUTRAL_SETTINGS, KeyPath, Setting, Settings, read_file
from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import ConfigError, StoreError, printable, shown, some
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.system.files import file_bytes
from su3d_bench.questions.solver import ANSWER_SETTINGS
from su3d_bench.runs.job import FIELDS_KNOWN_LATER, NOT_IN_KEY, REPLACE_HINT, ConfiguredMethods, SceneJob
from su3d_bench.store.records import RunRecord, read_record
from su3d_bench.store.run_folder import JobFolder, RunFolder

Into = Literal["own", "extend", "replace"]  # what a request does with a folder that contains a run
Start = Literal["begun", "kept", "replaced"]  # what a plan does with it, see ``Plan``
JOINED = ("scenes", "methods", "protocols")
CALL_SETTINGS = NEUTRAL_SETTINGS - {"pictures", "accept_poses"}  # where scenes run: not inherited by an extension
FINISHED = ("complete", "incomplete")
MAX_NAMED = 3
SEAL = "# whole: "


@dataclass(frozen=True)
class Request:
    """The resolved request of a run: names, and every value by its path in ``run.toml``."""

    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    protocols: tuple[str, ...]
    values: Mapping[KeyPath, Any]


@dataclass(frozen=True)
class ExistingRun:
    """The run in a folder: its ``run.json`` (None if missing) and the settings of its ``run.toml``.

    ``content`` is ``run.toml`` as it is on disk; ``is_known`` states whether it is complete. The source of a setting is
    where its value came from when the run was first requested.
    """

    folder: Path
    content: bytes | None
    record: RunRecord | None
    is_known: bool = False
    settings: Settings = field(default_factory=Settings)

    @property
    def is_finished(self) -> bool:
        has_metrics = is_file(self.folder / "metrics.json")
        return self.is_known and has_metrics and self.record is not None and self.record.status in FINISHED

    @property
    def values(self) -> dict[KeyPath, Any]:
        return {entry.path: entry.value for entry in self.settings.entries}

    @property
    def requested(self) -> dict[KeyPath, Any]:
        """The values that are not defaults."""
        return {entry.path: entry.value for entry in self.settings.entries if entry.source != DEFAULT_SOURCE}

    def asked(self, name: str) -> tuple[str, ...]:
        """The list of texts that was requested as ``name``, such as scene patterns."""
        value = self.values.get((name,))
        return tuple(map(str, value)) if isinstance(value, list | tuple) else ()

    @property
    def protocols(self) -> tuple[str, ...]:
        """The protocols that scored it, or will score it."""
        own = () if self.record is None else tuple(rules.name for rules in self.record.protocols)
        return own or self.asked("protocols")


def with_end_marker(text: str) -> str:
    """``run.toml`` with a last line that shows whether the file is complete, which it may not be after a power cut."""
    return f"{text}{SEAL}{digest_bytes(text.encode())}\n"


def existing_run(folder: Path) -> ExistingRun | None:
    """The run in ``folder``; None if there is none. An incomplete ``run.toml`` is not read at all."""
    record = None
    if is_file(folder / "run.json"):
        with suppress(StoreError):  # run.toml counts then
            record = read_record(RunRecord, folder / "run.json", shown(folder))
    if not is_file(folder / "run.toml"):
        return None if record is None else ExistingRun(folder, None, record)
    content = file_bytes(folder / "run.toml")
    text, completion, digest = content.rpartition(SEAL.encode())
    if not completion or digest != f"{digest_bytes(text)}\n".encode():
        return ExistingRun(folder, content, record)
    lines = text.decode().splitlines()
    entries = (_as_first_requested(entry, lines) for entry in read_file(folder / "run.toml").entries)
    return ExistingRun(folder, content, record, True, Settings(tuple(entries)))


def _as_first_requested(entry: Setting, lines: Sequence[str]) -> Setting:
    """``entry`` of a file with these ``lines``, its source taken from the comment at the end of its line."""
    _, mark, remark = lines[int(entry.source.rpartition(":")[2]) - 1].rpartition("  # ")
    return replace(entry, source=remark.strip()) if mark else entry


def extended(asked: Settings, existing: ExistingRun | None, where: str) -> Settings:
    """The request of ``existing`` merged with the present one; ``where`` is the run's folder."""
    if existing is None or not existing.is_known:
        raise ConfigError(f"--extend: {printable(where, 300)} has no complete run.toml; omit --extend to start a run")
    joined = []
    for name in JOINED:
        given = [entry for entry in asked.entries if entry.path == (name,)]
        if given and isinstance(given[-1].value, list | tuple):
            before = existing.protocols if name == "protocols" else existing.asked(name)
            both = list(dict.fromkeys([*before, *map(str, given[-1].value)]))
            joined.append(replace(given[-1], value=both))
    names = {entry.path[0] for entry in joined}
    old = [entry for entry in existing.settings.entries if entry.path[0] not in {*names, *CALL_SETTINGS}]
    new = [entry for entry in asked.entries if entry.path[0] not in names]
    return Settings((*old, *new, *joined))


def differences(existing: ExistingRun, now: Request) -> tuple[list[str], list[str]]:
    """Clauses on the names and on the values in which the request of the run in a folder differs from ``now``.

    Empty if the same command was given again; requests that differ only in names may be merged in one run.
    """
    names: list[str] = []
    if existing.record is None and not existing.is_known:
        return names, []
    for noun, name in (("scene", "scenes"), ("method", "methods"), ("protocol", "protocols")):
        before = existing.asked(name) if existing.record is None else _names(existing.record, name)
        after = getattr(now, name) if existing.record is not None else tuple(map(str, now.values[(name,)]))
        if gone := [one for one in before if one not in after]:
            names.append(f"{_some(noun, gone)} not requested now")
        if new := [one for one in after if one not in before]:
            names.append(f"{_some(noun, new)} new")
    return names, _changed_values(existing, now) if existing.is_known else []


def _names(record: RunRecord, name: str) -> tuple[str, ...]:
    return tuple(rules.name for rules in record.protocols) if name == "protocols" else getattr(record, name)


def _some(noun: str, names: Sequence[str]) -> str:
    """``scenes a, b, c and 2 more are``"""
    shown_names = some([printable(name, 80) for name in names], MAX_NAMED)
    return f"{noun} {shown_names} is" if len(names) == 1 else f"{noun}s {shown_names} are"


def _changed_values(existing: ExistingRun, now: Request) -> list[str]:
    """``seed was 0, now 1`` for every value that differs and affects numbers."""
    old, new = existing.values, now.values
    parts = {path[:2] for path in old if len(path) > 2} & {path[:2] for path in new if len(path) > 2}
    clauses = []
    for path in dict.fromkeys([*new, *old]):
        if len(path) == 1 and (path[0] in (*JOINED, "stride") or path[0] in NEUTRAL_SETTINGS):
            continue
        if path[0] in ("method", "dataset") and (path[:2] not in parts or path[2:] == ("stride",)):
            continue
        if not _counts(path, new) or _is_same(path, old.get(path), new.get(path), existing):
            continue
        clauses.append(
            f"{printable('.'.join(path), 120)} was {_shown(path, old.get(path))}, now {_shown(path, new.get(path))}"
        )
    strides = [(_stride(old, name), _stride(new, name)) for kind, name in sorted(parts) if kind == "method"]
    clauses += dict.fromkeys(f"stride was {before}, now {after}" for before, after in strides if before != after)
    return clauses


def _counts(path: KeyPath, values: Mapping[KeyPath, Any]) -> bool:
    """Whether the value at ``path`` can affect a number of the request with these ``values``."""
    if path[:2] == ("perception", "language"):
        is_asked = values.get(("question_solver",)) == "llm" or values.get(("refiner",)) == "model"
        return is_asked and path[2:3] in [(name,) for name in ANSWER_SETTINGS]
    return not ".".join(path).startswith(NOT_IN_KEY)


def _is_same(path: KeyPath, before: Any, after: Any, existing: ExistingRun) -> bool:
    if path in (("schedule",), ("cost",)):  # their content is in the keys of the maps
        return (before is None) == (after is None)
    if path == ("anytime",):
        return sorted(set(before or ())) == sorted(set(after or ()))
    if path == ("profile",) and "auto" in (before, after):  # which resolved to the named one
        came_out = None if existing.record is None else existing.record.profile
        return before == after or came_out in (before, after)
    return bool(_plain(before) == _plain(after))


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _shown(path: KeyPath, value: Any) -> str:
    if value is None or (path == ("limit",) and not value):
        return "none"
    return printable(json.dumps(_plain(value), ensure_ascii=False, default=str), 80)


def _stride(values: Mapping[KeyPath, Any], method: str) -> Any:
    own = 1 if values.get(("realtime",)) else values.get(("method", method, "stride"), 1)
    return values.get(("stride",)) or own


def check_request(existing: ExistingRun, now: Request, into: Into, where: str) -> None:
    """A ``StoreError`` if the run at ``where`` differs from ``now``: it names the differences and the options."""
    names, values = differences(existing, now)
    if into == "extend":  # new names are the purpose of an extension
        names = [clause for clause in names if not clause.endswith(" new")]
    if into == "replace" or not (names or values):
        return
    what, name = some([*names, *values], MAX_NAMED), printable(where, 300)
    if into == "extend":
        raise StoreError(f"{name}: cannot be extended by this request ({what}); {REPLACE_HINT}")
    join = "" if values else "--extend adds this request to it, "
    raise StoreError(f"{name}: contains a different run ({what}); {join}{REPLACE_HINT}")


def replaced_jobs(folder: RunFolder, jobs: Sequence[SceneJob]) -> list[JobFolder]:
    """The jobs in ``folder`` that are removed if ``jobs`` replace its run; ``StoreError`` if foreign files would be."""
    methods = ConfiguredMethods()
    keys = [(folder.job(job.scene, part.name), methods.of(job, part)[1]) for job in jobs for part in job.parts]
    # As far as the request shows, these are the maps that the new run needs.
    kept = {at.path for at, key in keys if at.changed_field("predict", key, known_later=FIELDS_KNOWN_LATER) is None}
    going = [job for job in folder.jobs() if job.path not in kept]
    names = {job.path.relative_to(folder.path).as_posix() for job in going}
    for stranger in folder.foreign_files():
        if any(f"{stranger}/".startswith(f"{name}/") or name.startswith(f"{stranger}/") for name in names):
            raise StoreError(
                f"{shown(folder.path / stranger)}: does not belong to a run, but --replace would remove it; move it"
            )
    return going
