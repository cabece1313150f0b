"""Frames in their order, read by threads before they are asked for."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Self, TypeVar

Read = TypeVar("Read")
N_THREADS = 2
N_AHEAD = 2  # frames in memory besides the one in use


class ReadAhead(Generic[Read]):
    """The first ``n`` of ``frames`` one after another, at most ``n_ahead`` of them read before they are asked for.

    What reading a frame raises is raised when that frame is asked for, not before. The first frame is read alone: what
    a dataset makes at its first use is made once. Leaving the block, at whatever frame, ends the threads; reads that
    have begun are waited for. ``n_ahead`` 0: each frame is read when it is asked for.
    """

    def __init__(self, frames: Sequence[Read], n: int, *, n_threads: int = N_THREADS, n_ahead: int = N_AHEAD) -> None:
        self._frames, self._n = frames, n
        self._n_ahead = n_ahead
        self._n_begun = 0
        self._reading: deque[Future[Read]] = deque()
        self._threads = ThreadPoolExecutor(n_threads, thread_name_prefix="read-ahead")

    def __enter__(self) -> Self:
        self._begin_up_to(min(1, self._n_ahead))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._threads.shutdown(cancel_futures=True)
        self._reading.clear()

    def next_frame(self) -> Read:
        """The frame after the one that was taken last."""
        self._begin_up_to(1)
        frame = self._reading.popleft().result()
        self._begin_up_to(self._n_ahead)
        return frame

    def _begin_up_to(self, n_waiting: int) -> None:
        while self._n_begun < self._n and len(self._reading) < n_waiting:
            self._reading.append(self._threads.submit(self._frames.__getitem__, self._n_begun))
            self._n_begun += 1
