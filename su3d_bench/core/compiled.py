"""Numba's ``njit`` with a safe kernel cache on disk.

``numba.njit(cache=True)`` alone reuses a kernel whose imported kernels have changed, so numbers come from old code; it
ends with a traceback if its files were damaged by a power cut, and fails on import if no folder is writable.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from contextlib import suppress
from functools import cache as remembered
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from su3d_bench.core.digests import digest_file
from su3d_bench.core.files.atomic import DAMAGE

_digest = remembered(digest_file)
UNREADABLE: tuple[type[Exception], ...] = (*DAMAGE, LookupError, AttributeError, ImportError, pickle.UnpicklingError)


class RepairingCache(FunctionCache):
    """Numba's cache of one function; an unreadable entry is compiled again, one that cannot be stored is used once.

    Numba renames what it writes but does not sync the disk: after a power cut its files may contain anything. It also
    checks only the function's own file; here a change in a file with imported compiled functions counts too.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        if imported := imported_sources(function):
            stamp = (self._impl.locator.get_source_stamp(), *map(_digest, imported))
            self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, stamp)  # type: ignore[no-untyped-call]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except UNREADABLE:
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


def imported_sources(function: Callable[..., Any]) -> list[Path]:
    """The files of the compiled functions that the file of ``function`` imports, directly or indirectly."""
    own = function.__code__.co_filename
    sources, waiting = {own}, [function]
    while waiting:
        for value in list(waiting.pop().__globals__.values()):
            if isinstance(value, Dispatcher) and value.py_func.__code__.co_filename not in sources:
                sources.add(value.py_func.__code__.co_filename)
                waiting.append(value.py_func)
    return sorted(Path(name) for name in sources - {own})


def njit(*, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit``, with this cache if ``cache`` is true and a folder is writable."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if cache:
            with suppress(RuntimeError, OSError):  # no writable cache folder, or no source file
                dispatcher._cache = RepairingCache(function)
        return dispatcher

    return compiled
