"""Frames are read ahead in order; a disposable method is fed a synthetic frame before timing starts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import pytest
from waiting import wait_until

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import UsesSceneTools
from su3d_bench.runs.frame_loop import ReadAhead, warm_up

N_FRAMES = 40


class Watched(Sequence[int]):
    """Frames, each equal to its position, whose reads are recorded; ``read`` is called before a frame is returned."""

    def __init__(self, read: Callable[[int], object] = lambda _: None) -> None:
        self.begun: list[int] = []
        self._read = read

    def __len__(self) -> int:
        return N_FRAMES

    def __getitem__(self, position: int) -> int:  # type: ignore[override]
        self.begun.append(position)
        self._read(position)
        return position


def threads() -> int:
    return sum(one.name.startswith("read-ahead") for one in threading.enumerate())


def settle(ahead: ReadAhead[int]) -> None:
    """Wait until all submitted reads that a free thread would run have begun."""
    ahead._threads.submit(int).result(10)


def test_frames_arrive_in_order_however_long_each_takes() -> None:
    is_read = [threading.Event() for _ in range(N_FRAMES)]

    def read(position: int) -> None:
        if position % 2 and position + 1 < N_FRAMES:
            assert is_read[position + 1].wait(10)
        is_read[position].set()

    with ReadAhead(Watched(read), N_FRAMES, n_threads=4, n_ahead=8) as ahead:
        assert [ahead.next_frame() for _ in range(N_FRAMES)] == list(range(N_FRAMES))


def test_no_more_frames_are_read_ahead_than_allowed() -> None:
    frames = Watched()
    with ReadAhead(frames, N_FRAMES, n_ahead=3) as ahead:
        for n_taken in range(1, 10):
            ahead.next_frame()
            wait_until(lambda n=n_taken: len(frames.begun) == n + 3)  # type: ignore[misc]
            settle(ahead)
            assert len(frames.begun) == n_taken + 3


def test_broken_frame_fails_when_requested_and_not_before() -> None:
    def read(position: int) -> None:
        if position == 2:
            raise DataError("frame 2: broken")

    with ReadAhead(Watched(read), N_FRAMES) as ahead:
        assert [ahead.next_frame() for _ in range(2)] == [0, 1]
        with pytest.raises(DataError, match="frame 2: broken"):
            ahead.next_frame()
        assert ahead.next_frame() == 3


@pytest.mark.parametrize("n_taken", [0, 1, 7, N_FRAMES])
def test_leaving_early_ends_the_threads_and_stops_reading(n_taken: int) -> None:
    frames = Watched()
    with ReadAhead(frames, N_FRAMES) as ahead:
        for _ in range(n_taken):
            ahead.next_frame()
    assert threads() == 0
    n_begun = len(frames.begun)
    assert n_begun <= min(n_taken + 2, N_FRAMES)
    assert len(frames.begun) == n_begun


WARMED = [name for name in registry.METHODS if getattr(registry.load("method", name), "warms_up", False)]


@pytest.mark.parametrize("name", WARMED)
def test_warm_up_frame_runs_every_step(name: str) -> None:
    # Keeps the map. A separate class, because ``isinstance`` results for the method's own class would be cached.
    method = type("Kept", (registry.load("method", name),), {"close": lambda self: None})()
    warm_up(method)
    assert method.n_points > 0
    assert not isinstance(method, UsesSceneTools) or vars(method)["_tools"] is None
