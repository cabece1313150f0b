"""The reference pipeline as a method that refuses to give a map which the paper's text does not give."""

from __future__ import annotations

from literal_paper import PaperProgram
from literal_problems import differences, settings_of

from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Detections, Frame, SceneInfo
from su3d_bench.opensu3d.pipeline import OpenSU3D


class SideBySide(OpenSU3D):
    """OpenSU3D beside ``PaperProgram``, frame by frame."""

    name = "side-by-side"
    warms_up = False

    def start(self, scene: SceneInfo) -> None:
        super().start(scene)
        self._program = PaperProgram(settings_of(self.config))

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        super().update(frame, detections, timer)
        self._program.add_image(frame, detections)
        assert (self.n_points, self.n_instances) == (len(self._program.scene.points), len(self._program.tracks))

    def finish(self) -> Instances:
        found = super().finish()
        lines = differences(found, self._program)
        assert not lines, "; ".join(lines)
        return found
