"""Client for programs that su3d-bench feeds frame by frame (``frame_by_frame = true``); copy this file, it needs numpy.

    class Mapper:
        def start(self, scene): ...      # a dict of texts: dataset, scene, stride, seed, n_frames, mesh, ...
        def frame(self, frame): ...      # a Frame
        def snapshot(self, folder): ...  # write a prediction to the folder; may return the last frame's number in it

    su3d_client.serve(Mapper())

Optional methods: ``revise(poses)``, ``save(folder)``, ``load(folder)``, ``finish()``. The first three may raise
``Refused``; any other exception ends the program and fails the scene.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

VERSION = 1
HELLO, FRAME, SNAPSHOT, REVISE, SAVE, LOAD, FINISH, OK, REFUSED, ERROR = 1, 2, 3, 4, 5, 6, 7, 100, 101, 102
HEADER = struct.Struct("<4sIQQ")  # magic, kind, number of the request, bytes that follow
FRAME_HEAD = struct.Struct("<qdII")  # number, seconds, width, height; then intrinsics, pose, depth and colour
MAX_REQUEST_BYTES = 1 << 30


class Refused(Exception):
    """The program cannot do this; it continues."""


@dataclass(frozen=True)
class Frame:
    """``rgb`` (H, W, 3) uint8; ``depth_m`` (H, W) float32, 0 for none; ``intrinsics`` (3, 3) and ``camera_to_world``
    (4, 4) float64."""

    number: int
    time_s: float
    intrinsics: NDArray[np.float64]
    camera_to_world: NDArray[np.float64]
    depth_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]


def serve(mapper: Any) -> None:
    """Answer requests until the last one; ``mapper`` has the methods above."""
    pipes = os.environ.get("SU3D_PIPES")
    if pipes is None:
        raise SystemExit("SU3D_PIPES is not set: su3d-bench starts this program, with frame_by_frame = true")
    with open(f"{pipes}/requests", "rb") as requests, open(f"{pipes}/answers", "wb") as answers:
        kind = HELLO
        while kind != FINISH:
            magic, kind, number, n_bytes = HEADER.unpack(_read(requests, HEADER.size))
            if magic != b"SU3D" or n_bytes > MAX_REQUEST_BYTES:
                raise SystemExit(f"not a request of su3d-bench: {magic!r}, {n_bytes} bytes")
            content = _read(requests, n_bytes)
            try:
                _answer(answers, OK, number, _done(mapper, kind, content))
            except Refused as refusal:
                _answer(answers, REFUSED, number, str(refusal))
            except Exception as error:
                _answer(answers, ERROR, number, f"{type(error).__name__}: {error}")
                raise


def _read(stream: BinaryIO, n_bytes: int) -> bytes:
    content = stream.read(n_bytes)
    if len(content) < n_bytes:
        raise SystemExit("su3d-bench has closed the pipe")
    return content


def _answer(stream: BinaryIO, kind: int, number: int, text: str) -> None:
    content = text.encode()[:4096]
    stream.write(HEADER.pack(b"SU3D", kind, number, len(content)) + content)
    stream.flush()


def _done(mapper: Any, kind: int, content: bytes) -> str:
    """The text of the answer, after the call that a request stands for."""
    if kind == HELLO:
        mapper.start(dict(line.split(" ", 1) for line in content.decode().splitlines()))
        return str(VERSION)
    if kind == FRAME:
        mapper.frame(_frame(content))
    elif kind == SNAPSHOT:
        number = mapper.snapshot(content.decode())
        return "" if number is None else str(number)
    elif kind == FINISH:
        getattr(mapper, "finish", lambda: None)()
    else:
        name = {REVISE: "revise", SAVE: "save", LOAD: "load"}.get(kind, "")
        if not hasattr(mapper, name):
            raise Refused(f"it has no {name or f'answer to requests of kind {kind}'}")
        getattr(mapper, name)(_poses(content) if kind == REVISE else content.decode())
    return ""


def _frame(content: bytes) -> Frame:
    number, time_s, width, height = FRAME_HEAD.unpack_from(content)
    matrices = np.frombuffer(content, "<f8", 25, FRAME_HEAD.size)
    start, n = FRAME_HEAD.size + matrices.nbytes, width * height
    depth_m = np.frombuffer(content, "<f4", n, start).reshape(height, width)
    rgb = np.frombuffer(content, "u1", 3 * n, start + 4 * n).reshape(height, width, 3)
    return Frame(number, time_s, matrices[:9].reshape(3, 3), matrices[9:].reshape(4, 4), depth_m, rgb)


def _poses(content: bytes) -> dict[int, NDArray[np.float64]]:
    rows = np.frombuffer(content, [("number", "<i8"), ("pose", "<f8", (4, 4))])
    return {int(row["number"]): row["pose"] for row in rows}
