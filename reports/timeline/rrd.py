"""Timelines as a file of rerun's viewer (``.rrd``), made without a viewer, a display or a network."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import IO, Any

import numpy as np

from su3d_bench.core.errors import ModelMissing, printable
from su3d_bench.formats.images import depth_in_units, png_bytes
from su3d_bench.reports.timeline.records import (
    ABOUT,
    BOXES,
    CAMERA,
    CLASSES,
    CURVES,
    GROWTH,
    INSTANCES,
    MAP,
    MASKS,
    ROOM,
    TRUE_MASKS,
    TRUTH,
    Boxes,
    CameraPose,
    ColourImage,
    Content,
    DepthImage,
    IdImage,
    Names,
    Number,
    Points,
    Record,
    Text,
)

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


def write_rrd(
    scenes: Iterable[tuple[str, Iterable[Record]]], methods: Sequence[str], stream: IO[bytes], sdk: Any
) -> None:
    """Write a recording a scene, all into one file that holds how its panels stand; ``sdk`` is ``rerun_sdk()``."""
    for scene, records in scenes:
        recording = sdk.RecordingStream(APPLICATION, recording_id=printable(scene, 200), send_properties=False)
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        sink = recording.binary_stream()
        recording.send_recording_name(printable(scene, 200))
        recording.send_blueprint(_panels(sdk, methods), make_active=True, make_default=True)
        recording.log(_path(CAMERA[:1]), sdk.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for record in records:
            _log(sdk, recording, record)
            stream.write(sink.read(flush=True) or b"")
        recording.disconnect()
        stream.write(sink.read(flush=True) or b"")


def _log(sdk: Any, recording: Any, record: Record) -> None:
    moment = record.moment
    if moment is not None:
        recording.set_time("frame", sequence=moment.frame)
        recording.set_time("seconds", duration=moment.seconds)
    for part in _drawn(sdk, record.content):
        recording.log(_path(record.place), part, static=moment is None)


def _path(place: Sequence[str]) -> list[str]:
    """A place as rerun takes it, which escapes each part itself."""
    return [printable(part, 100) for part in place]


def _drawn(sdk: Any, content: Content) -> list[Any]:
    """A record's content as rerun's own types."""
    match content:
        case CameraPose(pose, intrinsics, width, height):
            pinhole = sdk.Pinhole(
                image_from_camera=intrinsics,
                width=width,
                height=height,
                camera_xyz=sdk.ViewCoordinates.RDF,
                image_plane_distance=CAMERA_M,
            )
            return [sdk.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), pinhole]
        case ColourImage(rgb):
            return [sdk.EncodedImage(contents=_jpeg(rgb), media_type="image/jpeg")]
        case DepthImage(depth_m):
            packed = png_bytes(depth_in_units(depth_m, UNITS_PER_METRE))
            return [sdk.EncodedDepthImage(packed, media_type="image/png", meter=UNITS_PER_METRE)]
        case IdImage(ids):
            return [sdk.SegmentationImage(ids, opacity=0.6)]
        case Names(entries, nothing):
            none = (0, 0, 0, 0) if nothing is None else nothing
            return [sdk.AnnotationContext([_info(sdk, 0, "", none), *(_info(sdk, *entry) for entry in entries)])]
        case Points(points, ids, radius_m):
            return [sdk.Points3D(points, class_ids=ids, radii=radius_m)]
        case Boxes(corners, labels, colours):
            sizes = corners[:, 1] - corners[:, 0]
            texts = [printable(label, 80) for label in labels]
            shades = np.array(colours, np.uint8).reshape(-1, 3)
            return [sdk.Boxes3D(mins=corners[:, 0], sizes=sizes, labels=texts, colors=shades)]
        case Number(value):
            return [sdk.Scalars(value)]
        case Text(text):
            made_with = f"Made with rerun {sdk.__version__}; other versions may not read this file."
            return [sdk.TextDocument(f"{text}\n\n{made_with}", media_type="text/plain")]


def _info(sdk: Any, number: int, name: str, colour: tuple[int, ...]) -> Any:
    return sdk.AnnotationInfo(number, printable(name, 80), colour)


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
