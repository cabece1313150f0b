"""Run original code unmodified: Python 2 converted to Python 3, removed numpy names restored, no GPU."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from su3d_bench.metrics.protocols.model import ProtocolRules

Problem = Any  # of a family of originals; numbers are one array (N,), NaN where undefined
Ask = Callable[[Problem], "np.ndarray"]
STOPS = (
    ArithmeticError,
    LookupError,
    NameError,
    RuntimeError,
    TypeError,
    ValueError,
)  # errors with which an original ends at some problems
DROPPED = {"float": float, "int": int, "bool": bool, "in1d": lambda a, b: np.isin(np.ravel(a), b)}


@dataclass(frozen=True)
class Original:
    """An evaluator: the ``protocols`` that it covers and its ``file`` in a checkout.

    ``start(rules, checkout, folder)`` returns a function to query it; ``drawn(seed, index)`` a problem,
    ``ours(rules, problem)`` this program's answer, ``keep(rules, ask, seed, n)`` stores ``n`` answers in the cases.
    """

    protocols: tuple[str, ...]
    file: str
    start: Callable[[ProtocolRules, Path, Path], Ask]
    drawn: Callable[[int, int], Problem]
    ours: Callable[[ProtocolRules, Problem], np.ndarray]
    keep: Callable[[ProtocolRules, Ask, int, int], None]


class _Unused:
    """Stand-in for a module that an original imports and never calls."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, *words: Any, **named: Any) -> Any:
        raise AssertionError(f"the original calls {self._name}, which is not installed here")


class _StandIn(types.ModuleType):
    __path__: list[str] = []  # noqa: RUF012 - that of a package, so that its parts can be imported

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Unused(f"{self.__name__}.{name}")


def load(
    file: Path,
    roots: Sequence[Path],
    words: Sequence[str] = (),
    absent: Sequence[str] = (),
    replaced: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> types.ModuleType:
    """The module in ``file``, imported with ``roots`` on the path and ``words`` as its command line.

    ``absent``: modules that are imported but never called; stand-ins replace those not installed.
    ``replaced``: modules that need something unavailable, such as a GPU, and their replacements.
    """
    for name, value in DROPPED.items():
        if not hasattr(np, name):
            setattr(np, name, value)
    sys.path[:0] = [str(root) for root in roots]
    for name in absent:
        _stand_in(name)
    for name, original in replaced.items():
        _stand_in(name)
        sys.modules[name] = _StandIn(name)
        vars(sys.modules[name]).update(original)
    before, sys.argv = sys.argv, [str(file), *words]
    try:
        spec = importlib.util.spec_from_file_location(f"original_{file.stem}", file)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
    finally:
        sys.argv = before


def _stand_in(name: str) -> None:
    for end in range(1, name.count(".") + 2):
        part = ".".join(name.split(".")[:end])
        if part not in sys.modules and not _is_installed(part):
            sys.modules[part] = _StandIn(part)


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def of_python_3(folder: Path, copy: Path) -> Path:
    """A copy of the Python files of a folder, only converted from Python 2 by lib2to3."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from lib2to3.refactor import RefactoringTool, get_fixers_from_package

        fixers = [
            one for one in get_fixers_from_package("lib2to3.fixes") if "itertools" not in one
        ]  # requested in both forms
        tool = RefactoringTool(fixers)
        for file in folder.rglob("*.py"):
            text = file.read_text() + "\n"
            target = copy / file.relative_to(folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(Exception):  # some are Python 3 already
                text = str(tool.refactor_string(text, str(file)))
            target.write_text(text)
    return copy


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Suppress the output of an original."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def recorded(module: types.ModuleType | type, name: str) -> list[Any]:
    """Record the results of the function ``name`` of a module or class, which otherwise works as before."""
    whole: Callable[..., Any] = getattr(module, name)
    answers: list[Any] = []

    def recording(*words: Any, **named: Any) -> Any:
        answers.append(whole(*words, **named))
        return answers[-1]

    setattr(module, name, recording)
    return answers


def without_gpu() -> None:
    """Make ``.cuda()`` of torch return the tensor itself."""
    import torch

    torch.Tensor.cuda = lambda self, *_, **__: self  # type: ignore[method-assign, assignment, misc]
