"""Stage timers: how long each part of an update took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Timer:
    """Collects the milliseconds of each stage of the current update; ``take`` hands them over and starts anew."""

    def __init__(self) -> None:
        self._elapsed_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = (time.perf_counter() - start) * 1e3
            self._elapsed_ms[name] = self._elapsed_ms.get(name, 0.0) + spent

    def take(self) -> dict[str, float]:
        taken, self._elapsed_ms = self._elapsed_ms, {}
        return taken
