"""Random problems for the paper's text and the pipeline, their settings, and what the maps differ in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from literal_paper import NONE, Array, PaperProgram, PaperSettings, Thing

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Detections, Frame
from su3d_bench.opensu3d.config import OpenSU3DConfig

# Of an image's points of instances in one voxel the pipeline keeps the last.
OURS = PaperSettings(in_one_voxel="last")


def config_of(settings: PaperSettings) -> OpenSU3DConfig:
    """The pipeline's configuration that is meant to do what ``settings`` say."""
    words = {name: value for name, value in asdict(settings).items() if name in OpenSU3DConfig.model_fields}
    return OpenSU3DConfig(border_pixels="drop" if settings.background_pixels == "drop" else "background", **words)


def settings_of(config: OpenSU3DConfig) -> PaperSettings:
    """What the paper's program must be told to do as ``config`` says."""
    words = config.effective()
    return replace(OURS, **{one.name: words[one.name] for one in fields(PaperSettings) if one.name in words})


NAMES = ("chair", "sofa", "table", "oven", "armchair", "vase")
DIMENSIONS = 6


@dataclass(frozen=True)
class Problem:
    settings: PaperSettings
    images: tuple[tuple[Frame, Detections], ...]


def random_problem(seed: int) -> Problem:
    """A wall with boxes before it, seen by a camera that trembles or moves, and masks that do so too."""
    rng = np.random.default_rng(seed)
    settings = random_settings(rng)
    height, width = (int(n) for n in rng.integers(10, 30, 2))
    masks, depth = random_masks(rng, height, width, int(rng.integers(1, 6))), random_depth(rng, height, width)
    pose, focal = random_pose(rng, 3.0, 5.0), rng.uniform(15, 40)
    intrinsics = np.array(
        [[focal, 0, width / 2 - 0.5], [0, focal * rng.uniform(0.9, 1.1), height / 2 - 0.5], [0, 0, 1]]
    )
    move, turn = rng.choice([0.005, 0.05, 0.3]), rng.choice([0.002, 0.02, 0.1])
    images = []
    for nth in range(int(rng.integers(2, 6))):
        index = 7 * nth
        seen_depth = (depth + rng.normal(0, 0.003, depth.shape)).astype(np.float32)
        seen_depth[rng.random(depth.shape) < 0.03] = rng.choice([0.0, np.nan, 20.0])
        seen_from = pose @ random_pose(rng, turn, move)
        frame = Frame(index, float(nth), np.zeros((height, width, 3), np.uint8), seen_depth, seen_from, intrinsics)
        images.append((frame, random_detections(rng, index, masks, settings)))
    return Problem(settings, tuple(images))


def random_settings(rng: np.random.Generator) -> PaperSettings:
    """Any values that the settings can take together, those of tiny images and the defaults more often."""
    multi_scale = rng.choice(["direct", "weighted"])
    ratios = [float(ratio) for ratio in rng.choice([0.8, 1.2, 2.0, 4.0], int(rng.integers(0, 4)), replace=False)]
    if multi_scale == "weighted" or not ratios or rng.random() < 0.5:
        ratios.insert(int(rng.integers(len(ratios) + 1)), 1.0)
    eps = float(rng.choice([0.02, 0.04, 0.08, 0.15]))
    density = rng.choice(["scene", "scene", "frame", "all"]).item()
    return replace(
        OURS,
        crop_ratios=tuple(ratios),
        multi_scale=multi_scale.item(),
        multi_view=rng.choice(["direct", "global"]).item(),
        top_m=int(rng.integers(1, 7)),
        border_px=float(rng.choice([0, 0.4, 1, 2, 3])),
        border_reference_width=int(rng.choice([0, 0, 12, 20])),
        border_shape=rng.choice(["disc", "square"]).item(),
        background_pixels=rng.choice(["keep", "keep", "drop"]).item(),
        depth_min=float(rng.choice([0, 0, 0.9])),
        depth_max=float(rng.choice([1.1, 10])),
        eps=eps,
        frame_voxel=(None, None, None, 0.0, eps / 2, eps * 1.5)[int(rng.integers(6))],
        overlap_threshold=float(rng.choice([0.0, 0.1, 0.3, 0.3, 0.5, 1.0])),
        overlap_rule=rng.choice(["smaller-segment", "smaller-segment", "frame-segment", "as-printed"]).item(),
        density=density,
        # Which views hit a part is settled where a voxel's points are of one instance.
        dbscan_eps=float(rng.choice([0.05, 0.1, 0.2])) if density == "scene" else 5.0,
        dbscan_min_points=int(rng.choice([1, 2, 4, 8])),
        split_fraction=float(rng.choice([0.0, 0.3, 0.8, 0.8, 1.0])),
    )


def random_depth(rng: np.random.Generator, height: int, width: int) -> Array:
    """Metres to a slanted wall with up to three boxes before it."""
    v, u = np.mgrid[:height, :width]
    depth = rng.uniform(0.8, 1.2) + rng.uniform(-0.01, 0.01) * u + rng.uniform(-0.01, 0.01) * v
    for _ in range(int(rng.integers(0, 4))):
        depth[random_rectangle(rng, height, width)] -= rng.uniform(0.05, 0.4)
    return np.asarray(depth)


def random_masks(rng: np.random.Generator, height: int, width: int, n: int) -> Array:
    """Masks (n, H, W), rectangles or two of them, which may overlap, be equal or cover all."""
    masks = np.zeros((n, height, width), bool)
    for mask in masks:
        for _ in range(int(rng.integers(1, 3))):
            mask[random_rectangle(rng, height, width)] = True
    return masks


def random_rectangle(rng: np.random.Generator, height: int, width: int) -> tuple[slice, slice]:
    top, left = int(rng.integers(height)), int(rng.integers(width))
    return slice(top, top + int(rng.integers(1, height))), slice(left, left + int(rng.integers(1, width)))


def random_pose(rng: np.random.Generator, turn: float, move: float) -> Array:
    """Camera to world: a turn of about so many radians and a step of about so many metres."""
    x, y, z = rng.normal(0, turn, 3)
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = about_x @ about_y @ about_z, rng.normal(0, move, 3)
    return pose


def random_detections(rng: np.random.Generator, index: int, masks: Array, settings: PaperSettings) -> Detections:
    """Some of ``masks``, shifted by a pixel or not, in another order, and now and then one that only this image has."""
    seen = [np.roll(mask, rng.integers(-1, 2, 2), axis=(0, 1)) for mask in rng.permutation(masks) if rng.random() < 0.8]
    if rng.random() < 0.2:
        _, height, width = masks.shape
        seen.append(random_masks(rng, height, width, 1)[0] & (rng.random((height, width)) < 0.9))
    if rng.random() < 0.1:
        seen.append(np.zeros_like(masks[0]))
    n, ratios = len(seen), (*settings.crop_ratios, 7.0)
    return Detections(
        index,
        np.array(seen, bool).reshape(n, *masks.shape[1:]),
        np.zeros((n, 4), np.float32),
        (rng.integers(0, 5, n) / 4).astype(np.float32),
        tuple(rng.choice(NAMES, n).tolist()),
        tuple(rng.choice(["", " ", "something red"], n).tolist()),
        ratios[::-1],
        random_features(rng, (n, len(ratios), DIMENSIONS)),
        random_features(rng, (DIMENSIONS,)),
    )


def random_features(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Features of length 1, a few of them 0."""
    features = rng.normal(size=shape)
    features /= np.linalg.norm(features, axis=-1, keepdims=True)
    return np.asarray(features * (rng.random(shape[:-1]) > 0.05)[..., None], np.float32)


SAME_POINT_M = 1e-5  # maps are given in float32


def differences(found: Instances, program: PaperProgram) -> list[str]:
    """A line for each difference between a method's map and the paper's; empty where they are one.

    Two maps are one where they hold the same points, and the same sets of them with the same views, name, caption,
    feature, box, centroid and score. Which numbers the ids are is free, but each is one instance's.
    """
    things, of_none = program.things(), np.flatnonzero(program.scene.ids == NONE)
    kept = np.concatenate([of_none, *(thing.rows for thing in things)]).astype(int)
    row_of = matched(found.points, program.scene.points[kept])
    if row_of is None:
        return [f"map: {len(found.points)} points, the paper has {len(kept)}, or others"]
    if len(found) != len(things):
        return [f"instances: {len(found)}, the paper has {len(things)}"]
    place = np.full(len(program.scene.ids), NONE)
    place[kept] = row_of
    k_of = {found.mask(k).tobytes(): k for k in range(len(found))}
    masks = [np.sort(place[thing.rows]).astype(found.indices.dtype).tobytes() for thing in things]
    if {*k_of} != {*masks}:
        return ["instances: others than the paper's"]
    pairs = [(k_of[mask], thing) for mask, thing in zip(masks, things, strict=True)]
    lines = [f"instance {k}: {line}" for k, thing in pairs for line in unlike(found, k, thing)]
    if len({*found.ids.tolist()}) != len(found):
        lines.append(f"ids: {found.ids.tolist()} name an instance each")
    return lines


def matched(points: Array, others: Array) -> Array | None:
    """The row of ``points`` that each of ``others`` is, or None where they are not the same points."""
    from scipy.spatial import cKDTree

    if len(points) != len(others):
        return None
    if not len(points):
        return np.zeros(0, int)
    distance, rows = cKDTree(points).query(others)
    is_one = (distance < SAME_POINT_M).all() and len(np.unique(rows)) == len(rows)
    return np.asarray(rows) if is_one else None


def unlike(found: Instances, k: int, thing: Thing) -> Iterator[str]:
    """What instance ``k`` has otherwise than ``thing``, its points aside."""
    views = [tuple(view) for view in found.views[found.view_indptr[k] : found.view_indptr[k + 1]].tolist()]
    assert found.features is not None
    if views != thing.views:
        yield f"views {views}, the paper has {thing.views}"
    if (found.names[k], found.captions[k]) != (thing.name, thing.caption):
        yield f"'{found.names[k]}', '{found.captions[k]}', the paper has '{thing.name}', '{thing.caption}'"
    for what, ours, of_paper in (
        ("feature", found.features[k], thing.feature),
        ("box", found.boxes[k], thing.box),
        ("centroid", found.centroids[k], thing.centroid),
        ("score", found.scores[k], 1.0),
    ):
        if not np.allclose(ours, of_paper, rtol=1e-5, atol=1e-5):
            yield f"{what} {ours}, the paper has {of_paper}"
