from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array
from su3d_bench.reports.pictures.canvas import Camera, instance_colours, render, room_bounds, view_cameras
from su3d_bench.reports.pictures.maps import draw_scene


def plate(z: float, half: float = 0.5) -> Float32Array:
    axis = np.arange(-half, half, 0.01)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1).astype(np.float32)


def two_plates(names: tuple[str, ...] = ("rug", "lamp")) -> Instances:
    """A large plate with a small one above it; the large mask also contains the small one's points."""
    points = np.concatenate([plate(0.0), plate(0.4, half=0.2)])
    n_low = len(plate(0.0))
    return Instances.of(points, [np.arange(len(points)), np.arange(n_low, len(points))], names=names, captions=names)


def camera(width: int = 40, height: int = 40) -> Camera:
    box = np.array([[-9.0, -9, -9], [9, 9, 9]])
    return Camera(np.diag([1.0, -1, -1]), np.array([0.0, 0, 5]), 30.0, False, box, width, height)


def test_nearest_point_is_visible_in_any_point_order() -> None:
    points = np.array([[0, 0, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        seen = render(points[order], 0.01, camera()).point
        assert set(seen[seen >= 0]) == {order.index(1)}


def test_every_view_contains_the_whole_room() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, 1, 0], [4, 3, 2], (4000, 3)).astype(np.float32)
    for one in view_cameras(room_bounds(points), 200, 160):
        kept = points[((points >= one.box[0]) & (points <= one.box[1])).all(axis=1)]
        relative = (kept - one.eye) @ one.rotation.T
        scale = one.focal / relative[:, 2] if one.is_perspective else one.focal
        assert (relative[:, 2] > 0).all()
        assert (np.abs(relative[:, 0] * scale) <= one.width / 2).all()
        assert (np.abs(relative[:, 1] * scale) <= one.height / 2).all()
        assert len(kept) > 0.5 * len(points)


def test_smaller_of_two_overlapping_masks_is_visible(tmp_path: Path) -> None:
    from matplotlib.image import imread

    paths = draw_scene(two_plates(), None, tmp_path / "pictures", "two plates")
    assert [path.name for path in paths] == ["instances.png", "classes.png"]
    picture = np.rint(imread(paths[0])[..., :3] * 255).astype(int)
    colours = instance_colours(["rug", "lamp"])
    counts = [int((np.abs(picture - rgb).sum(-1) < 12).sum()) for rgb in colours]
    assert counts[0] > counts[1] > 1000
