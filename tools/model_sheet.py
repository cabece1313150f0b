"""Draw models of the homes as contact sheets: ``model_sheet.py OUT.png [NAME or FILE.toml ...]``."""

from __future__ import annotations

import sys

import cv2
import numpy as np

from su3d_bench.datasets.homes.catalogue import FOLDER
from su3d_bench.datasets.homes.model_builder import build_item
from su3d_bench.datasets.homes.model_format import ModelRow, read_models
from su3d_bench.datasets.procedural.items import Item, Light, Placed
from su3d_bench.datasets.procedural.rendering.mesh import build_mesh, gather_patches
from su3d_bench.datasets.procedural.rendering.render import FOCAL_PER_WIDTH, Renderer

SIZE, COLUMNS = 180, 8


def picture(item: Item) -> np.ndarray:
    """The item seen from the front, the right and above."""
    reach = float(np.linalg.norm(item.size)) / 2
    lamp = Light((-2 * reach, -3 * reach, 4 * reach), (1.6, 1.6, 1.5), 0.3 * reach)
    patches = gather_patches([Placed(1, item, 0.0, np.zeros(3))])
    mesh = build_mesh(patches, [lamp], 0.7)
    middle = np.array([0.0, 0.0, float(item.size[2]) / 2])
    away = np.array([0.55, -1.0, 0.55])
    forward = -away / np.linalg.norm(away)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = middle - forward * reach * 2.1 * FOCAL_PER_WIDTH
    frame = Renderer(mesh, SIZE, SIZE).render(pose)
    return np.where((frame.instance > 0)[..., None], frame.rgb, np.uint8(225))


def main() -> None:
    out, wanted = sys.argv[1], sys.argv[2:]
    files = [FOLDER / "models" / name for name in wanted if name.endswith(".toml")] or sorted(
        (FOLDER / "models").glob("*.toml")
    )
    rows: list[ModelRow] = [row for path in files for row in read_models(path)]
    names = [name for name in wanted if not name.endswith(".toml")]
    rows = [row for row in rows if not names or row.name in names or row.of_class in names]
    tiles = []
    for row in rows:
        item = build_item(row, np.random.default_rng(len(tiles)))
        tile = picture(item)
        size = "x".join(f"{100 * side:.0f}" for side in item.size)
        for line, text in enumerate((f"{row.name}", f"{row.of_class} {size} cm")):
            cv2.putText(tile, text[:32], (4, 12 + 13 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(tile)
    tiles += [np.full((SIZE, SIZE, 3), 255, np.uint8)] * (-len(tiles) % COLUMNS)
    sheet = np.concatenate([np.concatenate(tiles[k : k + COLUMNS], axis=1) for k in range(0, len(tiles), COLUMNS)])
    cv2.imwrite(out, sheet[..., ::-1])


main()
