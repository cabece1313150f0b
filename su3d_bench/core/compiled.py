"""Numba's ``njit`` for kernels kept on disk.

``numba.njit(cache=True)`` alone keeps a kernel whose imported kernels have changed, which gives numbers of old code,
ends with a traceback where its files were damaged by a power cut, and refuses to import where no folder can be written.
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
MAX_WAIT_S = 60.0  # for another process that compiles the same function; then it is compiled here too
UNREADABLE: tuple[type[Exception], ...] = (*DAMAGE, LookupError, AttributeError, ImportError, pickle.UnpicklingError)


class RepairingCache(FunctionCache):
    """Numba's own store of one function; what cannot be read is compiled again, what cannot be kept is used once.

    Numba renames what it writes, but does not wait for the disk: after a power cut its files may hold anything. And it
    looks at the function's own file alone: here a change in one from which that imports compiled functions counts too.
    Of processes that start together one compiles and the others wait for it: from a fresh clone that saves the demo a
    tenth of its processor time.
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
        """Waits until no other process compiles this function; whether the wait was worth a second look."""
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
    """The files of the compiled functions that the file of ``function`` has imported, and of those that these have."""
    own = function.__code__.co_filename
    sources, waiting = {own}, [function]
    while waiting:
        for value in list(waiting.pop().__globals__.values()):
            if isinstance(value, Dispatcher) and value.py_func.__code__.co_filename not in sources:
                sources.add(value.py_func.__code__.co_filename)
                waiting.append(value.py_func)
    return sorted(Path(name) for name in sources - {own})


def njit(*, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with such a store where ``cache``, and none where no folder can be written."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if cache:
            with suppress(RuntimeError, OSError):  # no place for it, beside the module or elsewhere, or no source
                dispatcher._cache = RepairingCache(function)
        return dispatcher

    return compiled
