"""Find classes by name: first built-in ones, then entry points, then ``file.py:Class``.

A plug-in cannot use a built-in name. A class is checked when it is loaded: it has all required members, and no member
whose name is almost that of an optional one.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import os
import sys
import uuid
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import ConfigError, PlugInError, suggest
from su3d_bench.core.system.files import user_folder

DATASETS = {
    "homes": "su3d_bench.datasets.homes.dataset:Homes",
    "homes-sensor": "su3d_bench.datasets.homes.dataset:HomesSensor",
    "homes-changing": "su3d_bench.datasets.homes.changing:HomesChanging",
    "rooms": "su3d_bench.datasets.rooms.dataset:Rooms",
    "replica": "su3d_bench.datasets.replica.dataset:Replica",
    "scannet": "su3d_bench.datasets.scannet.dataset:ScanNet",
    "scannetpp": "su3d_bench.datasets.scannetpp.dataset:ScanNetPP",
    "arkitscenes": "su3d_bench.datasets.arkitscenes.dataset:ArkitScenes",
    "hm3dsem": "su3d_bench.datasets.hm3dsem.dataset:Hm3dSem",
    "tum": "su3d_bench.datasets.tum.dataset:Tum",
    "rgbd": "su3d_bench.datasets.rgbd.dataset:Rgbd",
}
METHODS = {
    "opensu3d": "su3d_bench.opensu3d.pipeline:OpenSU3D",
    "conceptfusion": "su3d_bench.baselines.conceptfusion.method:ConceptFusion",
    "conceptfusion-sam": "su3d_bench.baselines.conceptfusion.method:ConceptFusionSam",
    "conceptgraphs": "su3d_bench.baselines.conceptgraphs.method:ConceptGraphs",
    "conceptgraphs-detector": "su3d_bench.baselines.conceptgraphs.method:ConceptGraphsDetector",
    "openmask3d": "su3d_bench.baselines.openmask3d.method:OpenMask3D",
    "openmask3d-segment3d": "su3d_bench.baselines.openmask3d.method:OpenMask3DSegment3D",
    "sam3d": "su3d_bench.baselines.sam3d.method:SAM3D",
    "oracle": "su3d_bench.baselines.oracle:Oracle",
    "command": "su3d_bench.baselines.command.method:Command",
}
GENERATED = frozenset(("homes", "homes-changing", "homes-sensor", "rooms"))  # rendered from their names, without files
CEILING_METHOD = "oracle"  # uses ground truth: its score is reported with every number, and is not a bound
GROUND_TRUTH_FILES = "ground-truth"  # prefix of scenes with ground-truth files of an unknown dataset
GROUPS = {"dataset": "su3d_bench.datasets", "method": "su3d_bench.methods"}
BUILT_IN = {"dataset": DATASETS, "method": METHODS}
REQUIRED_CLASS_ATTRS = {"dataset": ("name", "Options", "label_space", "variants"), "method": ("name", "Config")}
TEXT_CLASS_ATTRS: dict[str, type] = {"name": str, "label_space": str, "variants": tuple}
MARK = "~"  # between a method and its corruptions: opensu3d~depth-holes-4
MIN_SIMILARITY = 0.84  # of a name to the intended one: a letter missing, added, changed or in the wrong place


def base_name(method: str) -> str:
    """The name of a method without variant and corruptions: ``opensu3d`` of ``opensu3d@top_m=1~depth-holes-4``."""
    return method.partition(MARK)[0].partition("@")[0]


def names(kind: str) -> list[str]:
    """All names of ``kind`` (``dataset`` or ``method``) that can be used without a path."""
    known = list(BUILT_IN[kind])
    for entry in entry_points(group=GROUPS[kind]):
        if entry.name in BUILT_IN[kind]:
            raise ConfigError(f"plug-in {entry.value}: the {kind} name '{entry.name}' is built in; use another name")
        known.append(entry.name)
    return known


_PASSED: dict[str, tuple[type, str]] = {}  # classes passed from Python and a key of their code, by target


def target_of(kind: str, plug_in: type) -> str:
    """The name under which ``load`` finds a class passed from Python: its built-in name or ``module:Class``.

    Its key is that of its file; without one, as in a notebook, it differs for every class.
    """
    target = f"{plug_in.__module__}:{plug_in.__qualname__}"
    if target in BUILT_IN[kind].values():
        return next(name for name, place in BUILT_IN[kind].items() if place == target)
    file = Path(getattr(sys.modules.get(plug_in.__module__), "__file__", None) or "")
    if file.is_file() or _PASSED.get(target, (None,))[0] is not plug_in:
        _PASSED[target] = plug_in, digest_file(file) if file.is_file() else uuid.uuid4().hex
    return target


def code_key(target: str) -> str | None:
    """A key of the code of a class that is user-defined or passed from Python; None for any other."""
    key = digest_file(Path(target.rpartition(":")[0])) if ".py:" in target else _PASSED.get(target, (None, ""))[1]
    return key[:16] or None


def load(kind: str, name: str) -> Any:
    """The class with this ``name``: a built-in, an entry point, ``file.py:Class``, or one passed from Python."""
    return checked(kind, name, _found(kind, name))


def _found(kind: str, name: str) -> Any:
    if name in BUILT_IN[kind]:
        module, _, attribute = BUILT_IN[kind][name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    for entry in entry_points(group=GROUPS[kind]):
        if entry.name == name:
            with user_folder([], waits=True):
                return entry.load()
    if ".py:" in name:
        return _from_file(kind, name)
    if name in _PASSED:
        return _PASSED[name][0]
    known = names(kind)
    raise ConfigError(f"unknown {kind} '{name}'{suggest(name, known)}")


def _from_file(kind: str, target: str) -> Any:
    path, _, attribute = target.rpartition(":")
    if not Path(path).is_file():
        raise ConfigError(f"{kind} '{target}': no file {path}")
    state = os.stat(path)
    module = _module_of(Path(path).resolve(), (state.st_mtime_ns, state.st_size))
    if not hasattr(module, attribute):
        classes = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
        raise ConfigError(f"{kind} '{target}': {path} defines no '{attribute}'{suggest(attribute, classes)}")
    found = getattr(module, attribute)
    if not isinstance(found, type):
        what = "function" if callable(found) else type(found).__name__
        raise PlugInError(f"{_line_of(found, Path(path).name)}: '{attribute}' is a {what}; name a class")
    return found


@cache
def _module_of(path: Path, state: tuple[int, int]) -> Any:
    """The module in a user-defined file, read once for each ``state`` of the file.

    It is registered in ``sys.modules`` under a unique name, because dataclasses look up their module there.
    """
    name = f"su3d_own_{path.stem}_{digest_json([str(path), state])[:12]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        with user_folder([], waits=True):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _line_of(plug_in: Any, file: str) -> str:
    """``my_method.py:12``, where a class or function is defined."""
    try:
        return f"{file}:{inspect.getsourcelines(plug_in)[1]}"
    except (OSError, TypeError):
        return file


@cache
def checked(kind: str, target: str, plug_in: Any) -> Any:
    """``plug_in``; ``ConfigError`` for a class that lacks a required member of ``kind`` or misspells an ability."""
    from su3d_bench.core.interfaces import ABILITIES, INTERFACES  # imports numpy: not needed for help texts

    if not isinstance(plug_in, type):
        return plug_in
    interface, where = INTERFACES[kind], f"{kind} '{target}'"
    if not plug_in.__module__.startswith("su3d_bench."):
        module = sys.modules.get(plug_in.__module__)
        line = _line_of(plug_in, Path(getattr(module, "__file__", None) or "").name)
        where = f"{line}: {where}" if line else where
    own = {name: is_called for base in plug_in.__mro__[:-1] for name, is_called in _members(base).items()}
    known = {name: called for each in (interface, *ABILITIES[kind]) for name, called in _members(each).items()}
    required = {*REQUIRED_CLASS_ATTRS[kind], *(name for name, called in _members(interface).items() if called)}
    for name, called in sorted(own.items()):
        absent = [other for other in known if other not in own and known[other] == called]
        meant = difflib.get_close_matches(name, absent, 1, MIN_SIMILARITY)
        # ``points`` is not a misspelt ``n_points``, nor a value ``closed`` a misspelt function ``close``
        if meant and meant[0].count("_") == name.count("_"):
            raise PlugInError(f"{where}: a {kind} has no '{name}'; did you mean '{meant[0]}'?")
    if missing := sorted(required - set(own)):
        raise PlugInError(f"{where}: '{missing[0]}' is missing; a {kind} has {', '.join(sorted(required))}")
    for name, wanted in TEXT_CLASS_ATTRS.items():
        value = getattr(plug_in, name, wanted())
        if name in required and not isinstance(value, wanted):
            raise PlugInError(f"{where}: its {name} is {value!r}; expected a {wanted.__name__}")
    return plug_in


def _members(plug_in: type) -> dict[str, bool]:
    """The public members of a class, without those of its bases, and whether each is a function."""
    members = dict.fromkeys(inspect.get_annotations(plug_in), False)
    for name in vars(plug_in):
        value = getattr(plug_in, name, None)
        members[name] = callable(value) and not isinstance(value, type)
    return {name: is_called for name, is_called in members.items() if not name.startswith("_")}
