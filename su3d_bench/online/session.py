"""A method that the caller feeds frame by frame: the same updates as in a run, with maps and queries at any time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, overload

import numpy as np

from su3d_bench.core import interfaces
from su3d_bench.core.arguments import typed
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, error_line
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, SceneInfo
from su3d_bench.online.saved import SessionRecord, load_state, write_session
from su3d_bench.online.snapshots import AsOf, PendingSnapshot, Snapshot, as_of_map
from su3d_bench.perception.profiles import Perception
from su3d_bench.questions.model import RankedInstance, best_of, rank
from su3d_bench.runs.frame_loop import detections_of
from su3d_bench.runs.plugins import validation_error

Place = str | Path
CLOSED = "it is closed"


class Session:
    """One incremental method on one scene; use it from one thread, and in a ``with`` block or with ``close``.

    ``record`` describes it in a folder; with ``saved``, a folder, its state is the one there. ``as_of``: the last
    frames in the map; ``n_updates``: frames pushed.
    """

    def __init__(
        self,
        method: interfaces.Method,
        perception: Perception,
        scene: SceneInfo,
        record: SessionRecord,
        saved: Path | None = None,
    ) -> None:
        self._method, self._perception = method, perception
        self._where = f"{scene.dataset}/{scene.scene}"
        self._record = record
        self._timer = Timer()
        self._latest: Snapshot | None = None  # of the current map, if it was computed
        self._pending: list[PendingSnapshot] = []
        self._fault = ""
        self.n_updates, self.as_of = record.n_updates, AsOf(*record.as_of)
        try:
            if saved is None:
                method.start(scene)
            else:
                load_state(saved, _able_to_save(method), record)
        except BaseException:
            self.close()
            raise

    @typed
    def push(self, frame: Frame, detections: Detections | None = None) -> None:
        """Update the map with one image; without ``detections``, perception makes them as in a run.

        ``detections`` have the crop ratios that the method needs, and the names' features if it needs them. Raises
        ``DataError`` for an invalid frame or detections; the map is then unchanged.
        """
        self._check_usable()
        where, needs = f"{self._where} frame {frame.index}", self._method.needs
        if fault := validation_error(frame):
            raise DataError(f"{where}: {fault}")
        if not (frame.depth_m > 0).any():
            raise DataError(f"{where}: depth is empty (no pixel is above 0 m)")
        if detections is None:
            detections = detections_of(frame, needs, self._perception, self._timer)
        else:
            _check_detections(where, frame, detections, needs)
        try:
            self._method.update(frame, detections, self._timer)
        except BaseException as error:
            self._fault = f"frame {frame.index} failed: {error_line(error)}"  # the map may have half of it
            raise
        finally:
            self._timer.take()
            self._latest = None
        self.n_updates += 1
        self.as_of = AsOf(frame.index, frame.index if len(detections) else self.as_of.features)

    @overload
    def snapshot(self, *, wait: Literal[True] = True) -> Snapshot: ...

    @overload
    def snapshot(self, *, wait: Literal[False]) -> PendingSnapshot: ...

    def snapshot(self, *, wait: bool = True) -> Snapshot | PendingSnapshot:
        """The current map with ``prediction`` and ``as_of``; with ``wait=False`` a handle on it, and updates can go on.

        The prediction may have views of the map, valid until the next ``push``. See ``PendingSnapshot``.
        """
        self._check_usable()
        if not wait:
            self._pending = [one for one in self._pending if not one.is_collected]
            self._pending.append(PendingSnapshot(self._method, self.as_of))
            return self._pending[-1]
        if self._latest is None:
            self._latest = Snapshot(self._method.finish(), as_of_map(self._method, self.as_of))
        return self._latest

    @typed
    def query(self, text: str, *, top: int = 10) -> tuple[RankedInstance, ...]:
        """The ``top`` instances most similar to ``text``, best first, by the encoder of the profile.

        Raises ``PredictionError`` if the map has no instances or no features of that encoder.
        """
        if not text.strip() or top < 1:
            raise ConfigError(f"query: expected a text and at least 1 instance, not '{text}' and {top}")
        prediction = self.snapshot().prediction
        if not isinstance(prediction, Instances):
            raise PredictionError(f"query: a map of {self._method.name} has no instances, so nothing can be ranked")
        return best_of(prediction, rank(prediction, text, self._perception.encoder), top)

    @typed
    def save(self, path: Place) -> None:
        """Store the session in a folder, in place of an earlier one there; ``su3d.session(load=path)`` continues it.

        Raises ``ConfigError`` if the method cannot be saved, ``StoreError`` if the folder cannot be written or has
        other files.
        """
        self._check_usable()
        record = replace(self._record, n_updates=self.n_updates, as_of=astuple(self.as_of))
        write_session(Path(path), _able_to_save(self._method), record)

    @typed
    def revise(self, poses: Mapping[int, Any]) -> None:
        """Move frames after a loop closure: frame index -> camera-to-world pose (4, 4) in metres.

        Raises ``ConfigError`` for a method whose map does not keep frames apart; nothing has changed then.
        """
        self._check_usable()
        if not isinstance(self._method, interfaces.Revises):
            raise ConfigError(f"{self._method.name}: cannot be revised, because its map does not keep frames apart")
        checked = {index: np.asarray(pose, np.float64) for index, pose in poses.items()}
        for index, pose in checked.items():
            if pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise DataError(f"revise: the pose of frame {index} is not a finite 4x4 matrix")
        self._method.revise(checked)
        self._latest = None

    def close(self) -> None:
        """End pending snapshots and release the method's resources; may be called twice."""
        for one in self._pending:
            one.cancel()
        if self._fault != CLOSED and isinstance(self._method, interfaces.Closable):
            self._method.close()
        self._fault = CLOSED

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check_usable(self) -> None:
        if self._fault:
            raise ConfigError(f"session of {self._method.name} on {self._where}: {self._fault}; start another")


def _able_to_save(method: interfaces.Method) -> interfaces.Saves:
    if not isinstance(method, interfaces.Saves):
        raise ConfigError(f"{method.name}: its state cannot be saved (it has no save_state and load_state)")
    return method


def _check_detections(where: str, frame: Frame, detections: Detections, needs: PerceptionNeeds) -> None:
    detections.check_of(frame)
    if detections.crop_ratios != needs.crop_ratios:
        raise DataError(f"{where}: features of crop ratios {detections.crop_ratios}; expected {needs.crop_ratios}")
    if needs.name_features and detections.name_features is None:
        raise DataError(f"{where}: the detections have no name_features, which the method needs")


def check_incremental(method: interfaces.Method) -> None:
    """``ConfigError`` for a method that needs more of the scene than frame after frame."""
    if isinstance(method, interfaces.UsesSceneTools):
        raise ConfigError(f"session: {method.name} works on the whole scene; use su3d.run")
    if isinstance(method, interfaces.UsesGroundTruth):
        raise ConfigError(f"session: {method.name} uses the ground truth, which a session does not have; use su3d.run")
