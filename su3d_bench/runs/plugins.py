"""User-defined datasets and methods, checked at every return value: errors are reported with file and line."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache, partial, wraps
from pathlib import Path
from types import CodeType, NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel

from su3d_bench.core import arguments, maps, types
from su3d_bench.core.errors import PlugInError, Su3dError, printable, user_code_line
from su3d_bench.core.interfaces import ABILITIES, INTERFACES
from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.core.system.files import user_folder
from su3d_bench.core.types import Frame, GroundTruth, InstanceMesh, Surface
from su3d_bench.store.predictions import array_fault, prediction_arrays, value_fault

# The types in which arrays are stored. Arrays of the same kind are converted, those of another kind are rejected.
FORMS: dict[str, type] = {
    **dict.fromkeys(("points", "features", "boxes", "centroids", "vertices", "evaluation_points"), np.float32),
    **dict.fromkeys(("scores", "view_scores"), np.float64),
    **dict.fromkeys(("indptr", "view_indptr", "ids"), np.int64),
    **dict.fromkeys(("indices", "views", "instance", "semantic", "every_semantic"), np.int32),
    **dict.fromkeys(("triangles", "instance_of_triangle", "segments"), np.int32),
}
TYPE_FILES = tuple(module.__file__ for module in (arguments, maps, types))  # whose errors concern the values passed
# Arrays that a ground truth or mesh must have, and the shape of a row of each.
ARRAYS: dict[type, dict[str, tuple[int, ...]]] = {
    GroundTruth: {"points": (3,), "semantic": (), "instance": ()},
    Surface: {"vertices": (3,), "triangles": (3,)},
    InstanceMesh: {"vertices": (3,), "triangles": (3,), "instance_of_triangle": ()},
}


# ---- what is wrong with values of the right type: their dataclasses check shapes that must agree


def validation_error(found: Any) -> str | None:
    """What is wrong with a returned value of the right type; None if it is valid."""
    match found:
        case Frame():
            depth = found.depth_m
            is_metres = not depth.size or (depth.min() >= 0 and depth.max() < np.inf)  # NaN is neither
            return None if is_metres else "depth is negative or not finite; expected metres, 0 for no depth"
        case GroundTruth():
            return _fault_of_arrays(found) or _fault_of_truth(found)
        case InstanceMesh() | Surface():
            return _fault_of_arrays(found) or _fault_of_mesh(found)
        case Instances() | Partition() | DenseFeatures():
            return array_fault(prediction_arrays(found)) or value_fault(found) or _fault_of_prediction(found)
    return None


def in_stored_form(found: Any) -> Any:
    """``found`` with each array in its stored type, and lists of texts as tuples."""
    if not isinstance(found, Instances | Partition | DenseFeatures | GroundTruth | InstanceMesh | Surface):
        return found
    changed: dict[str, Any] = {}
    for name in (field.name for field in fields(found)):
        value = getattr(found, name)
        if isinstance(value, list):
            changed[name] = tuple(value)
        is_large = isinstance(found, DenseFeatures) and name == "features"  # stays in half precision
        if isinstance(value, np.ndarray) and name in FORMS and not is_large:
            form = np.dtype(FORMS[name])
            is_same_kind = value.dtype.kind in ("iu" if form.kind == "i" else "f")
            if is_same_kind and (form.kind == "f" or np.array_equal(value, value.astype(form))):
                changed[name] = value.astype(form, copy=False)
    return replace(found, **changed) if changed else found


def _fault_of_arrays(found: GroundTruth | InstanceMesh | Surface) -> str | None:
    for name, row in ARRAYS[type(found)].items():
        value, form = getattr(found, name), np.dtype(FORMS[name])
        if value.dtype != form or value.shape != (len(value), *row):
            return f"{name} is {value.dtype} {value.shape}; expected {form} {('N', *row)}"
        if not np.isfinite(value).all():
            return f"{name} has values that are not finite"
        if name.startswith("instance") and value.size and value.min() < 0:
            return f"{name} has {value.min()}; ids start at 1, and 0 means none"
    return None


def _fault_of_truth(truth: GroundTruth) -> str | None:
    for name, no_class in (("semantic", (-1, 0)), ("every_semantic", (0,))):
        ids = getattr(truth, name)
        unknown = np.setdiff1d(() if ids is None else ids, (*no_class, *truth.labels.ids))
        if len(unknown):
            return f"{name} has the class id {unknown[0]:g}, which is not in its labels"
    return None


def _fault_of_mesh(mesh: InstanceMesh | Surface) -> str | None:
    corners = mesh.triangles
    if corners.size and not 0 <= corners.min() <= corners.max() < len(mesh.vertices):
        return f"triangles has indices {corners.min()} to {corners.max()}, but there are {len(mesh.vertices)} vertices"
    if isinstance(mesh, Surface):
        return None
    if len(mesh.instance_of_triangle) != len(corners):
        return f"instance_of_triangle is {mesh.instance_of_triangle.shape} for {len(corners)} triangles"
    classes: Any = mesh.class_of_instance
    for instance in np.unique(mesh.instance_of_triangle[mesh.instance_of_triangle > 0]).tolist():
        known = classes.get(instance, "no class") if isinstance(classes, Mapping) else "no class"
        if known not in mesh.labels.ids:
            return f"class_of_instance has {known} for instance {instance}; expected a class id of its labels"
    return None


def _fault_of_prediction(prediction: Instances | Partition | DenseFeatures) -> str | None:
    features = None if isinstance(prediction, DenseFeatures) else prediction.features
    if features is not None and not np.isfinite(features).all():
        row = int(np.flatnonzero(~np.isfinite(features).all(axis=1))[0])
        return f"'features' has values that are NaN or infinite, first in row {row}"
    if isinstance(prediction, Instances):
        falls = (np.diff(prediction.owners) == 0) & (np.diff(prediction.indices.astype(np.int64)) <= 0)
        if falls.any():
            owner = prediction.owner_at(int(np.flatnonzero(falls)[0]))
            return f"the mask of instance {owner} is not ascending, or has a point twice"
    return None


# ---- where user-defined datasets and methods return values

LAST_FOLDER = "_su3d_last_folder"  # attribute of an object: the working directory that it changed to
NUMPY: dict[type, type] = {int: np.integer, bool: np.bool_}  # accepted in place of Python's own types


@cache
def _answers(kind: str) -> dict[str, Any]:
    """The annotated return type of each function and property of a dataset or method, optional ones included."""
    members = {name: member for each in (INTERFACES[kind], *ABILITIES[kind]) for name, member in vars(each).items()}
    functions = {name: getattr(member, "fget", member) for name, member in members.items() if name[0] != "_"}
    return {name: get_type_hints(one)["return"] for name, one in functions.items() if inspect.isfunction(one)}


def is_built_in(plug_in: type) -> bool:
    return plug_in.__module__.startswith("su3d_bench.")


def settings_model(plug_in: type, name: str) -> type[BaseModel]:
    """The settings model that a class has under ``name``."""
    model: Any = getattr(plug_in, name)
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        raise PlugInError(f"{place_of(plug_in)}.{name} is {_kind_of(model)}; expected a pydantic.BaseModel")
    return model


def made(plug_in: type, *words: Any) -> Any:
    """An object of the class; an argument that its ``__init__`` rejects is reported with its line."""
    if is_built_in(plug_in):
        return plug_in(*words)
    function = plug_in.__init__  # type: ignore[misc]
    last: list[str] = []
    with user_folder(last, waits=True):
        built = _called(place_of(plug_in, "__init__", function), plug_in, words, {})
    with suppress(AttributeError):
        object.__setattr__(built, LAST_FOLDER, last)
    return built


def checked_dataset(dataset: Any) -> Any:
    """``dataset``; the return values of a user-defined one are checked from now on."""
    return dataset if is_built_in(type(dataset)) else _watched(dataset, "dataset")


def checked_method(method: Any) -> Any:
    """``method``; the return values of a user-defined one are checked from now on."""
    if is_built_in(type(method)):
        return method
    attribute_of(method, "needs")
    return _watched(method, "method")


def attribute_of(method: Any, name: str, without: Any = None) -> Any:
    """The property ``name`` of a method; ``without`` if it has none."""
    value = _called(name, getattr, (method, name, without), {})
    if not is_built_in(type(method)) and hasattr(method, name):
        known = inspect.getattr_static(type(method), name, None)
        place = place_of(type(method), name, known.fget if isinstance(known, property) else known)
        _validated(place, value, _answers("method")[name])
    return value


def place_of(plug_in: type, name: str = "", function: Any = None) -> str:
    """``my_method.py:12: MyMethod.name``: where a user-defined class, or its ``function``, is defined."""
    code: CodeType | None = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    where = ""
    if code is not None:
        where = f"{Path(code.co_filename).name}:{code.co_firstlineno}: "
    else:
        with suppress(OSError, TypeError):
            where = f"{Path(inspect.getfile(plug_in)).name}:{inspect.getsourcelines(plug_in)[1]}: "
    return printable(f"{where}{plug_in.__name__}{f'.{name}' if name else ''}", 300)


def _watched(plug_in: Any, kind: str) -> Any:
    for name, answer in _answers(kind).items():
        if callable(getattr(type(plug_in), name, None)):  # not a property, which may not have a value yet
            function = getattr(plug_in, name)
            watching = wraps(function)(partial(_asked, plug_in, name, function, answer))
            with suppress(AttributeError):  # a class with slots is not checked
                object.__setattr__(plug_in, name, watching)
    return plug_in


def _asked(plug_in: Any, name: str, function: Callable[..., Any], answer: Any, *words: Any, **named: Any) -> Any:
    place = place_of(type(plug_in), name, function)
    with user_folder(getattr(plug_in, LAST_FOLDER, [])):
        found = _validated(place, _called(place, function, words, named), answer)
    if name == "frames":
        return _Frames(place, found)
    if name == "digest" and not found:
        raise PlugInError(f"{place} returned an empty text; expected a key that is equal only if the data are")
    for k, entry in enumerate(found if get_origin(answer) is Sequence else ()):
        _validated(f"{place}(...)[{k}]", entry, get_args(answer)[0])
    return found


def _called(place: str, function: Callable[..., Any], words: Sequence[Any], named: Mapping[str, Any]) -> Any:
    """The result of ``function``. Rejected arguments, or values rejected by our own types, raise ``PlugInError``."""
    try:
        return function(*words, **named)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:  # it was never entered
            raise PlugInError(f"{place}: {error}") from error
        raise
    except Su3dError as error:
        is_of_types = traceback.extract_tb(error.__traceback__)[-1].filename in TYPE_FILES
        if is_of_types and not isinstance(error, PlugInError) and (line := user_code_line(error)):
            raise PlugInError(f"{line}: {error}") from error
        raise


def _validated(place: str, found: Any, answer: Any) -> Any:
    """``found`` in its stored form; a ``PlugInError`` if it is not an ``answer`` or has invalid values."""
    if answer in (Any, NoneType):
        return found
    kinds = get_args(answer) if isinstance(answer, UnionType) else (get_origin(answer) or answer,)
    is_listed = hasattr(found, "__len__") and hasattr(found, "__getitem__") and not isinstance(found, str | Mapping)
    will_do = (*kinds, *(NUMPY[kind] for kind in kinds if kind in NUMPY))
    if not (is_listed if kinds == (Sequence,) else isinstance(found, will_do)):
        wanted = " or ".join("None" if kind is NoneType else kind.__name__ for kind in kinds)
        raise PlugInError(f"{place} returned {_kind_of(found)}; expected {wanted}")
    found = in_stored_form(found)
    if (fault := validation_error(found)) is not None:
        raise PlugInError(f"{place}: {fault}")
    return found


class _Frames(Sequence[Frame]):
    """User-defined frames, each checked when it is read."""

    def __init__(self, place: str, frames: Sequence[Frame]) -> None:
        self._place = place
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, k: Any) -> Any:
        place = f"{self._place}(...)[{k}]"
        return _validated(place, _called(place, self._frames.__getitem__, (k,), {}), Frame)


def _kind_of(value: Any) -> str:
    return "a class" if isinstance(value, type) else "None" if value is None else f"a {type(value).__name__}"
