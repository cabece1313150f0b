"""Numba's ``njit`` for kernels kept on disk, where the place of the kept ones may be damaged, full or closed."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numba
from numba.core.caching import FunctionCache

from su3d_bench.kept_files import DAMAGE


class MendingCache(FunctionCache):
    """Numba's own store of one function; what cannot be read is compiled again, what cannot be kept is used once.

    Numba renames what it writes, but does not wait for the disk: after a power cut its files may hold anything.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except (*DAMAGE, LookupError, AttributeError, ImportError, pickle.UnpicklingError):
            self._forget()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    def _forget(self) -> None:
        with suppress(OSError):
            self.flush()  # type: ignore[no-untyped-call]


def njit(*, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with such a store where ``cache``, and none where no folder can be written."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if cache:
            with suppress(RuntimeError):  # no place for it: neither beside the module nor in the user's cache
                dispatcher._cache = MendingCache(function)  # type: ignore[no-untyped-call]
        return dispatcher

    return compiled
