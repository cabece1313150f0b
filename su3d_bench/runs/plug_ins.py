"""Datasets and methods of others, checked where they answer: what is wrong is told with their file and their line."""

from __future__ import annotations

import inspect
import sysconfig
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial, wraps
from pathlib import Path
from types import CodeType
from typing import Any

from su3d_bench.core.errors import MOST_CHARACTERS, ConfigError, DataError, PredictionError, Su3dError, printable
from su3d_bench.core.types import (
    DenseFeatures,
    Frame,
    GroundTruth,
    InstanceMesh,
    Instances,
    Partition,
    PerceptionNeeds,
    SceneInfo,
)
from su3d_bench.store.predictions import array_fault, prediction_arrays

PACKAGE = Path(__file__).resolve().parents[1]
# The code of the program and of what is installed; what lies elsewhere, or is named here by no file, is somebody's own.
NOT_THEIRS = tuple(
    str(folder)
    for folder in (
        PACKAGE,
        *(link.resolve() for link in PACKAGE.iterdir() if link.is_dir()),
        *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    )
)
# What each of their functions must give. A sequence has a length and gives its k-th.
OF_DATASETS: dict[str, tuple[type, ...]] = {
    "scenes": (Sequence,),
    "files": (Sequence,),
    "digest": (str,),
    "info": (SceneInfo,),
    "frames": (Sequence,),
    "ground_truth": (GroundTruth,),
    "instance_mesh": (InstanceMesh,),
}
OF_METHODS: dict[str, tuple[type, ...]] = {"finish": (Instances, Partition, DenseFeatures)}


def is_ours(plug_in: type) -> bool:
    return plug_in.__module__.startswith("su3d_bench.")


def checked_dataset(dataset: Any) -> Any:
    """``dataset``; one of somebody's own checks from now on what it gives."""
    return dataset if is_ours(type(dataset)) else _watched(dataset, OF_DATASETS, DataError)


def checked_method(method: Any) -> Any:
    """``method``; one of somebody's own checks from now on what it gives."""
    if is_ours(type(method)):
        return method
    needs = inspect.getattr_static(type(method), "needs", None)
    _expect(
        method,
        "needs",
        needs.fget if isinstance(needs, property) else None,
        method.needs,
        (PerceptionNeeds,),
        ConfigError,
    )
    return _watched(method, OF_METHODS, PredictionError)


def own_line(error: BaseException) -> str:
    """``my_method.py:12``: the deepest line of somebody's own file that ``error`` passed through; empty without one."""
    if isinstance(error, SyntaxError) and error.filename and not error.filename.startswith(NOT_THEIRS):
        return printable(f"{Path(error.filename).name}:{error.lineno}", 200)
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        if not file.startswith((*NOT_THEIRS, "<")):
            return printable(f"{Path(file).name}:{line}", 200)
    return ""


def error_line(error: BaseException) -> str:
    """One line for any error; one that is not ours says its type, and where in somebody's own file it arose."""
    text = printable(str(error), MOST_CHARACTERS)
    if isinstance(error, MemoryError):
        return f"out of memory ({text or 'no details'}); try fewer --jobs, or a machine with more"
    if isinstance(error, Su3dError):
        return text
    place = own_line(error)
    return f"{place}{': ' if place else ''}{type(error).__name__}: {text}"


def _watched(plug_in: Any, expected: dict[str, tuple[type, ...]], error: type[Su3dError]) -> Any:
    for name, kinds in expected.items():
        function = getattr(plug_in, name)
        with suppress(AttributeError):  # of a class with slots, which then answers unwatched
            object.__setattr__(plug_in, name, wraps(function)(partial(_asked, plug_in, name, function, kinds, error)))
    return plug_in


def _asked(
    plug_in: Any, name: str, function: Callable[..., Any], kinds: tuple[type, ...], error: type[Su3dError], *words: Any
) -> Any:
    found = function(*words)
    _expect(plug_in, name, function, found, kinds, error)
    if name == "frames":
        return _Frames(plug_in, function, found, error)
    if isinstance(found, Instances | Partition | DenseFeatures) and (fault := array_fault(prediction_arrays(found))):
        raise error(f"{_place(plug_in, name, function)}: {fault}")
    return found


class _Frames(Sequence[Frame]):
    """Frames of somebody's own, each checked when it is read."""

    def __init__(
        self, plug_in: Any, function: Callable[..., Any], frames: Sequence[Frame], error: type[Su3dError]
    ) -> None:
        self._place = plug_in, function, error
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, k: Any) -> Any:
        frame = self._frames[k]
        plug_in, function, error = self._place
        _expect(plug_in, "frames(...)[k]", function, frame, (Frame,), error)
        return frame


def _expect(
    plug_in: Any, name: str, function: Any, found: Any, kinds: tuple[type, ...], error: type[Su3dError]
) -> None:
    is_sequence = kinds == (Sequence,)
    fits = (hasattr(found, "__len__") and hasattr(found, "__getitem__")) if is_sequence else isinstance(found, kinds)
    if not fits or (is_sequence and isinstance(found, str)):
        wanted = "a sequence" if is_sequence else " or ".join(f"a {kind.__name__}" for kind in kinds)
        given = "None" if found is None else f"a {type(found).__name__}"
        raise error(f"{_place(plug_in, name, function)} gave {given}; {wanted.replace('a I', 'an I')} is expected")


def _place(plug_in: Any, name: str, function: Any) -> str:
    code: CodeType | None = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    where = "" if code is None else f"{Path(code.co_filename).name}:{code.co_firstlineno}: "
    return printable(f"{where}{type(plug_in).__name__}.{name}", 300)
