"""Oracle masks, exact on hand-made meshes; their noise; the oracle method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from perception_fakes import INTRINSICS, CountingEncoder, still_life

from su3d_bench.baselines.oracle import Oracle
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Frame, GroundTruth, InstanceMesh, Int32Array, LabelSet, PerceptionNeeds, SceneInfo
from su3d_bench.perception.oracle import MeshProjector, OracleConfig, OracleNoise, OracleSegmenter, apply_noise
from su3d_bench.perception.profiles import PerceptionConfig, build_perception

SCENE = SceneInfo("rooms", "living0", n_frames=1, stride=1, image_domain="rendered-rooms")
# One pixel is 1 cm at 1 m: the square covers columns 30..69 and rows 20..49 of the image at depth 1.
SQUARE = ((30 - 80) / 100, (70 - 80) / 100, (20 - 60) / 100, (50 - 60) / 100, 1.0)
WALL = (-3.0, 3.0, -3.0, 3.0, 2.0)


def quad_mesh(*quads: tuple[float, float, float, float, float], instance: Sequence[int]) -> InstanceMesh:
    """Rectangles (x0, x1, y0, y1, z) facing the camera, two triangles each, as instances of ascending class."""
    corners = [[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)] for x0, x1, y0, y1, z in quads]
    triangles = np.arange(0, 4 * len(quads), 4)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    known = sorted({i for i in instance if i})
    return InstanceMesh(
        np.array(corners, np.float32).reshape(-1, 3),
        triangles.reshape(-1, 3).astype(np.int32),
        np.repeat(np.array(instance, np.int32), 2),
        {key: 20 + rank for rank, key in enumerate(known)},
        LabelSet("replica", (20, 21, 22, 23), ("chair", "cup", "umbrella", "blinds")),
    )


def flat_frame(depth_m: float = 2.0, index: int = 0) -> Frame:
    depth = np.full((120, 160), depth_m, np.float32)
    return Frame(index, 0.0, np.zeros((120, 160, 3), np.uint8), depth, np.eye(4), INTRINSICS)


def square_frame(index: int = 0) -> Frame:
    frame = flat_frame(index=index)
    frame.depth_m[20:50, 30:70] = 1.0
    return frame


def expected_square() -> Int32Array:
    image = np.full((120, 160), 2, np.int32)
    image[20:50, 30:70] = 1
    return image


def test_square_in_front_of_a_wall_is_projected_exactly() -> None:
    projector = MeshProjector(quad_mesh(SQUARE, WALL, instance=[1, 2]), OracleConfig())
    assert np.array_equal(projector.instance_image(square_frame()), expected_square())


def test_pose_moves_the_masks() -> None:
    frame = square_frame()
    frame.camera_to_world[0, 3] = 0.1  # ten pixels at 1 m
    frame.depth_m[:] = 2.0
    frame.depth_m[20:50, 20:60] = 1.0
    image = MeshProjector(quad_mesh(SQUARE, WALL, instance=[1, 2]), OracleConfig()).instance_image(frame)
    assert np.array_equal(image, np.roll(expected_square(), -10, axis=1))


def test_mesh_holes_are_filled_from_near_pixels_of_similar_depth() -> None:
    left, right = (-3.0, -0.5, -3.0, 3.0, 2.0), (-0.42, 3.0, -3.0, 3.0, 2.0)  # a slit of four pixels
    mesh = quad_mesh(left, right, instance=[1, 2])
    image = MeshProjector(mesh, OracleConfig(fill_px=3)).instance_image(flat_frame())
    assert set(np.unique(image)) == {1, 2}
    slit = np.flatnonzero((MeshProjector(mesh, OracleConfig(fill_px=0)).instance_image(flat_frame()) == 0)[0])
    assert len(slit) == 4
    frame = flat_frame()
    frame.depth_m[:, slit] = 1.5
    assert (MeshProjector(mesh, OracleConfig(fill_px=3)).instance_image(frame)[:, slit] == 0).all()
    frame.depth_m[:, slit] = 0.0
    assert (MeshProjector(mesh, OracleConfig(fill_px=3)).instance_image(frame)[:, slit] == 0).all()


def test_small_and_unannotated_surfaces_are_dropped() -> None:
    small = (0.5, 0.55, 0.0, 0.05, 1.0)  # 5x5 pixels
    mesh = quad_mesh(SQUARE, WALL, small, instance=[1, 0, 3])
    frame = square_frame()
    frame.depth_m[60:65, 130:135] = 1.0
    regions = OracleSegmenter(mesh, OracleConfig()).segment(frame)
    assert regions.names == ("chair",) and regions.scores.tolist() == [1.0]
    assert np.array_equal(regions.masks[0], expected_square() == 1)
    assert regions.boxes.tolist() == [[30, 20, 70, 50]]


def test_features_of_class_names_are_equal_at_every_ratio(tmp_path: Path) -> None:
    encoder = CountingEncoder()
    perception = build_perception(
        "oracle",
        PerceptionConfig(),
        scene=SCENE,
        cache_root=tmp_path,
        mesh=quad_mesh(SQUARE, WALL, instance=[1, 3]),
        encoder=encoder,
    )
    needs = PerceptionNeeds(crop_ratios=(0.8, 1.0), background_names=("cup",))
    found = perception.detect(square_frame(), needs, Timer())
    expected = encoder.encode_texts(["a chair in a scene", "a cup in a scene"])
    assert found.names == ("chair",) and found.captions == ("a chair in a scene",)
    assert np.array_equal(found.crop_features[0, 0], expected[0])
    assert np.array_equal(found.crop_features[0, 1], expected[0])
    mean = expected.astype(np.float64).sum(axis=0)
    assert np.allclose(found.global_feature, mean / np.linalg.norm(mean), atol=1e-6)
    assert encoder.n_images == 0
    assert perception.caveat is not None and "ground truth" in perception.caveat


def noisy(index: int = 0, **values: float) -> tuple[list[np.typing.NDArray[np.bool_]], list[str]]:
    frame = still_life()
    masks = [frame.depth_m == value for value in (2.0, 2.5, 3.0)]
    noise = OracleNoise.model_validate(values)
    return apply_noise(masks, ["chair", "cup", "wall"], ["chair", "cup", "wall"], noise, index)


def test_noise_depends_only_on_seed_and_frame() -> None:
    values = {"drop_probability": 0.5, "split_probability": 0.5, "flip_probability": 0.5}
    outcomes = []
    for index in range(12):
        first, again = noisy(index, **values), noisy(index, **values)
        assert first[1] == again[1] and all(np.array_equal(a, b) for a, b in zip(first[0], again[0], strict=True))
        outcomes.append(tuple(first[1]))
    assert len(set(outcomes)) > 3
    assert [noisy(i, seed=1, **values)[1] for i in range(12)] != [noisy(i, **values)[1] for i in range(12)]


def test_each_noise_type_has_its_effect() -> None:
    assert noisy(drop_probability=1.0) == ([], [])
    eroded, _ = noisy(erode_px=2)
    assert eroded[0].sum() == 36 * 36
    dilated, _ = noisy(dilate_px=1)
    assert dilated[0].sum() == 40 * 40 + 4 * 40  # a disc of radius 1 is a cross
    split, names = noisy(split_probability=1.0)
    assert names == ["chair", "chair", "cup", "cup", "wall", "wall"]
    assert not (split[0] & split[1]).any() and (split[0] | split[1]).sum() == 1600 and split[0].any()
    merged, names = noisy(merge_probability=1.0)
    assert len(merged) == 1 and merged[0].all() and names == ["wall"]
    _, flipped = noisy(flip_probability=1.0)
    assert all(new != old for new, old in zip(flipped, ["chair", "cup", "wall"], strict=True))


def test_oracle_method_returns_all_ground_truth_instances() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6, 3)).astype(np.float32)
    semantic = np.array([28, 20, 0, 28, 20, 0], np.int32)
    instance = np.array([4, 1, 0, 4, 1, 7], np.int32)
    labels = LabelSet("replica", (20, 28), ("chair", "cup"))
    method = Oracle(Oracle.Config())
    method.receive_ground_truth(GroundTruth(points, semantic, instance, labels, "mesh-vertices", "test"))
    method.start(SCENE)
    found = method.finish()
    assert method.needs.frames is False
    assert found.labels == ("chair", "cup") and found.ids.tolist() == [1, 4] and found.scores.tolist() == [1.0, 1.0]
    assert found.captions == ("a chair in a scene", "a cup in a scene") and found.features is None
    assert found.mask(0).tolist() == [1, 4] and found.mask(1).tolist() == [0, 3]
    assert np.allclose(found.boxes[0], [points[[1, 4]].min(axis=0), points[[1, 4]].max(axis=0)])
    assert np.allclose(found.centroids[1], points[[0, 3]].mean(axis=0))
    assert np.array_equal(found.points, points)


def test_frames_before_a_change_show_the_earlier_mesh() -> None:
    """The square appears at frame 5: until then the wall behind it has no hole."""
    last, earlier = quad_mesh(SQUARE, WALL, instance=[1, 2]), quad_mesh(WALL, instance=[2])
    segmenter = OracleSegmenter(replace(last, earlier=earlier, first_frame=5), OracleConfig(fill_px=0))
    assert segmenter.segment(flat_frame(index=4)).masks.sum() == 120 * 160
    assert segmenter.segment(flat_frame(index=5)).masks.sum() == 120 * 160 - 30 * 40
    assert segmenter.segment(square_frame(index=5)).names == ("chair", "cup")
    assert segmenter.digest != OracleSegmenter(last, OracleConfig(fill_px=0)).digest
