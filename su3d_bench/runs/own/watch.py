"""Datasets and methods of others, checked where they answer: what is wrong is told with their file and their line."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial, wraps
from pathlib import Path
from types import CodeType, NoneType
from typing import Any

import numpy as np
from pydantic import BaseModel

from su3d_bench.core import given, types
from su3d_bench.core.errors import PlugInError, Su3dError, own_line, printable
from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.core.types import Frame, GroundTruth, InstanceMesh, PerceptionNeeds, SceneInfo, Surface, WorldUp
from su3d_bench.runs.own.answers import fault_of, fault_of_list, in_stored_form

Kinds = tuple[type, ...]
# What each of their functions must give; nothing is asked of what is handed nothing back. A sequence has a length and
# gives its k-th. Those that nobody must have are watched where they are.
OF_DATASETS: dict[str, Kinds] = {
    "scenes": (Sequence,),
    "files": (Sequence,),
    "digest": (str,),
    "info": (SceneInfo,),
    "frames": (Sequence,),
    "ground_truth": (GroundTruth,),
    "instance_mesh": (InstanceMesh,),
    "places": (Sequence,),
    "status": (str,),
    "groups": (Mapping,),
    "problems": (Sequence,),
    "up": (WorldUp,),
    "surface": (Surface,),
    "whole_objects": (Sequence,),
    "queries": (Sequence,),
}
OF_METHODS: dict[str, Kinds] = {
    "receive_tools": (),
    "receive_truth": (),
    "start": (),
    "update": (),
    "finish": (Instances, Partition, DenseFeatures),
    "close": (),
}
# What a method says without being called.
OF_PROPERTIES: dict[str, Kinds] = {
    "needs": (PerceptionNeeds,),
    "n_points": (int, np.integer),
    "n_instances": (int, np.integer),
    "map_bytes": (int, np.integer),
    "losses": (Mapping,),
    "finish_costs": (Mapping,),
    "inputs": (Mapping,),
    "caveat": (str, NoneType),
}


def is_ours(plug_in: type) -> bool:
    return plug_in.__module__.startswith("su3d_bench.")


def settings_model(plug_in: type, name: str) -> type[BaseModel]:
    """The model of settings that a class holds under ``name``."""
    model: Any = getattr(plug_in, name)
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        raise PlugInError(f"{place_of(plug_in)}.{name} is {_described(model)}; a pydantic.BaseModel is expected")
    return model


def made(plug_in: type, *words: Any) -> Any:
    """An object of the class; what its ``__init__`` does not take is told with its line."""
    if is_ours(plug_in):
        return plug_in(*words)
    function = plug_in.__init__  # type: ignore[misc]
    return _called(place_of(plug_in, "__init__", function), plug_in, words, {})


def checked_dataset(dataset: Any) -> Any:
    """``dataset``; one of somebody's own checks from now on what it gives."""
    return dataset if is_ours(type(dataset)) else _watched(dataset, OF_DATASETS)


def checked_method(method: Any) -> Any:
    """``method``; one of somebody's own checks from now on what it gives."""
    if is_ours(type(method)):
        return method
    told(method, "needs")
    return _watched(method, OF_METHODS)


def told(method: Any, name: str) -> Any:
    """The property ``name`` of a method."""
    value = getattr(method, name)
    if not is_ours(type(method)):
        known = inspect.getattr_static(type(method), name, None)
        place = place_of(type(method), name, known.fget if isinstance(known, property) else known)
        _expect(place, value, OF_PROPERTIES[name])
        _sound(place, value)
    return value


def place_of(plug_in: type, name: str = "", function: Any = None) -> str:
    """``my_method.py:12: MyMethod.name``: where somebody's own class, or ``function`` of it, is written."""
    code: CodeType | None = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    where = ""
    if code is not None:
        where = f"{Path(code.co_filename).name}:{code.co_firstlineno}: "
    else:
        with suppress(OSError, TypeError):
            where = f"{Path(inspect.getfile(plug_in)).name}:{inspect.getsourcelines(plug_in)[1]}: "
    return printable(f"{where}{plug_in.__name__}{f'.{name}' if name else ''}", 300)


def _watched(plug_in: Any, expected: Mapping[str, Kinds]) -> Any:
    for name, kinds in expected.items():
        if (function := getattr(plug_in, name, None)) is None or not callable(function):
            continue
        watching = wraps(function)(partial(_asked, plug_in, name, function, kinds))
        with suppress(AttributeError):  # of a class with slots, which then answers unwatched
            object.__setattr__(plug_in, name, watching)
    return plug_in


def _asked(plug_in: Any, name: str, function: Callable[..., Any], kinds: Kinds, *words: Any, **named: Any) -> Any:
    place = place_of(type(plug_in), name, function)
    found = _called(place, function, words, named)
    if not kinds:
        return found
    _expect(place, found, kinds)
    if name == "frames":
        return _Frames(place, found)
    if name == "digest" and not found:
        raise PlugInError(f"{place} gave an empty text; a key that is equal only where the data are is expected")
    if kinds == (Sequence,) and (fault := fault_of_list(name, found)) is not None:
        raise PlugInError(f"{place}: {fault}")
    return _sound(place, found)


def _called(place: str, function: Callable[..., Any], words: Sequence[Any], named: Mapping[str, Any]) -> Any:
    """What ``function`` gives. What it does not take, or what our own types refuse in it, is a ``PlugInError``."""
    try:
        return function(*words, **named)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:  # it was never entered
            raise PlugInError(f"{place}: {error}") from error
        raise
    except Su3dError as error:
        if not isinstance(error, PlugInError) and _is_of_our_types(error) and (line := own_line(error)):
            raise PlugInError(f"{line}: {error}") from error
        raise


def _is_of_our_types(error: BaseException) -> bool:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_code.co_filename in (types.__file__, given.__file__)


def _sound(place: str, found: Any) -> Any:
    found = in_stored_form(found)
    if (fault := fault_of(found)) is not None:
        raise PlugInError(f"{place}: {fault}")
    return found


class _Frames(Sequence[Frame]):
    """Frames of somebody's own, each checked when it is read."""

    def __init__(self, place: str, frames: Sequence[Frame]) -> None:
        self._place = place
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, k: Any) -> Any:
        place = f"{self._place}(...)[{k}]"
        frame = _called(place, self._frames.__getitem__, (k,), {})
        _expect(place, frame, (Frame,))
        return _sound(place, frame)


def _expect(place: str, found: Any, kinds: Kinds) -> None:
    is_sequence = kinds == (Sequence,)
    is_listed = hasattr(found, "__len__") and hasattr(found, "__getitem__")
    fits = is_listed and not isinstance(found, str | bytes | Mapping) if is_sequence else isinstance(found, kinds)
    if not fits:
        raise PlugInError(f"{place} gave {_described(found)}; {_wanted(kinds)} is expected")


def _described(value: Any) -> str:
    if value is None:
        return "None"
    name = "class" if isinstance(value, type) else type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def _wanted(kinds: Kinds) -> str:
    names = ["None" if kind is NoneType else kind.__name__ for kind in kinds if kind is not np.integer]
    words = {"Sequence": "a sequence", "int": "an int", "Instances": "an Instances", "InstanceMesh": "an InstanceMesh"}
    return " or ".join(words.get(name, name if name == "None" else f"a {name}") for name in names)
