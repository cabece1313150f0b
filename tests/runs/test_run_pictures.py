from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.core.types import Float32Array, GroundTruth, LabelSet
from su3d_bench.metrics.protocols.loading import class_names
from su3d_bench.reports.pictures.canvas import (
    NO_INSTANCE,
    ROOM_SURFACES,
    Canvas,
    class_colours,
    heat_colours,
    instance_colours,
)
from su3d_bench.reports.pictures.items import OUTLINE
from su3d_bench.reports.pictures.maps import draw_heat_map, draw_scene
from su3d_bench.reports.pictures.render import BACKGROUND, Camera, colour, render, room_bounds, view_cameras


def plate(z: float, half: float = 0.5) -> Float32Array:
    axis = np.arange(-half, half, 0.01)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1).astype(np.float32)


def two_plates(names: tuple[str, ...] = ("rug", "lamp")) -> Instances:
    """A large plate with a small one above it; the large mask holds the small one's points too."""
    points = np.concatenate([plate(0.0), plate(0.4, half=0.2)])
    n_all, n_low = len(points), len(plate(0.0))
    indices = np.concatenate([np.arange(n_all), np.arange(n_low, n_all)]).astype(np.int32)
    return Instances(
        points=points,
        indptr=np.array([0, n_all, len(indices)]),
        indices=indices,
        scores=np.ones(2),
        features=None,
        labels=None,
        names=names,
        captions=names,
        boxes=np.zeros((2, 2, 3), np.float32),
        centroids=np.zeros((2, 3), np.float32),
        view_indptr=np.zeros(3, np.int64),
        views=np.zeros((0, 2), np.int32),
    )


def camera(width: int = 40, height: int = 40) -> Camera:
    box = np.array([[-9.0, -9, -9], [9, 9, 9]])
    return Camera(np.diag([1.0, -1, -1]), np.array([0.0, 0, 5]), 30.0, False, box, width, height)


def test_the_nearest_point_is_seen_whatever_the_order() -> None:
    points = np.array([[0, 0, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        seen = render(points[order], 0.01, camera()).point
        assert set(seen[seen >= 0]) == {order.index(1)}


def test_points_outside_the_box_are_cut_away() -> None:
    points = np.array([[0, 0, 0], [0, 0, 9.5]], np.float32)
    seen = render(points, 0.01, camera()).point
    assert set(seen[seen >= 0]) == {0}


def test_a_view_of_nothing_is_background() -> None:
    view = render(np.zeros((0, 3), np.float32), 0.01, camera())
    picture = colour(view, np.zeros((0, 3), np.uint8))
    assert picture.shape == (20, 20, 3)
    assert (picture == BACKGROUND).all()


def test_every_view_holds_the_whole_room() -> None:
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


def test_of_overlapping_masks_the_smaller_one_is_seen(tmp_path: Path) -> None:
    from matplotlib.image import imread

    paths = draw_scene(two_plates(), None, tmp_path / "pictures", "two plates")
    assert [path.name for path in paths] == ["instances.png", "classes.png"]
    picture = np.rint(imread(paths[0])[..., :3] * 255).astype(int)
    colours = instance_colours(["rug", "lamp"])
    counts = [int((np.abs(picture - rgb).sum(-1) < 12).sum()) for rgb in colours]
    assert counts[0] > counts[1] > 1000


def test_heat_goes_from_dark_blue_to_dark_red_between_least_and_most() -> None:
    colours = heat_colours(np.array([0.3, 0.1, 0.2]))
    assert colours[1] == (0, 0, 128)
    assert colours[0] == (128, 0, 0)
    assert heat_colours(np.array([0.2, 0.2])) == heat_colours(np.array([0.7, 0.7]))
    assert heat_colours(np.zeros(0)) == []


def test_names_have_one_colour_and_surfaces_of_the_room_are_pale() -> None:
    palette = class_colours(["wall", "chair", "sofa", "floor", "lamp"])
    assert palette["wall"] == ROOM_SURFACES["wall"]
    assert len(set(palette.values())) == 5
    many = class_colours([f"thing {k}" for k in range(60)])
    assert len(set(many.values())) == 60
    assert NO_INSTANCE not in many.values()


def test_a_class_has_one_colour_whatever_else_is_in_the_picture() -> None:
    known = [name for name in class_names() if name not in ROOM_SURFACES]
    palette = class_colours(known)
    assert len(set(palette.values())) == len(known) > 200
    for name in ("book", "lamp", "no class table has this"):
        assert class_colours([name])[name] == class_colours(["chair", name, "sofa"])[name]
    assert class_colours(["book", "lamp"]).items() <= palette.items()


def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words that are written on pages from here on."""
    texts: list[str] = []
    write = Canvas.text

    def text(page: Canvas, x: float, y: float, words: str, *more: Any, **style: Any) -> None:
        texts.append(words)
        write(page, x, y, words, *more, **style)

    monkeypatch.setattr(Canvas, "text", text)
    return texts


def many_plates(n: int) -> Instances:
    cloud = plate(0.0)
    rows = np.array_split(np.arange(len(cloud)), n)
    return Instances.of(cloud, rows, names=tuple(f"thing {k}" for k in range(n)), ids=list(range(n)))


@pytest.mark.parametrize("with_truth", [False, True])
def test_every_class_is_in_the_legend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_truth: bool) -> None:
    texts = written(monkeypatch)
    cloud = plate(0.0)
    rows = (np.arange(len(cloud)) % 60 + 1).astype(np.int32)
    labels = LabelSet("x", tuple(range(1, 61)), tuple(f"true {k}" for k in range(60)))
    truth = GroundTruth(cloud, rows, rows, labels, "mesh-vertices", "test") if with_truth else None
    draw_scene(many_plates(70), truth, tmp_path, "x")
    assert {f"thing {k}" for k in range(70)} <= set(texts)
    assert not with_truth or set(labels.names) <= set(texts)
    assert not any("more" in text for text in texts)


def test_predictions_without_instances_or_names_draw_what_they_can(tmp_path: Path) -> None:
    points = plate(0.0)
    dense = DenseFeatures(points, np.zeros((len(points), 4), np.float16))
    assert draw_scene(dense, None, tmp_path, "dense") == []
    partition = Partition(points, np.zeros(len(points), np.int32), np.zeros((1, 4), np.float32))
    assert [path.name for path in draw_scene(partition, None, tmp_path, "partition")] == ["instances.png"]


def test_truth_with_unannotated_points_is_drawn_below(tmp_path: Path) -> None:
    labels = LabelSet("replica", (98, 47), ("rug", "lamp"))
    cloud = plate(0.0)
    semantic = np.full(len(cloud), 98, np.int32)
    semantic[: len(cloud) // 2] = 0
    truth = GroundTruth(cloud, semantic, semantic, labels, "mesh-vertices", "test")
    with_truth = draw_scene(two_plates(), truth, tmp_path / "a", "x")[1].read_bytes()
    without = draw_scene(two_plates(), None, tmp_path / "b", "x")[1].read_bytes()
    assert with_truth != without


@pytest.mark.parametrize("n", [0, 2])
def test_a_heat_map_is_a_picture_even_of_an_empty_legend(tmp_path: Path, n: int) -> None:
    lines = [f"{k + 1}. thing" for k in range(n)]
    draw_heat_map(two_plates(), np.array([0.1, 0.9]), tmp_path / "q" / "heat.png", "query", lines)
    assert (tmp_path / "q" / "heat.png").read_bytes().startswith(b"\x89PNG")


def test_a_heat_map_has_a_scale_ranks_at_the_instances_and_the_best_outlined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from matplotlib.axes import Axes
    from matplotlib.image import imread

    texts: list[str] = written(monkeypatch)
    ranks: list[str] = []

    def text(axes: Axes, x: float, y: float, words: str, **style: Any) -> None:
        ranks.append(words)

    monkeypatch.setattr(Axes, "text", text)
    lines = ["1. lamp 0.875", "2. rug 0.125"]
    draw_heat_map(two_plates(), np.array([0.125, 0.875]), tmp_path / "heat.png", "query", lines)
    assert {"0.125", "0.500", "0.875", "1. lamp 0.875", "2. rug 0.125"} <= set(texts)
    assert "\u25a0" not in texts  # no swatches, which say nothing that the scale does not
    assert ranks.count("1") == ranks.count("2") == 3  # in each of the views
    picture = np.rint(imread(tmp_path / "heat.png")[..., :3] * 255).astype(int)
    assert (np.abs(picture - OUTLINE).sum(-1) < 12).sum() > 300
