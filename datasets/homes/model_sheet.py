"""Every model of the catalogue in one picture: seen from the front right and above, with its class and size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.types import UInt8Array
from su3d_bench.datasets.homes.catalogue import Model, catalogue
from su3d_bench.datasets.procedural.items import Item, Light, Placed
from su3d_bench.datasets.procedural.rendering.mesh import build_mesh, gather_patches
from su3d_bench.datasets.procedural.rendering.render import FOCAL_PER_WIDTH
from su3d_bench.datasets.procedural.rendering.sampled import SampledRenderer

TILE, COLUMNS = 180, 10
VIEW = (0.55, -1.0, 0.55)  # from the middle of the object to the camera
PAPER = 225
FOCAL = 2 * FOCAL_PER_WIDTH  # per side of a tile, which is the middle half of the rendered picture


def draw_item(item: Item, side: int = TILE) -> UInt8Array:
    """The item alone on paper, in a square picture."""
    reach = float(np.linalg.norm(item.size)) / 2
    lamp = Light((-2 * reach, -3 * reach, 4 * reach), (1.6, 1.6, 1.5), 0.3 * reach)
    mesh = build_mesh(gather_patches([Placed(1, item, 0.0, np.zeros(3))]), [lamp], 0.7)
    forward = -np.array(VIEW) / np.linalg.norm(VIEW)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = np.array([0.0, 0.0, float(item.size[2]) / 2]) - forward * reach * np.hypot(1.0, 2 * FOCAL)
    frame = SampledRenderer(mesh, 2 * side, side).render(pose)
    middle = slice(side // 2, side // 2 + side)
    return np.where((frame.instance > 0)[..., None], frame.rgb, np.uint8(PAPER))[:, middle]


def model_sheet(names: Sequence[str] = ()) -> tuple[UInt8Array, int, int]:
    """The picture (H, W, 3), the number of models and of their classes; held-out models have a red frame.

    ``names``: of models or classes, by default all. Raises ``ConfigError`` for one that does not exist.
    """
    every = [(known.name, model) for known in catalogue().classes.values() for model in known.models]
    known_names = {name for class_name, model in every for name in (class_name, model.name)}
    if unknown := [name for name in names if name not in known_names]:
        raise ConfigError(f"homes has no model or class '{unknown[0]}'{suggest(unknown[0], sorted(known_names))}")
    models = [(name, model) for name, model in every if not names or {name, model.name} & set(names)]
    tiles = [_tile(name, model, k) for k, (name, model) in enumerate(models)]
    tiles += [np.full((TILE, TILE, 3), 255, np.uint8)] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[k : k + COLUMNS], axis=1) for k in range(0, len(tiles), COLUMNS)]
    return np.concatenate(rows), len(models), len({name for name, _ in models})


def _tile(class_name: str, model: Model, seed: int) -> UInt8Array:
    import cv2

    item = model.build(np.random.default_rng(seed))
    tile = np.ascontiguousarray(draw_item(item))
    size = " x ".join(f"{100 * side:.0f}" for side in item.size)
    for line, text in enumerate((class_name, model.name.replace("_", " "), f"{size} cm")):
        cv2.putText(tile, text[:34], (5, 13 + 13 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (0, 0, 0), 1, cv2.LINE_AA)
    if model.is_held_out:
        cv2.rectangle(tile, (1, 1), (TILE - 2, TILE - 2), (200, 40, 40), 2)
    return tile
