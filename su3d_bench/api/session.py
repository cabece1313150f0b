"""Sessions: a method fed frame by frame from Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from su3d_bench.core import registry
from su3d_bench.core.arguments import several, typed
from su3d_bench.core.config import Setting, Settings
from su3d_bench.core.errors import ConfigError, StoreError
from su3d_bench.core.types import SceneInfo
from su3d_bench.online.saved import SessionRecord, check_key, read_session, scene_of, session_record
from su3d_bench.online.session import Session, check_incremental
from su3d_bench.runs.job import Part, build_method, options_model
from su3d_bench.runs.plan import method_part, named_method

Place = str | Path


@typed
def session(
    method: str | type | None = None,
    scene_info: SceneInfo | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    profile: str | None = None,
    device: str | None = None,
    load: Place | None = None,
) -> Session:
    """Start a method that you feed frame by frame, such as on a robot; its maps equal those of ``run`` bit for bit.

    ``method``: as in ``run`` (default: opensu3d), ``settings``: those of the method, and of perception as
    ``perception.KEY``; ``profile`` and ``device`` as in ``run``, except the profile ``oracle``. A ``Session`` has
    ``push(frame)``, ``snapshot()``, ``query(text)``, ``save(path)`` and ``revise(poses)``.

    ``load``: a folder written by ``save``, whose session continues, also on a second visit; profile and scene are those
    of the folder unless given, and so are method and settings if neither is given. It is an error if these, the encoder
    or the version of the program are others than in the folder. Perception settings and a user-defined method are not
    read from the folder: pass them again.

    Raises ``ConfigError`` for an invalid request or a method that works on whole scenes, ``ModelMissing`` for missing
    models, ``StoreError`` for a folder that cannot be continued.

    >>> import numpy as np, su3d_bench as su3d
    >>> scene = su3d.SceneInfo("mine", "desk", n_frames=0, stride=1, image_domain="rendered-rooms")
    >>> camera = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    >>> depth = np.full((48, 64), 2.0, np.float32)
    >>> with su3d.session("opensu3d", scene, settings={"top_m": 3}) as s:
    ...     s.push(su3d.Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), depth, np.eye(4), camera))
    ...     s.snapshot().as_of.geometry
    0
    >>> su3d.session("openmask3d", scene)
    Traceback (most recent call last):
    su3d_bench.core.errors.ConfigError: session: openmask3d works on the whole scene; use su3d.run
    """
    from su3d_bench.core.config import resolve
    from su3d_bench.perception.profiles import PerceptionConfig, build_perception, check_models
    from su3d_bench.runs.scene import warm_up
    from su3d_bench.runs.scenes import cache_root

    folder = None if load is None else Path(load)
    saved = None if folder is None else read_session(folder)
    if saved is not None:
        profile = profile or saved.key.get("profile")
        scene_info = scene_info or scene_of(saved)
    if scene_info is None:
        raise ConfigError("session: scene_info is missing; pass a su3d.SceneInfo")
    of_perception = {key: value for key, value in (settings or {}).items() if key.startswith("perception.")}
    of_method = {key: value for key, value in (settings or {}).items() if key not in of_perception}
    part = _part(method or "opensu3d", of_method) if saved is None or method else _saved_part(saved, of_method)
    found = build_method(part)
    check_incremental(found)
    if device is not None:
        of_perception["perception.models.device"] = device
    config = resolve(_settings((), of_perception), ("perception",), PerceptionConfig)
    profile = profile or "auto"
    if profile == "oracle":
        raise ConfigError("session: profile 'oracle' needs ground truth, which a session does not have")
    check_models(profile, config)
    perception = build_perception(profile, config, scene=scene_info, cache_root=cache_root().absolute(), mesh=None)
    record = session_record(part, found, config.model_dump_json(), perception, scene_info)
    if folder is not None and saved is not None:
        check_key(folder, saved, record.key)
        record = replace(record, n_updates=saved.n_updates, as_of=saved.as_of, state=saved.state, files=saved.files)
    warm_up(part)
    return Session(found, perception, scene_info, record, folder)


def _part(method: str | type, values: Mapping[str, Any]) -> Part:
    """The method with its settings; ``ConfigError`` for an unknown one."""
    (given,) = several("method", method, str | type)
    named = named_method(registry.target_of("method", given) if isinstance(given, type) else given)
    if named.corruption:
        raise ConfigError(f"session: {named.name}: corruptions are for runs; change the frames before you push them")
    return method_part(named, _settings(("method", named.name), values))


def _saved_part(saved: SessionRecord, values: Mapping[str, Any]) -> Part:
    """The built-in method of a saved session; no other, because the folder may come from others."""
    if saved.target not in registry.METHODS:
        raise ConfigError("session: the saved method is not built in; pass method=")
    if values:
        return _part(saved.target, values)
    try:
        options_model("method", saved.target).model_validate_json(saved.options)
    except ValidationError as error:
        raise StoreError(f"session: the saved settings of {saved.target} are invalid; start a new session") from error
    return Part(saved.target, saved.key.get("method", ""), saved.options)


def _settings(prefix: tuple[str, ...], values: Mapping[str, Any]) -> Settings:
    paths = {(*prefix, *str(key).split(".")): value for key, value in values.items()}
    return Settings(tuple(Setting(path, value, "session(settings=...)") for path, value in paths.items()))
