"""The embedded encoder on whole objects of the built-in rooms: class of 69, and of 40 drawn from them.

``python benchmarks encoder_whole_objects`` renders nine rooms. An object counts if it has at least 400 pixels, does
not touch the image's edge, and fills 60 % of the rectangle that its box projects to; crops are its mask's bounding box.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.datasets.procedural.truth import STRUCTURE, SceneObject
from su3d_bench.datasets.rooms.classes import CLASSES
from su3d_bench.datasets.rooms.dataset import SCENES, Rooms
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.runs.scenes import data_root

EVERY = 80
MIN_PIXELS, MIN_SHOWN = 400, 0.6
N_DRAWS, N_CLASSES = 20, 40


def whole_objects(rooms: Rooms, scene: str) -> Iterator[tuple[str, UInt8Array]]:
    """Class name and crop of each whole object in every 80th image."""
    trajectory, objects = rooms.trajectory(scene), rooms.objects(scene)
    for index in range(0, len(trajectory), EVERY):
        image = rooms.render(scene, index)
        height, width = image.instance.shape
        for object_id, n_pixels in zip(*np.unique(image.instance, return_counts=True), strict=True):
            one = objects[object_id - 1]
            if object_id == 0 or n_pixels < MIN_PIXELS or one.class_name in STRUCTURE:
                continue
            rows, columns = np.nonzero(image.instance == object_id)
            top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
            if top == 0 or left == 0 or bottom == height or right == width:
                continue
            if (bottom - top) * (right - left) >= MIN_SHOWN * _projected_area(one, trajectory[index], rooms.intrinsics):
                yield one.class_name, image.rgb[top:bottom, left:right].copy()


def _projected_area(one: SceneObject, camera_to_world: Float64Array, intrinsics: Float64Array) -> float:
    """Area in pixels of the rectangle around the object's projected box; infinite if the box reaches the camera."""
    corners = np.stack(np.meshgrid(*zip(one.box_min, one.box_max, strict=True)), axis=-1).reshape(-1, 3)
    world_to_camera = np.linalg.inv(camera_to_world)
    seen = (corners @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ intrinsics.T
    if seen[:, 2].min() <= 0.1:
        return np.inf
    pixels = seen[:, :2] / seen[:, 2:]
    return float(np.prod(np.ptp(pixels, axis=0)))


def main() -> int:
    rooms, encoder = Rooms(data_root()), EmbeddedEncoder()
    names = [one.name for one in CLASSES]
    found = [pair for scene in SCENES for pair in whole_objects(rooms, scene)]
    truth = np.array([names.index(name) for name, _ in found])
    similarity = (
        encoder.encode_images([crop for _, crop in found])
        @ encoder.encode_texts([f"an image of a {name}" for name in names]).T
    )
    order = similarity.argsort(axis=1)[:, ::-1]
    shown = np.unique(truth)
    of_forty = []
    for draw in range(N_DRAWS):
        drawn = np.random.default_rng(draw).choice(shown, N_CLASSES, replace=False)
        rows = np.isin(truth, drawn)
        of_forty.append(float((drawn[similarity[rows][:, drawn].argmax(axis=1)] == truth[rows]).mean()))
    print(f"{len(truth)} whole objects of {len(shown)} classes")
    print(f"top-1 of {len(names)}: {100 * (order[:, 0] == truth).mean():.1f} %")
    print(f"top-5 of {len(names)}: {100 * (order[:, :5] == truth[:, None]).any(axis=1).mean():.1f} %")
    print(f"top-1 of {N_CLASSES}, mean of {N_DRAWS} draws of classes: {100 * np.mean(of_forty):.1f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
