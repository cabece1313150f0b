"""One scene with a program that gets it frame by frame: what it is asked, and what its answers must be."""

from __future__ import annotations

import shutil
import stat
import struct
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from su3d_bench.baselines.command import pipes
from su3d_bench.baselines.command.pipes import PipedProgram
from su3d_bench.core.errors import PredictionError, printable
from su3d_bench.core.files.state import ARRAYS, VALUES, read_state, write_state
from su3d_bench.core.types import Float64Array, Frame, SceneInfo, Surface

FRAME = struct.Struct("<qdII9d16d")  # number, seconds, width, height, intrinsics, pose; then depth and colour
POSE = struct.Struct("<q16d")  # number of the frame, and its new pose
OWN_FILES = (ARRAYS, VALUES)  # of a saved state; all others are the program's
FORMS = {"vertices": "f4 V 3", "triangles": "i4 T 3"}


class SceneProgram:
    """A program on one scene.

    ``folders`` are those of the program, ``places`` the same as it sees them, which differ in a container.
    """

    def __init__(self, piped: PipedProgram, scene: SceneInfo, folders: dict[str, Path], places: dict[str, str]) -> None:
        self.piped, self._folders, self._places = piped, folders, places
        self._values = {one.name: getattr(scene, one.name) for one in fields(scene) if one.compare}
        self._numbers: list[int] = []
        self._n_folders = 0

    def start(self) -> None:
        """Describe the scene to the program."""
        lines = [f"{name} {printable(str(value))}" for name, value in self._values.items()]
        has_mesh = (self._folders["frames"] / "mesh.ply").is_file()
        lines += [f"version {pipes.VERSION}", f"mesh {self._places['frames'] + '/mesh.ply' if has_mesh else ''}"]
        version = self.piped.ask(pipes.HELLO, "start", "\n".join(lines).encode())
        if version != str(pipes.VERSION):
            raise PredictionError(f"start: the program uses version '{version}' of the messages, not {pipes.VERSION}")

    def send(self, frame: Frame) -> None:
        """Give the program a frame."""
        height, width = frame.depth_m.shape
        matrices = (*frame.intrinsics.ravel(), *frame.camera_to_world.ravel())
        head = FRAME.pack(frame.index, frame.timestamp_s, width, height, *matrices)
        images = (np.ascontiguousarray(image).data for image in (frame.depth_m, frame.rgb))
        self.piped.ask(pipes.FRAME, f"frame {frame.index}", head, *images)
        self._numbers.append(frame.index)

    def current_map(self) -> tuple[Path, int | None]:
        """The folder with the program's map of now, and the number of the last frame in it; None without frames."""
        folder, text = self._filled(pipes.SNAPSHOT, "map")
        if text and text not in map(str, self._numbers):
            raise PredictionError(f"map: it is as of frame '{text}', which the program did not get")
        return folder, int(text) if text else next(reversed(self._numbers), None)

    def revise(self, poses: Mapping[int, Float64Array]) -> None:
        """New camera-to-world poses; ``ConfigError`` if the program refuses."""
        rows = b"".join(POSE.pack(number, *pose.ravel()) for number, pose in poses.items())
        self.piped.ask(pipes.REVISE, "revise", rows)

    def save(self, folder: Path, surface: Surface | None) -> None:
        """Write the program's state and what starts it again; ``ConfigError`` if the program refuses."""
        state, _ = self._filled(pipes.SAVE, "save")
        for file in sorted(state.iterdir()):
            if file.name in OWN_FILES or not stat.S_ISREG(file.lstat().st_mode):
                name = printable(file.name, 80)
                raise PredictionError(f"save: '{name}' cannot be stored; write plain files, not named as {OWN_FILES}")
            shutil.copyfile(file, folder / file.name, follow_symlinks=False)
        values = {"scene": self._values, "numbers": self._numbers}
        if surface is not None:
            values |= {"vertices": surface.vertices, "triangles": surface.triangles}
        write_state(folder, values)

    def load(self, folder: Path, numbers: list[int]) -> None:
        """Give the program the state that it wrote to ``folder`` after these frames."""
        self._filled(pipes.LOAD, "load", [file for file in folder.iterdir() if file.name not in OWN_FILES])
        self._numbers = numbers

    def _filled(self, kind: int, what: str, files: Iterable[Path] = ()) -> tuple[Path, str]:
        """A new folder with ``files``, given to the program with a request, and the answer."""
        output = self._folders["output"]
        for old in output.iterdir():
            shutil.rmtree(old, ignore_errors=True)
        self._n_folders += 1
        folder = output / f"{what}-{self._n_folders}"
        folder.mkdir()
        for file in files:
            shutil.copyfile(file, folder / file.name)
        text = self.piped.ask(kind, what, f"{self._places['output']}/{folder.name}".encode())
        if folder.is_symlink():  # in a container, to a folder of this machine
            raise PredictionError(f"{what}: its folder was replaced by a link")
        return folder, text


def saved_scene(folder: Path) -> tuple[SceneInfo, list[int]]:
    """The scene of a saved state, and the frames that it has; raises what ``read_state`` raises."""
    values = read_state(folder, FORMS)
    scene = SceneInfo(**values["scene"])
    if "vertices" in values:
        surface = Surface(values["vertices"], values["triangles"])
        scene = replace(scene, read_surface=lambda: surface)
    return scene, [int(number) for number in values["numbers"]]
