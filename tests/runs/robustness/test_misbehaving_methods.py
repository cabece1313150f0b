"""Whatever a user-defined method does, only its scene fails, with file and line."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.system.signals import Terminated, is_interrupt

pytestmark = pytest.mark.usefixtures("painted_place")
ENDS = (
    ("sys.exit(0)", "1"),
    ("sys.exit(0)", "2"),
    ("raise KeyboardInterrupt", "1"),
    ("raise type('Odd', (BaseException,), {'__str__': lambda error: sys.exit(0)})", "2"),
)
METHOD = """
import os, signal, sys
import numpy as np
from pydantic import BaseModel
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import PerceptionNeeds

class Mine:
    name = "mine"
    needs = PerceptionNeeds(masks="none")

    class Config(BaseModel):
        stride: int = 1

    def __init__(self, config):
        pass

    def start(self, scene):
        if scene.scene == "b":
            ACT

    def update(self, frame, detections, timer):
        pass

    def finish(self):
        return Instances.of(np.array([[1, 1, 2]], np.float32), np.zeros(1, int), names=["chair"], labels=("chair",))
"""


def run(act: str, *more: str, out: str = "out") -> int:
    Path("mine.py").write_text(METHOD.replace("ACT", act))
    words = ["run", f"{SCENES}/painted.py:Painted/[ab]", "--methods", "mine.py:Mine", "--protocols", "rooms-semantic"]
    return main([*words, "--no-pictures", "--set", "painted.n_frames=2", "--out", out, *more])


@pytest.mark.parametrize(("act", "jobs"), ENDS)
def test_only_the_scene_fails_where_a_method_ends_the_program(
    act: str, jobs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(act, "--jobs", jobs) == 3
    answer = capsys.readouterr()
    assert "painted/b: mine.py:20: " in answer.err and "1 of 2 scenes failed" in answer.err
    assert Path("out/scenes/painted.a/mine/counts.npz").is_file() and Path("out/metrics.json").is_file()


def test_interrupt_of_the_user_still_ends_the_run() -> None:
    assert run("signal.raise_signal(signal.SIGINT)", "--jobs", "1") == 130
    assert is_interrupt(KeyboardInterrupt()) and is_interrupt(Terminated(signal.SIGTERM))  # also in a notebook


def test_method_that_changes_the_folder_and_prints_loses_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    act = "print('printed'); os.system('echo by a program >&2'); os.chdir('/')"
    assert run(act, "--jobs", "1", "--json") == 0
    answer = capfd.readouterr()
    assert json.loads(answer.out)["results"] and "printed" in answer.err
    assert Path("out/scenes/painted.b/mine/counts.npz").is_file() and Path("out/metrics.json").is_file()
