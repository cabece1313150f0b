"""Frames that can only be read from first to last, asked for by their numbers from several threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from threading import Lock
from typing import Generic, TypeVar

Item = TypeVar("Item")
N_KEPT = 12  # wanted items that were passed; as many threads may ask out of their order before all begins anew


class ForwardReader(Generic[Item]):
    """``begin`` opens what is read; each step of it gives a function that unpacks the item, called for those wanted."""

    def __init__(self, begin: Callable[[], Iterator[Callable[[], Item]]], wanted: frozenset[int]) -> None:
        self._begin, self._wanted = begin, wanted
        self._steps: Iterator[Callable[[], Item]] | None = None
        self._next = 0
        self._kept: dict[int, Item] = {}
        self._lock = Lock()

    def at(self, number: int) -> Item | None:
        """The item of that number; None where there are fewer."""
        with self._lock:
            if number in self._kept:
                return self._kept[number]
            if self._steps is None or number < self._next:
                self._steps, self._next = self._begin(), 0
            try:
                return self._passed(self._steps, number)
            except BaseException:
                self._steps = None
                raise

    def _passed(self, steps: Iterator[Callable[[], Item]], number: int) -> Item | None:
        while self._next <= number:
            unpack = next(steps, None)
            if unpack is None:
                self._steps = None
                return None
            if self._next in self._wanted or self._next == number:
                self._kept[self._next] = unpack()
                if len(self._kept) > N_KEPT:
                    del self._kept[next(iter(self._kept))]
            self._next += 1
        return self._kept[number]
