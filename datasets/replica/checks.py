"""Everything that is wrong with the files of a Replica scene, one line each, where a reader stops at the first fault.

Images are judged by their first and last bytes; decoding them is the reader's part. Beside it the key of a scene's
files, which looks at images in the same way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import opened
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.replica.boxes import SLACK_M, objects_outside_boxes, read_boxes
from su3d_bench.datasets.replica.frames import (
    Camera,
    check_frames_complete,
    colour_name,
    depth_name,
    read_camera,
    trajectory_lines,
)
from su3d_bench.datasets.replica.mesh_truth import INFO_NAME, MESH_NAME, read_annotated_mesh
from su3d_bench.formats.images import JPEG_END, JPEG_END_WITHIN, PNG_SIGNATURE, image_size
from su3d_bench.formats.poses import poses_of_lines

MOST_LINES = 20  # of one kind of fault; the rest is counted
HEAD_BYTES = (4096, 1 << 18)  # a JPEG may carry its size behind the blocks of its camera, each below 64 KB
PNG_HEAD_BYTES = 64  # signature, and the chunk with the size
PNG_TAIL_BYTES = 1024  # the end of the pixels, and what little writers put behind it
PNG_END = b"IEND\xaeB`\x82"  # the last chunk with its checksum


def render_problems(tree: Path, scene: str, where: str) -> Iterator[str]:
    """Faults of camera, trajectory and images of the scene in a render ``tree``."""
    camera, lines = None, []
    try:
        camera = read_camera(tree / "cam_params.json", where)
    except DataError as error:
        yield str(error)
    try:
        lines = trajectory_lines(tree / scene / "traj.txt", where)
    except DataError as error:
        yield str(error)
    yield from _shortened(_pose_problems(lines, where), f"{where}: traj.txt")
    try:
        check_frames_complete(tree / scene, len(lines), where)
    except DataError as error:
        yield str(error)
    yield from _shortened(_image_problems(tree / scene, len(lines), camera, where), f"{where}: results/")


def _shortened(problems: Iterator[str], where: str) -> Iterator[str]:
    n_more = 0
    for n, line in enumerate(problems):
        if n < MOST_LINES:
            yield line
        else:
            n_more += 1
    if n_more:
        yield f"{where}: {n_more} more faults of this kind"


def _pose_problems(lines: list[str], where: str) -> Iterator[str]:
    for number, line in enumerate(lines, 1):
        try:
            poses_of_lines([line], f"{where}: traj.txt", number)
        except DataError as error:
            yield str(error)


def _image_problems(folder: Path, n_frames: int, camera: Camera | None, where: str) -> Iterator[str]:
    """Images that are there and cannot be right; missing ones are counted elsewhere."""
    for index in range(n_frames):
        for name in (colour_name(index), depth_name(index)):
            try:
                with opened(folder / name) as file:
                    head = file.read(HEAD_BYTES[0])
                    if image_size(head) is None:
                        head += file.read(HEAD_BYTES[1])
                    file.seek(max(0, file.seek(0, 2) - JPEG_END_WITHIN))
                    tail = file.read()
            except FileNotFoundError:
                continue
            except OSError as error:
                yield f"{where}: {name} cannot be read: {error.strerror}"
                continue
            fault = _image_fault(head, tail, camera)
            if fault:
                yield f"{where}: {name}{fault}"


def _image_fault(head: bytes, tail: bytes, camera: Camera | None) -> str | None:
    size = image_size(head)
    is_whole = tail.endswith(PNG_END) if head.startswith(PNG_SIGNATURE) else JPEG_END in tail
    if size is None or not is_whole:
        return ": no image, or cut short; copy the file again"
    if camera is not None and size != (camera.width, camera.height):
        return f" is {size[0]}x{size[1]} but cam_params.json says {camera.width}x{camera.height}"
    return None


def original_problems(original: Path | None, where: str) -> Iterator[str]:
    """Faults of the scene in the original release; one without any of it, or with its boxes alone, has none."""
    if original is None:
        return
    if not (original / INFO_NAME).exists():
        yield f"{where}: {INFO_NAME} is missing in {original}; copy it there"
        return
    try:
        boxes = read_boxes(original / INFO_NAME, where)
        if not (original / MESH_NAME).exists():
            return
        outside = objects_outside_boxes(read_annotated_mesh(original, where), boxes)
    except DataError as error:
        yield str(error)
        return
    lines = (
        f"{where}: {INFO_NAME}: object {object_id} has faces {beyond_m:.2f} m beyond its box and the slack of "
        f"{SLACK_M} m; the boxes are of another mesh"
        for object_id, beyond_m in outside.items()
    )
    yield from _shortened(lines, f"{where}: {INFO_NAME}")


def digest_of(files: Sequence[Path], images: Sequence[Path], where: str) -> str:
    """A key of the content of ``files``, and of the names, sizes and content of ``images``."""
    total = hashlib.sha256()
    with reading(where):
        for path in files:
            total.update(f"{path.name} {digest_file(path)}\n".encode())
        for path in images:
            total.update(f"{path.name} {image_key(path)}\n".encode())
    return total.hexdigest()


def image_key(path: Path) -> str:
    """A key of an image: of every byte, except of a PNG, whose own checksum of all pixels stands near its end.

    The pixels of a PNG are a zlib stream, which ends with the Adler-32 of the uncompressed rows. What this cannot see:
    other pixels of the same checksum (one in 2**32) and size, and damage amid a PNG, which the reader of frames
    refuses because the checksum of the chunk fails.
    """
    with opened(path) as file:
        head = file.read(PNG_HEAD_BYTES)
        key = hashlib.sha256(head)
        size = file.seek(0, 2)
        file.seek(max(len(head), size - PNG_TAIL_BYTES) if head.startswith(PNG_SIGNATURE) else len(head))
        key.update(file.read())
    return f"{size} {key.hexdigest()}"
