"""A scene of a run as a recording of rerun's viewer (``.rrd``), made without a viewer, a display or a network."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import ModelMissing, printable
from su3d_bench.core.types import Float32Array, Frame
from su3d_bench.formats.images import depth_in_units, png_bytes
from su3d_bench.reports.pictures.canvas import NO_INSTANCE, Colour

UInt16Array = NDArray[np.uint16]
# A place is a path through these; names of methods stand below them and so can take no other's place.
CAMERA = ("world", "camera")
MASKS, TRUE_MASKS = (*CAMERA, "masks"), (*CAMERA, "truth")
MAP, TRUTH, GROWTH, ABOUT = ("world", "map"), ("world", "truth"), ("growth",), ("about",)
INSTANCES, CLASSES, BOXES = "instances", "classes", "boxes"
ROOM, TOP = "room", "ceiling"  # parts of a cloud: what is below the ceiling, and the rest
CURVES = ("instances", "points", "milliseconds an update")
Name = tuple[int, str, Colour]  # an id, what it is called and its colour
APPLICATION = "su3d-bench"
LEAST_VERSION = (0, 41)  # the first that the project was tried with
UNITS_PER_METRE = 1000.0  # of depth: 16 bits reach 65 m
JPEG_QUALITY = 80
CAMERA_M = 0.4  # how far before the camera its picture stands in the room
INSTALL = "pip install 'su3d-bench[rerun]'"


def rerun_sdk() -> Any:
    """The module of rerun; a ``ModelMissing`` where it is not installed, too old, or switched off."""
    try:
        import rerun
    except ImportError as error:
        raise ModelMissing(f"report rerun needs the rerun extra: {INSTALL}") from error
    version = str(getattr(rerun, "__version__", ""))
    numbers = re.match(r"(\d+)\.(\d+)", version)
    if numbers is None or (int(numbers[1]), int(numbers[2])) < LEAST_VERSION:
        least = ".".join(map(str, LEAST_VERSION))
        raise ModelMissing(f"report rerun needs rerun-sdk {least} or later, here is {version or 'another'}: {INSTALL}")
    if not rerun.RecordingStream(APPLICATION, send_properties=False).is_enabled():
        raise ModelMissing("RERUN in the environment switches rerun off, and nothing would be written; unset RERUN")
    return rerun


class Recording:
    """The recording of one scene, which goes piece by piece into ``stream``; ``sdk`` is ``rerun_sdk()``.

    A place is a path of names. What is logged holds from the frame of the last ``at`` on, and always before the first.
    """

    def __init__(self, sdk: Any, scene: str, methods: Sequence[str], stream: IO[bytes]) -> None:
        self._sdk, self._stream, self._is_static = sdk, stream, True
        self._recording = sdk.RecordingStream(APPLICATION, recording_id=printable(scene, 200), send_properties=False)
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        self._sink = self._recording.binary_stream()
        self._recording.send_recording_name(printable(scene, 200))
        self._recording.send_blueprint(_panels(sdk, methods), make_active=True, make_default=True)
        self._log(CAMERA[:1], sdk.ViewCoordinates.RIGHT_HAND_Z_UP)

    def at(self, frame: int, seconds: float) -> None:
        """Go to a moment: a frame's index at full rate, and seconds since the first that is shown."""
        self._recording.set_time("frame", sequence=frame)
        self._recording.set_time("seconds", duration=seconds)
        self._is_static = False

    def photo(self, frame: Frame) -> None:
        """Where the camera is, what it saw and how far that was."""
        height, width = frame.depth_m.shape
        pose = frame.camera_to_world
        pinhole = self._sdk.Pinhole(
            image_from_camera=frame.intrinsics,
            width=width,
            height=height,
            camera_xyz=self._sdk.ViewCoordinates.RDF,
            image_plane_distance=CAMERA_M,
        )
        self._log(CAMERA, self._sdk.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), pinhole)
        colour = self._sdk.EncodedImage(contents=_jpeg(frame.rgb), media_type="image/jpeg")
        self._log((*CAMERA, "colour"), colour)
        packed = png_bytes(depth_in_units(frame.depth_m, UNITS_PER_METRE))
        depth = self._sdk.EncodedDepthImage(packed, media_type="image/png", meter=UNITS_PER_METRE)
        self._log((*CAMERA, "depth"), depth)

    def masks(self, place: Sequence[str], ids: UInt16Array) -> None:
        """Whose each pixel (h, w) is: ids of the ``names`` there, 0 for nobody's."""
        self._log(place, self._sdk.SegmentationImage(ids, opacity=0.6))

    def names(self, place: Sequence[str], entries: Sequence[Name], *, is_nobody_seen: bool) -> None:
        """What ids mean at a place and below it; id 0 is grey, or cannot be seen."""
        nobody = (0, "", NO_INSTANCE if is_nobody_seen else (0, 0, 0, 0))
        infos = [
            self._sdk.AnnotationInfo(number, printable(name, 80), tint) for number, name, tint in (nobody, *entries)
        ]
        self._log(place, self._sdk.AnnotationContext(infos))

    def points(self, place: Sequence[str], points: Float32Array, ids: UInt16Array, radius_m: float) -> None:
        """Points (n, 3) m of the world and whose they are: (n,) ids of the ``names`` above."""
        self._log(place, self._sdk.Points3D(points, class_ids=ids, radii=radius_m))

    def boxes(
        self, place: Sequence[str], corners: Float32Array, labels: Sequence[str], colours: Sequence[Colour]
    ) -> None:
        """Boxes along the axes: lowest and highest corners (k, 2, 3) m, and what is written at each."""
        sizes, shades = corners[:, 1] - corners[:, 0], np.array(colours, np.uint8).reshape(-1, 3)
        texts = [printable(label, 80) for label in labels]
        self._log(place, self._sdk.Boxes3D(mins=corners[:, 0], sizes=sizes, labels=texts, colors=shades))

    def number(self, place: Sequence[str], value: float) -> None:
        """A value of a curve."""
        self._log(place, self._sdk.Scalars(value))

    def close(self, about: str) -> None:
        """End the recording with plain words about all of it."""
        made_with = f"Made with rerun {self._sdk.__version__}; other versions may not read this file."
        self._is_static = True
        self._log(ABOUT, self._sdk.TextDocument(f"{about}\n\n{made_with}", media_type="text/plain"))
        self._recording.disconnect()
        self._stream.write(self._sink.read(flush=True) or b"")

    def _log(self, place: Sequence[str], *contents: Any) -> None:
        for content in contents:
            self._recording.log(_path(place), content, static=self._is_static)
        self._stream.write(self._sink.read(flush=True) or b"")


def _path(place: Sequence[str]) -> list[str]:
    """A place as rerun takes it, which escapes each part itself."""
    return [printable(part, 100) for part in place]


def _jpeg(rgb: Any) -> bytes:
    import cv2

    return bytes(cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _panels(sdk: Any, methods: Sequence[str]) -> Any:
    """The photo with its masks above the curves, the maps by instance and by class, the truth."""
    rrb = sdk.blueprint

    def at(*parts: str) -> str:
        return str(sdk.new_entity_path(_path(parts)))

    def room(name: str, *shown: str) -> Any:
        camera = [at(*CAMERA), at(*CAMERA, "colour")]
        return rrb.Spatial3DView(origin=at("world"), contents=[*camera, *shown], name=printable(name, 100))

    def photo(name: str, *shown: str) -> Any:
        return rrb.Spatial2DView(origin=at(*CAMERA), contents=[at(*CAMERA, "colour"), *shown], name=name)

    photos = [photo(f"masks of {printable(method, 80)}", at(*MASKS, method)) for method in methods]
    depth = rrb.Spatial2DView(origin=at(*CAMERA), contents=[at(*CAMERA, "depth")], name="depth")
    rooms = []
    for method in methods:
        boxes = at(*MAP, method, BOXES)
        rooms.append(room(f"{method}: instances", f"{at(*MAP, method, INSTANCES, ROOM)}/**", boxes))
        rooms.append(room(f"{method}: classes", f"{at(*MAP, method, CLASSES, ROOM)}/**"))
    truths = [room(f"truth: {kind}", f"{at(*TRUTH, kind, ROOM)}/**") for kind in (CLASSES, INSTANCES)]
    left = rrb.Vertical(
        rrb.Tabs(*photos, photo("masks of the truth", at(*TRUE_MASKS)), depth),
        rrb.Tabs(
            *(rrb.TimeSeriesView(origin=at(*GROWTH, curve), name=curve) for curve in CURVES),
            rrb.TextDocumentView(origin=at(*ABOUT), name="what this is"),
        ),
    )
    right = rrb.Vertical(rrb.Tabs(*rooms), rrb.Tabs(*truths))
    panels = rrb.Horizontal(left, right, column_shares=[2, 3])
    time = rrb.TimePanel(state="collapsed", timeline="frame")
    return rrb.Blueprint(panels, time, rrb.SelectionPanel(state="collapsed"))
