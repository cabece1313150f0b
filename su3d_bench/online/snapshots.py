"""Maps of a session: computed at once, or in a forked process while updates go on."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from su3d_bench.core.errors import StoreError, error_line
from su3d_bench.core.files.atomic import TemporaryFolder, write_text
from su3d_bench.core.interfaces import Method
from su3d_bench.core.maps import Prediction
from su3d_bench.core.system.files import file_text
from su3d_bench.store.predictions import read_prediction, write_prediction

logger = logging.getLogger(__name__)
NICENESS = 19  # of the process that computes a map: updates go first


@dataclass(frozen=True)
class AsOf:
    """Indices of the last frame in the map's geometry, and of the last one with detections, whose features it has."""

    geometry: int | None = None
    features: int | None = None


@dataclass(frozen=True)
class Snapshot:
    """The map after some updates, and the frames that it contains."""

    prediction: Prediction
    as_of: AsOf


def as_of_map(method: Method, pushed: AsOf) -> AsOf:
    """The frames in the last map of ``method`` after these were pushed: a method may state that it is behind."""
    last = getattr(method, "as_of", None)
    return pushed if last is None else replace(pushed, geometry=last)


class PendingSnapshot:
    """A map as it is now, computed while updates go on; get it with ``result`` before the session is closed.

    A fork shares the memory of the map: the system copies only what updates change. If that is not possible, the map is
    computed at once, and ``reason_for_blocking`` says why; otherwise it is None.
    """

    def __init__(self, method: Method, as_of: AsOf) -> None:
        self.as_of = as_of
        self.reason_for_blocking: str | None = None
        self._name = method.name
        self._answer: Snapshot | StoreError | None = None
        self._process = 0
        if sys.platform != "linux":
            self.reason_for_blocking = "only on Linux a process with threads can be forked safely"
        elif not getattr(method, "finishes_in_fork", False):
            self.reason_for_blocking = f"{method.name} cannot compute a map in another process"
        self._folder = TemporaryFolder("su3d-snapshot-")
        self._map, self._message = self._folder.path / "map.npz", self._folder.path / "error.txt"
        if self.reason_for_blocking is not None:
            logger.info("snapshot: computed at once: %s", self.reason_for_blocking)
            write_prediction(self._map, method.finish())  # the map itself may have views of what updates change
            self.as_of = as_of_map(method, as_of)
            return
        with suppress(OSError, AttributeError):  # glibc only
            ctypes.CDLL(None).malloc_trim(0)  # memory that is free need not be copied when updates use it again
        with warnings.catch_warnings():  # Python 3.12 warns if there are other threads; ``finish`` needs none of them
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process = os.fork()
        if self._process == 0:
            _compute(method, self._map, self._message)

    @property
    def is_done(self) -> bool:
        """Whether ``result`` need not wait for the map to be computed."""
        self._wait(os.WNOHANG)
        return self._process == 0

    @property
    def is_collected(self) -> bool:
        """Whether ``result`` was called, or need not be."""
        return self._answer is not None

    def result(self) -> Snapshot:
        """The map, after waiting for it; ``StoreError`` if it could not be computed."""
        if self._answer is None:
            self._wait(0)
            self._answer = self._read()
            self._folder.close()
        if isinstance(self._answer, StoreError):
            raise self._answer
        return self._answer

    def cancel(self) -> None:
        """End the computation unless its result was read."""
        if self._answer is None:
            if not self.is_done:
                os.kill(self._process, signal.SIGKILL)
                self._wait(0)
            self._answer = StoreError(f"snapshot of {self._name}: its session was closed before it was read")
            self._folder.close()

    def _wait(self, options: int) -> None:
        if self._process:
            ended = True
            with suppress(ChildProcessError):  # collected elsewhere, such as by a handler of SIGCHLD
                ended = bool(os.waitpid(self._process, options)[0])
            self._process = 0 if ended else self._process

    def _read(self) -> Snapshot | StoreError:
        try:
            if self._message.exists():
                return StoreError(f"snapshot of {self._name}: {file_text(self._message)}")
            if not self._map.exists():
                return StoreError(f"snapshot of {self._name}: its process died; is there too little memory?")
            return Snapshot(read_prediction(self._map), self.as_of)
        except StoreError as error:
            return error


def _compute(method: Method, path: Path, message: Path) -> None:
    """Write the map to ``path``, or the reason why not to ``message``, and end this process."""
    try:
        os.nice(NICENESS)
        write_prediction(path, method.finish())
    except BaseException as error:  # noqa: BLE001  (the parent raises it)
        write_text(message, error_line(error))
    finally:
        os._exit(0)  # without the caller's clean-up
