"""Small programs as a method, fed with three painted frames, for tests."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import Painted

from su3d_bench.baselines.command.method import Command, CommandConfig
from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.interfaces import SceneTools
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Frame, SceneInfo, Surface
from su3d_bench.runs.frame_loop import no_detections

SCENE = SceneInfo("rooms", "a b", 6, 1, "rendered-rooms", seed=7)
SURFACE = Surface(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [3, 0, 0]], np.float32),
    np.array([[0, 1, 2], [0, 1, 3]], np.int32),
)
# Two masks over five vertices as ScanNet's text has them, with the class ids of chair and wall in the rooms.
MASKS = """
import os, sys
out = sys.argv[1]
os.mkdir(out + "/masks")
open(out + "/scene.txt", "w").write("masks/0.txt 20 0.9\\nmasks/1.txt 93 0.5\\n")
open(out + "/masks/0.txt", "w").write("1\\n1\\n0\\n0\\n0\\n")
open(out + "/masks/1.txt", "w").write("0\\n0\\n0\\n1\\n1\\n")
"""


def frames(n: int = 3) -> list[Frame]:
    dataset = Painted(Path(), Painted.Options(n_frames=n))
    return list(dataset.frames("a", 1))


def program(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "program.py"
    path.write_text(text)
    return path


def method(tmp_path: Path, text: str, *words: str, surface: Surface | None = SURFACE, **config: Any) -> Command:
    """The method around the Python program ``text``, fed with three frames."""
    command = (sys.executable, str(program(tmp_path, text)), *(words or ("{output}",)))
    return fed(Command(CommandConfig(command=command, **config)), surface)


def fed(
    one: Command,
    surface: Surface | None = SURFACE,
    shots: Sequence[Frame] | None = None,
    scene: SceneInfo = SCENE,
) -> Command:
    def give() -> Surface:
        if surface is None:
            raise DataError("rooms/a b: the dataset has no mesh")
        return surface

    shots = frames() if shots is None else shots
    one.receive_tools(SceneTools(shots, None, give))  # type: ignore[arg-type]
    one.start(scene)
    for frame in shots:
        one.update(frame, no_detections(frame, one.needs), Timer())
    return one


def refused(one: Command) -> str:
    with pytest.raises(PredictionError) as caught:
        one.finish()
    text = str(caught.value)
    assert "\n" not in text
    assert "\x1b" not in text
    assert len(text) < 700
    one.close()
    return text
