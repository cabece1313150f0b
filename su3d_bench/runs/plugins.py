"""User-defined datasets and methods, checked where they answer: what is wrong is told with file and line."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial, wraps
from pathlib import Path
from types import CodeType, NoneType
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from su3d_bench.core import maps, types
from su3d_bench.core.errors import PlugInError, Su3dError, own_line, printable
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition
from su3d_bench.core.types import (
    Frame,
    GroundTruth,
    ImageDomain,
    InstanceMesh,
    LabelSet,
    PerceptionNeeds,
    SceneInfo,
    Surface,
    WorldUp,
)
from su3d_bench.store.predictions import array_fault, prediction_arrays, value_fault

# The types in which arrays are kept. What is of the same kind is brought into them, what is of another is refused.
FORMS: dict[str, type] = {
    **dict.fromkeys(("points", "features", "boxes", "centroids", "vertices", "evaluation_points"), np.float32),
    **dict.fromkeys(("scores", "view_scores"), np.float64),
    **dict.fromkeys(("indptr", "view_indptr", "ids"), np.int64),
    **dict.fromkeys(("indices", "views", "instance", "semantic", "every_semantic"), np.int32),
    **dict.fromkeys(("triangles", "instance_of_triangle", "segments"), np.int32),
}
# Arrays that a truth or mesh must have: kind of values, and what a row is.
ARRAYS: dict[type, dict[str, tuple[str, tuple[int, ...]]]] = {
    GroundTruth: {"points": ("f", (3,)), "semantic": ("i", ()), "instance": ("i", ())},
    Surface: {"vertices": ("f", (3,)), "triangles": ("i", (3,))},
    InstanceMesh: {"vertices": ("f", (3,)), "triangles": ("i", (3,)), "instance_of_triangle": ("i", ())},
}
ELEMENTS: dict[str, type] = {"scenes": str, "files": Path, "places": Path, "problems": str}
TEXTS = ("labels", "names", "captions", "view_names")
MOST_INT32 = np.iinfo(np.int32).max


# ---- what is wrong with values of the right type: their dataclasses check shapes that must agree


def fault_of(found: Any) -> str | None:
    """What is wrong with an answer of the right type; None where nothing is."""
    match found:
        case SceneInfo():
            return _fault_of_info(found)
        case Frame():
            depth = found.depth_m
            is_metres = not depth.size or (depth.min() >= 0 and depth.max() < np.inf)  # NaN is neither
            return None if is_metres else (
                "depth holds values that are negative or not finite; metres are expected, and 0 where there is none"
            )  # fmt: skip
        case GroundTruth():
            return _fault_of_arrays(found) or _fault_of_truth(found)
        case InstanceMesh() | Surface():
            return _fault_of_arrays(found) or _fault_of_mesh(found)
        case PerceptionNeeds():
            return _fault_of_choice("masks", found.masks, ("grounded", "class-agnostic", "none"))
        case Instances() | Partition() | DenseFeatures():
            return _fault_of_prediction(found)
    return None


def fault_of_list(name: str, found: Sequence[Any]) -> str | None:
    """Which entry of what the function ``name`` gives is not what it must be; None where all are."""
    kind = ELEMENTS.get(name, object)
    for k in range(len(found)):
        if not isinstance(found[k], kind):
            return f"entry {k} is {found[k]!r}, a {type(found[k]).__name__}; a {kind.__name__} is expected"
    is_twice = name == "scenes" and len(set(found)) != len(found)
    return f"one of the {len(found)} names stands there twice" if is_twice else None


def in_stored_form(found: Any) -> Any:
    """``found`` with each array in the type in which it is kept, and lists of texts as tuples."""
    if not isinstance(found, Instances | Partition | DenseFeatures | GroundTruth | InstanceMesh | Surface):
        return found
    changed: dict[str, Any] = {}
    for name in (field.name for field in fields(found)):
        value = getattr(found, name)
        if isinstance(value, list) and name in TEXTS:
            changed[name] = tuple(value)
        is_large = isinstance(found, DenseFeatures) and name == "features"  # stays in half precision
        if (
            isinstance(value, np.ndarray)
            and not is_large
            and _can_become(value, np.dtype(FORMS.get(name, value.dtype)))
        ):
            changed[name] = value.astype(FORMS[name])
    return replace(found, **changed) if changed else found


def _can_become(value: NDArray[Any], form: np.dtype[Any]) -> bool:
    """Whether ``value`` is of another type than ``form`` that holds nothing which ``form`` cannot hold but digits."""
    if value.dtype == form or value.dtype.kind not in ("iu" if form.kind == "i" else "f"):
        return False
    is_small = form.kind == "f" or not value.size
    return is_small or bool(np.iinfo(form).min <= value.min() and value.max() <= np.iinfo(form).max)


def _fault_of_info(info: SceneInfo) -> str | None:
    for name, least in (("n_frames", 0), ("stride", 1)):
        value = getattr(info, name)
        if not isinstance(value, int | np.integer) or value < least:
            return f"{name} is {value!r}; a whole number from {least} on is expected"
    return _fault_of_choice("image_domain", info.image_domain, get_args(ImageDomain))


def _fault_of_choice(name: str, value: Any, known: Sequence[str]) -> str | None:
    return None if value in known else f"{name} is {value!r}; {', '.join(map(repr, known))} are known"


def _fault_of_arrays(found: GroundTruth | InstanceMesh | Surface) -> str | None:
    for name, (kind, row) in ARRAYS[type(found)].items():
        value, wanted = getattr(found, name), "floats" if kind == "f" else "integers"
        if not isinstance(value, np.ndarray):
            return f"{name} is a {type(value).__name__}; an array of {wanted} is expected"
        if value.dtype.kind not in ("iu" if kind == "i" else kind):
            return f"{name} is an array of {value.dtype.name}, not of {wanted}"
        if value.ndim != 1 + len(row) or value.shape[1:] != row:
            return f"{name} is {value.shape}; {('N', *row)} is expected"
        if kind == "f" and not np.isfinite(value).all():
            return f"{name} holds values that are not finite"
        is_id = name.startswith("instance")
        if is_id and value.size and not 0 <= value.min() <= value.max() <= MOST_INT32:
            return f"{name} holds {value.min()} to {value.max()}; ids lie from 0 to {MOST_INT32}, 0 where there is none"
    labels: Any = None if isinstance(found, Surface) else found.labels
    if not isinstance(found, Surface) and not isinstance(labels, LabelSet):
        return f"labels is a {type(labels).__name__}; a LabelSet is expected"
    return None


def _fault_of_truth(truth: GroundTruth) -> str | None:
    every = truth.every_semantic
    if every is not None and every.dtype.kind != "i":
        return f"every_semantic is {every.dtype}; whole numbers are expected"
    for name, ids, no_class in (("semantic", truth.semantic, (-1, 0)), ("every_semantic", every, (0,))):
        unknown = np.setdiff1d(() if ids is None else ids, (*no_class, *truth.labels.ids))
        if len(unknown):
            return f"{name} holds the class id {int(unknown[0])}, which its labels do not have"
    return None


def _fault_of_mesh(mesh: InstanceMesh | Surface) -> str | None:
    corners = mesh.triangles
    if corners.size and not 0 <= corners.min() <= corners.max() < len(mesh.vertices):
        return f"triangles holds {corners.min()} to {corners.max()}, there are {len(mesh.vertices)} vertices"
    if isinstance(mesh, Surface):
        return None
    if len(mesh.instance_of_triangle) != len(corners):
        return f"instance_of_triangle is {mesh.instance_of_triangle.shape} for {len(corners)} triangles"
    classes: Any = mesh.class_of_instance
    if not isinstance(classes, Mapping):
        return f"class_of_instance is a {type(classes).__name__}; a Mapping is expected"
    for instance in np.unique(mesh.instance_of_triangle[mesh.instance_of_triangle > 0]).tolist():
        known = classes.get(instance, "no class")
        if known not in mesh.labels.ids:
            return f"class_of_instance has {known} for instance {instance}; a class id of its labels is expected"
    return None


def _fault_of_prediction(prediction: Instances | Partition | DenseFeatures) -> str | None:
    if fault := array_fault(prediction_arrays(prediction)) or value_fault(prediction):
        return fault
    features = None if isinstance(prediction, DenseFeatures) else prediction.features
    if features is not None and not np.isfinite(features).all():
        row = int(np.flatnonzero(~np.isfinite(features).all(axis=1))[0])
        return f"'features' has values that are NaN or infinite, first in row {row}"
    if not isinstance(prediction, Instances):
        return None
    k = len(prediction)
    for name in ("boxes", "centroids"):
        if len(getattr(prediction, name)) != k:
            return f"'{name}' has {len(getattr(prediction, name))} rows for {k} instances"
    if len(prediction.ids) not in (0, k):
        return f"'ids' has {len(prediction.ids)} for {k} instances"
    falls = (np.diff(prediction.owners) == 0) & (np.diff(prediction.indices.astype(np.int64)) <= 0)
    if falls.any():
        owner = prediction.owner_at(int(np.flatnonzero(falls)[0]))
        return f"the mask of instance {owner} is not ascending, or holds a point twice"
    views = Masks(prediction.view_indptr, prediction.views[:, 0])
    if len(views) != k or not views.is_whole:
        return f"'view_indptr' does not describe {len(prediction.views)} views of {k} instances"
    return None


# ---- where user-defined datasets and methods answer

Kinds = tuple[type, ...]
# What each function of a dataset and of a method returns; nothing is asked of those that return nothing. A sequence has
# a length and gives its k-th. Optional functions are checked where they are there.
OF_DATASETS: dict[str, Kinds] = {
    **dict.fromkeys(("scenes", "files", "frames", "places", "problems", "whole_objects", "queries"), (Sequence,)),
    **dict.fromkeys(("digest", "status"), (str,)),
    "info": (SceneInfo,),
    "ground_truth": (GroundTruth,),
    "instance_mesh": (InstanceMesh,),
    "groups": (Mapping,),
    "up": (WorldUp,),
    "surface": (Surface,),
}
OF_METHODS: dict[str, Kinds] = {
    **dict.fromkeys(("receive_tools", "receive_truth", "start", "update", "close"), ()),
    "finish": (Instances, Partition, DenseFeatures),
}
# What a method says without being called.
OF_PROPERTIES: dict[str, Kinds] = {
    "needs": (PerceptionNeeds,),
    **dict.fromkeys(("n_points", "n_instances", "map_bytes"), (int, np.integer)),
    **dict.fromkeys(("losses", "finish_costs", "inputs"), (Mapping,)),
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
    return trace is not None and trace.tb_frame.f_code.co_filename in (types.__file__, maps.__file__)


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
    is_listed = hasattr(found, "__len__") and hasattr(found, "__getitem__")
    fits = (
        is_listed and not isinstance(found, str | bytes | Mapping) if kinds == (Sequence,) else isinstance(found, kinds)
    )
    if not fits:
        wanted = " or ".join(_with_article(kind) for kind in kinds if kind is not np.integer)
        raise PlugInError(f"{place} gave {_described(found)}; {wanted} is expected")


def _described(value: Any) -> str:
    return "a class" if isinstance(value, type) else _with_article(type(value))


def _with_article(kind: type) -> str:
    name = "None" if kind is NoneType else kind.__name__
    return name if name == "None" else f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"
