"""Numba's ``njit`` with a safe kernel cache on disk.

``numba.njit(cache=True)`` alone reuses a kernel whose imported kernels have changed, so numbers come from old code; it
ends with a traceback if its files were damaged by a power cut, and fails on import if no folder is writable.
"""

from __future__ import annotations

import fcntl
import pickle
from collections.abc import Callable
from contextlib import suppress
from functools import cache as remembered
from pathlib import Path
from time import monotonic, sleep
from typing import IO, Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from su3d_bench.core.digests import digest_file
from su3d_bench.core.files.atomic import DAMAGE

_digest = remembered(digest_file)
MAX_WAIT_S = 60.0  # wait for another process that compiles the same function; after that it is compiled here too
UNREADABLE: tuple[type[Exception], ...] = (*DAMAGE, LookupError, AttributeError, ImportError, pickle.UnpicklingError)


class RepairingCache(FunctionCache):
    """Numba's cache of one function; an unreadable entry is compiled again, one that cannot be stored is used once.

    Numba renames what it writes but does not sync the disk: after a power cut its files may contain anything. It also
    checks only the function's own file; here a change in a file with imported compiled functions counts too.
    If several processes start together, one compiles and the others wait: this saves 10 % of the demo's CPU time in a
    fresh clone.
    """

    _turn: IO[bytes] | None = None

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        if imported := imported_sources(function):
            stamp = (self._impl.locator.get_source_stamp(), *map(_digest, imported))
            self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, stamp)  # type: ignore[no-untyped-call]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = self._loaded(sig, target_context)
        if found is None and self._wait_for_turn():
            found = self._loaded(sig, target_context)  # another process may have compiled it meanwhile
            if found is not None:
                self._end_turn()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        self._end_turn()

    def _loaded(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except UNREADABLE:
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None

    def _wait_for_turn(self) -> bool:
        """Wait until no other process compiles this function; whether the cache should be read again."""
        if self._turn is not None:
            return False
        end = monotonic() + MAX_WAIT_S
        with suppress(OSError):
            self._impl.locator.ensure_cache_path()
            self._turn = Path(self._cache_path, f"{self._impl.filename_base}.lock").open("wb")  # noqa: SIM115
            while monotonic() < end:
                with suppress(BlockingIOError):
                    fcntl.flock(self._turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                sleep(0.05)
        return self._turn is not None

    def _end_turn(self) -> None:
        if self._turn is not None:
            self._turn.close()
            self._turn = None


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
