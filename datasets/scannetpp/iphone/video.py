"""Colour images out of the iPhone's ``rgb.mkv``, decoded from its beginning, as ffmpeg numbers them: from 0."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import UInt8Array
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.scannetpp.iphone.forward import ForwardReader
from su3d_bench.formats.images import MAX_PIXELS, Size

VIDEO_NAME = "rgb.mkv"
MATROSKA = b"\x1a\x45\xdf\xa3"  # what else ffmpeg would open under this name may name other files and addresses
QUIET = {"OPENCV_FFMPEG_LOGLEVEL": "-8"}  # the decoder's own words are not for the terminal
ADVICE = "copy the file again, or extract it with the official toolkit into rgb/"


def video_size(path: Path, where: str) -> Size:
    """Width and height of the images in a video."""
    with _opened_video(path, f"{where}: {path.name}") as (_, size):
        return size


class VideoFile:
    """The images of a video by their numbers; each of ``wanted`` is kept as ``prepared`` makes it."""

    def __init__(
        self, path: Path, where: str, size: Size, wanted: frozenset[int], prepared: Callable[[UInt8Array], UInt8Array]
    ) -> None:
        self.path, self._where, self._size, self._prepared = path, f"{where}: {path.name}", size, prepared
        self._images = ForwardReader(self._decoded, wanted)

    def image(self, number: int) -> UInt8Array:
        """The prepared image of that number."""
        image = self._images.at(number)
        if image is None:
            raise DataError(f"{self._where}: frame {number} cannot be decoded, or is not there; {ADVICE}")
        return image

    def _decoded(self) -> Iterator[Callable[[], UInt8Array]]:
        with _opened_video(self.path, self._where) as (video, size):
            if size != self._size:
                raise DataError(
                    f"{self._where}: images of {size[0]}x{size[1]}; the camera has {self._size[0]}x{self._size[1]}"
                )
            while video.grab():
                yield partial(self._unpacked, video)

    def _unpacked(self, video: Any) -> UInt8Array:
        import cv2

        is_there, image = video.retrieve()
        if not is_there or image is None or image.shape != (self._size[1], self._size[0], 3):
            raise DataError(f"{self._where}: an image in it cannot be decoded; {ADVICE}")
        return self._prepared(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8))


@contextmanager
def _opened_video(path: Path, where: str) -> Iterator[tuple[Any, Size]]:
    """The decoder of a video, and the size of its images."""
    import cv2

    with reading(where), opened(path) as stream:
        if stream.read(len(MATROSKA)) != MATROSKA:
            raise DataError(f"{where}: is no Matroska video; {ADVICE}")
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if not video.isOpened() or width < 1 or height < 1 or width * height > MAX_PIXELS:
            raise DataError(f"{where}: is no video that can be decoded; {ADVICE}")
        yield video, (width, height)
    except cv2.error as error:
        raise DataError(f"{where}: cannot be decoded ({error.code}); {ADVICE}") from error
    finally:
        video.release()
