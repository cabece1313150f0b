"""Draw ``docs/pictures/corruptions.jpg``: one tile per corruption at severity 4, and the clean inputs.

python tools/docs/draw_corruptions.py
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.types import Detections, Float64Array, Frame, Int64Array, UInt8Array
from su3d_bench.corruptions.model import Recording, generator
from su3d_bench.corruptions.table import CORRUPTIONS
from su3d_bench.datasets.homes.dataset import HomeOptions, Homes

SCENE, INDEX, SEVERITY = "tuning3", 120, 4
COLUMNS, WIDTH, HEIGHT, TITLE = 8, 200, 150, 22
OUT = Path(__file__).parents[2] / "docs" / "pictures" / "corruptions.jpg"
FAR_M = 6.0


def main() -> None:
    import cv2

    homes = Homes(Path(tempfile.mkdtemp()), HomeOptions())
    poses, frames = homes.poses(SCENE), homes.frames(SCENE, 1)
    frame, found = frames[INDEX], _detections(homes, INDEX)
    places, names = np.arange(0, len(frames), 10), tuple(homes.label_set().names)
    tiles = [("colour", frame.rgb), ("depth", _depth(frame)), ("masks", _masks(found)), ("poses", _path(poses, poses))]
    for corruption in CORRUPTIONS.values():
        value, rng = corruption.value_at(SEVERITY), generator(corruption, 0, f"homes/{SCENE}", INDEX)
        change: Callable[..., Any] = corruption.function
        if corruption.stage == "frame":
            changed: Frame = change(frame, value, rng, Recording(frames, poses, INDEX))
            shows_depth = corruption.family in ("depth", "calibration") or corruption.name == "depth-lag"
            picture = _overlay(changed) if corruption.family == "calibration" else changed.rgb
            picture = _depth(changed) if shows_depth and corruption.family == "depth" else picture
            picture = _overlay(changed) if corruption.name.endswith("-lag") else picture
        elif corruption.stage == "poses":
            picture = _path(change(poses, value, rng), poses)
        elif corruption.stage == "order":
            picture = _order(change(places, value, rng), len(frames))
        elif corruption.stage == "detections":
            picture = _masks(change(found, value, rng))
        else:
            picture = _names(change(names, value, rng), names)
        tiles.append((corruption.address, picture))
    n_rows = -(-len(tiles) // COLUMNS)
    sheet = np.full((n_rows * (HEIGHT + TITLE), COLUMNS * WIDTH, 3), 255, np.uint8)
    for k, (title, picture) in enumerate(tiles):
        top, left = k // COLUMNS * (HEIGHT + TITLE), k % COLUMNS * WIDTH
        small = cv2.resize(picture, (WIDTH - 4, HEIGHT), interpolation=cv2.INTER_AREA)
        sheet[top + TITLE : top + TITLE + HEIGHT, left : left + WIDTH - 4] = small
        _write(sheet, title, left + 2, top + 15, 0.4)
    cv2.imwrite(str(OUT), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


def _write(image: UInt8Array, text: str, x: int, y: int, size: float) -> None:
    import cv2

    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)


def _depth(frame: Frame) -> UInt8Array:
    """Nearer is brighter, missing is black."""
    import cv2

    scaled = np.clip(255 * (1 - frame.depth_m / FAR_M), 30, 255).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    return np.asarray(np.where(frame.depth_m[..., None] > 0, coloured, 0), np.uint8)


def _overlay(frame: Frame) -> UInt8Array:
    """Edges of depth in red on colour."""
    from su3d_bench.corruptions.sensors.depth import edges

    picture = frame.rgb.copy()
    picture[edges(frame.depth_m)] = (255, 0, 0)
    return picture


def _masks(found: Detections) -> UInt8Array:
    colours = np.random.default_rng(1).integers(60, 255, (len(found) + 1, 3))
    picture = np.full((*found.masks.shape[1:], 3), 30, np.uint8)
    for mask, colour in zip(found.masks, colours, strict=False):
        picture[mask] = colour
    return picture


def _path(poses: Float64Array, clean: Float64Array) -> UInt8Array:
    """The trajectory from above, the clean one in grey."""
    import cv2

    picture = np.full((300, 400, 3), 255, np.uint8)
    low, high = clean[:, :2, 3].min(axis=0), clean[:, :2, 3].max(axis=0)
    scale = 0.85 * min(400 / (high - low)[0], 300 / (high - low)[1])
    for path, colour in ((clean, (170, 170, 170)), (poses, (0, 80, 200))):
        at = np.int32((path[:, :2, 3] - (low + high) / 2) * scale + [200, 150])
        cv2.polylines(picture, [at[:, None]], False, colour, 2, cv2.LINE_AA)
        ahead = np.int32(at + 14 * path[:, :2, 2])
        for start, end in list(zip(at.tolist(), ahead.tolist(), strict=True))[::20]:
            cv2.line(picture, start, end, colour, 1, cv2.LINE_AA)
    return picture


def _order(places: Int64Array, n: int) -> UInt8Array:
    """Frame against time."""
    picture = np.full((300, 400, 3), 255, np.uint8)
    for k, place in enumerate(places):
        x, y = 10 + int(380 * k / max(len(places), n // 10)), 290 - int(280 * place / n)
        picture[max(y - 4, 0) : y + 4, max(x - 4, 0) : x + 4] = (0, 80, 200)
    return picture


def _names(names: tuple[str, ...], clean: tuple[str, ...]) -> UInt8Array:
    picture = np.full((300, 400, 3), 255, np.uint8)
    changed = [(old, new) for old, new in zip(clean, names, strict=False) if old != new][:9]
    lines = [f"{old} > {new}" for old, new in changed] or [f"+ {name}" for name in names[len(clean) :][:9]]
    for k, line in enumerate(lines):
        _write(picture, line[:38], 8, 30 + 31 * k, 0.62)
    return picture


def _detections(homes: Homes, index: int) -> Detections:
    """Perfect masks of a frame."""
    instance = homes.render(SCENE, index).instance
    ids = [k for k in np.unique(instance).tolist() if k and (instance == k).sum() > 60]
    masks = np.stack([instance == k for k in ids])
    n = len(ids)
    return Detections(
        index, masks, np.zeros((n, 4), np.float32), np.linspace(0.3, 1, n, dtype=np.float32), ("",) * n, ("",) * n,
        (1.0,), np.ones((n, 1, 1), np.float32), np.ones(1, np.float32),
    )  # fmt: skip


if __name__ == "__main__":
    main()
