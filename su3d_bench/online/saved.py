"""A session in a folder: ``session.json``, which names everything that its state depends on, and the method's state.

The state is written to a new folder, then ``session.json`` is replaced: a process that is killed leaves the previous
state. Sizes and digests of all files are checked before they are read.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from su3d_bench.core import registry
from su3d_bench.core.digests import code_digest, digest_file
from su3d_bench.core.errors import DataError, StoreError, printable, reading, shown
from su3d_bench.core.files.atomic import DAMAGE, make_folder, write_json
from su3d_bench.core.interfaces import Method, Saves
from su3d_bench.core.types import SceneInfo
from su3d_bench.core.version import __version__
from su3d_bench.perception.profiles import Perception
from su3d_bench.runs.job import Part, settings_key
from su3d_bench.store.records import Count, read_record

RECORD = "session.json"
STATE = re.compile(r"state-(\d{1,9})")
SAVE_AGAIN = "save the session again"


@dataclass(frozen=True)
class SessionRecord:
    """``session.json``: the key of the state, what continues it, and size and SHA-256 of the ``files`` in ``state``.

    ``target`` and ``options`` are those of the method's ``Part``, ``scene`` the fields of ``SceneInfo``.
    """

    key: Mapping[str, str]
    target: str
    options: str
    scene: Mapping[str, str | int]
    n_updates: Count = 0
    as_of: tuple[int | None, int | None] = (None, None)
    state: str = ""
    files: Mapping[str, tuple[Count, str]] = field(default_factory=dict)


def session_record(
    part: Part, method: Method, perception_settings: str, perception: Perception, scene: SceneInfo
) -> SessionRecord:
    """The record of a session before its first frame; ``perception_settings`` is JSON."""
    sections = ((f"method.{part.name}", part.options), ("perception", perception_settings))
    key = {"method": part.name, **settings_key(sections, method), "profile": perception.profile}
    key |= {"encoder": perception.encoder.digest, "code.method": registry.code_key(part.target) or "built in"}
    key |= {"version": __version__, "code": code_digest()}
    of_scene = {one.name: getattr(scene, one.name) for one in fields(scene) if one.compare}
    return SessionRecord(key, part.target, part.options, of_scene)


def write_session(path: Path, method: Saves, record: SessionRecord) -> None:
    """Store the state of ``method`` in ``path``, described by ``record``, in place of an earlier session there."""
    make_folder(path)
    states = {child.name: STATE.fullmatch(child.name) for child in path.iterdir() if child.name != RECORD}
    if others := [name for name, is_state in states.items() if not is_state]:
        raise StoreError(
            f"{shown(path)}: contains other files ({printable(others[0], 80)}); choose a folder of its own"
        )
    state = path / f"state-{1 + max((int(found[1]) for found in states.values() if found), default=0)}"
    make_folder(state)
    try:
        method.save_state(state)
        files = {child.name: (child.stat().st_size, digest_file(child)) for child in sorted(state.iterdir())}
        write_json(path / RECORD, asdict(replace(record, state=state.name, files=files)))
    except BaseException:
        shutil.rmtree(state, ignore_errors=True)
        raise
    for name in states:
        shutil.rmtree(path / name, ignore_errors=True)


def read_session(path: Path) -> SessionRecord:
    """The record of the session in ``path``; ``StoreError`` if there is none."""
    if not (path / RECORD).is_file():
        raise StoreError(f"{shown(path)}: is not a saved session (no {RECORD})")
    record = read_record(SessionRecord, path / RECORD, shown(path))
    if STATE.fullmatch(record.state) is None:
        raise StoreError(f"{shown(path)}: {RECORD}: '{printable(record.state, 40)}' is no state; {SAVE_AGAIN}")
    return record


def scene_of(record: SessionRecord) -> SceneInfo:
    """The scene of a saved session, without the scan's mesh."""
    try:
        return SceneInfo(**record.scene)  # type: ignore[arg-type]  # checked there
    except (TypeError, DataError) as error:
        raise StoreError(f"session: its scene is invalid ({printable(str(error), 120)})") from error


def check_key(path: Path, record: SessionRecord, key: Mapping[str, str]) -> None:
    """``StoreError`` that names the first entry in which the key of a saved session differs from ``key``."""
    for name in {**key, **record.key}:
        saved, here = record.key.get(name, "none"), key.get(name, "none")
        if saved != here:
            what = f"{printable(name, 80)} {printable(saved, 60)}, here {printable(here, 60)}"
            raise StoreError(f"{shown(path)}: was saved with another {what}; start a new session")


def load_state(path: Path, method: Saves, record: SessionRecord) -> None:
    """Restore the state of ``method``; ``StoreError`` if a file is missing, damaged or invalid."""
    state = path / record.state
    with reading(shown(state), StoreError):
        names = sorted(child.name for child in state.iterdir())
        if names != sorted(record.files):
            raise StoreError(f"{shown(state)}: its files are not those of {RECORD}; {SAVE_AGAIN}")
        for name, (n_bytes, digest) in record.files.items():
            if (state / name).stat().st_size != n_bytes or digest_file(state / name) != digest:
                raise StoreError(f"{shown(state / name)}: is damaged or truncated; {SAVE_AGAIN}")
    try:
        method.load_state(state)
    except (*DAMAGE, LookupError, AttributeError) as error:
        raise StoreError(
            f"{shown(state)}: is not a valid state ({printable(str(error), 120)}); {SAVE_AGAIN}"
        ) from error
