"""The requested scenes: addresses and patterns, the datasets that they name, and where data are stored."""

from __future__ import annotations

import difflib
import fnmatch
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import Settings
from su3d_bench.core.errors import ConfigError, DataError, Su3dError, printable, suggest
from su3d_bench.core.interfaces import Dataset, HasGroups
from su3d_bench.runs.job import Part, build_dataset, part_of

DATA_ROOT = "~/.cache/su3d-bench/data"
CACHE_ROOT = "~/.cache/su3d-bench/cache"


def data_root() -> Path:
    """Where datasets are: ``$SU3D_DATA``, otherwise the user's cache."""
    return Path(os.environ.get("SU3D_DATA") or DATA_ROOT).expanduser()


def cache_root() -> Path:
    """Where per-frame perception is cached: ``$SU3D_CACHE``, otherwise the user's cache."""
    return Path(os.environ.get("SU3D_CACHE") or CACHE_ROOT).expanduser()


def split_address(address: str) -> tuple[str, str]:
    """Dataset target and scene (or pattern) of ``homes/tuning0`` or ``path/to/file.py:Class/scene``."""
    head, colon, tail = address.partition(".py:")
    if colon:
        name, _, scene = tail.partition("/")
        return f"{head}.py:{name}", scene
    target, _, scene = address.partition("/")
    return target, scene


def looks_like_scene(text: str) -> bool:
    """Whether ``text`` has the form of a scene's address, ``<dataset>/<scene>``, whether or not it exists."""
    target, scene = split_address(text)
    return bool(scene) and (target in registry.names("dataset") or ".py:" in target)


def nearest_scene(text: str, known: Iterable[str]) -> str:
    """A clause suggesting the address in ``known`` whose scene name is most similar to ``text``.

    Empty if none is similar; a matching dataset name, which many scenes share, is not enough.

    >>> nearest_scene("tuning0", ["homes/tuning0"]), nearest_scene("homes/tunng0", ["homes/tuning0"])
    ("; did you mean 'homes/tuning0'?", "; did you mean 'homes/tuning0'?")
    >>> nearest_scene("rooms/studio0", ["homes/tuning1"])
    ''
    """
    of_name: dict[str, str] = {}
    for address in known:
        of_name.setdefault(split_address(address)[1], address)
    target, name = split_address(text) if "/" in text else ("", text)
    near = difflib.get_close_matches(name, of_name, n=1, cutoff=0.7)
    if not near:
        return ""
    address = of_name[near[0]]
    is_alike = not target or difflib.SequenceMatcher(None, target, split_address(address)[0]).ratio() >= 0.6
    return f"; did you mean '{printable(address, 120)}'?" if is_alike else ""


def dataset_targets(addresses: Sequence[str]) -> list[str]:
    """The datasets named in ``addresses``, in order; addresses that are plain files are ignored."""
    targets: dict[str, None] = {}
    for address in addresses:
        target, _ = split_address(address)
        if target in registry.names("dataset") or ".py:" in target:
            targets[target] = None
        elif not os.path.exists(address):
            raise ConfigError(f"no scene matches '{address}'{_nearest_address(address)}")
    if not targets:
        hint = next(filter(None, map(_with_dataset, addresses)), "; expected such as homes/tuning0 or 'homes/test*'")
        raise ConfigError(f"no scene among {', '.join(addresses) or 'no --scenes'}{hint}")
    return list(targets)


def expand_scenes(
    addresses: Sequence[str], datasets: Mapping[str, Part]
) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    """(dataset target, scene) of every address or pattern, each once, in the given order; and notes.

    Files among the addresses, which a shell adds when it expands ``dataset/*``, are ignored with a note if other
    addresses match.
    """
    root = data_root()
    chosen: dict[tuple[str, str], None] = {}
    ignored = []
    for address in addresses:
        target, pattern = split_address(address)
        dataset = build_dataset(datasets[target], root) if target in datasets else None
        scenes = _matching_scenes(dataset, pattern) if dataset is not None and pattern else []
        if not scenes and os.path.exists(address):
            ignored.append(address)
        elif not scenes:
            assert dataset is not None
            known = [f"{target}/{scene}" for scene in (*dataset.scenes(), *_groups(dataset))]
            if not pattern:
                raise ConfigError(f"'{address}' is a dataset; name its scenes, such as '{target}/*'")
            raise ConfigError(f"no scene matches '{address}'{suggest(address, known)}")
        chosen.update(dict.fromkeys((target, scene) for scene in scenes))
    if not chosen:
        raise ConfigError(f"no scene matches {', '.join(addresses)}; expected such as homes/tuning0 or 'homes/test*'")
    notes = (f"ignored, not scenes: {' '.join(ignored)}",) if ignored else ()
    return list(chosen), notes


def _matching_scenes(dataset: Dataset, pattern: str) -> list[str]:
    scenes = list(dataset.scenes())
    if any(character in pattern for character in "*?["):
        return [scene for scene in scenes if fnmatch.fnmatchcase(scene, pattern)]
    if pattern in scenes:
        return [pattern]
    if pattern in _groups(dataset):
        return _whole_group(dataset, pattern, set(scenes))
    try:  # a scene that is generated on demand is in no list
        dataset.info(pattern, 1)
    except DataError:
        return []
    return [pattern]


def _groups(dataset: Any) -> Mapping[str, Sequence[str]]:
    """Names for groups of scenes, such as official splits; a dataset with such names has ``groups``."""
    return dataset.groups() if isinstance(dataset, HasGroups) else {}


def _whole_group(dataset: Dataset, name: str, here: set[str]) -> list[str]:
    """The scenes of a group, in its order, all of which must be available: a number over fewer is not the group's."""
    group = _groups(dataset)[name]
    missing = [scene for scene in group if scene not in here]
    if missing:
        raise ConfigError(
            f"{dataset.name}/{name}: {len(missing)} of its {len(group)} scenes are missing (the first: {missing[0]}); "
            "download them or name the available scenes"
        )
    return list(group)


def _with_dataset(name: str) -> str:
    """A clause suggesting the address of a scene, group or pattern that was named without its built-in dataset."""
    if "/" in name:
        return ""
    known: list[str] = []
    for target in registry.DATASETS:
        with suppress(Su3dError):  # no data of it here
            dataset = build_dataset(part_of("dataset", target, Settings()), data_root())
            if _matching_scenes(dataset, name):
                return f"; did you mean '{target}/{name}'?"
            known += [f"{target}/{scene}" for scene in (*dataset.scenes(), *_groups(dataset))]
    return nearest_scene(name, known)


def _nearest_address(address: str) -> str:
    target, slash, pattern = address.partition("/")
    near = difflib.get_close_matches(target, registry.names("dataset"), n=1, cutoff=0.6)
    if not slash and (hint := _with_dataset(address)):
        return hint
    if not near:
        return "; known datasets: " + ", ".join(registry.names("dataset"))
    return f"; did you mean '{near[0]}{slash or '/'}{pattern or '*'}'?"
