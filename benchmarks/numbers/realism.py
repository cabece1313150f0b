"""Image statistics of generated scenes beside those of real recordings, as a Markdown table.

``python benchmarks realism SCENE ... [NAME=COLOURS,DEPTHS,UNITS_PER_METRE ...] [--frames N] [--sheet FILE.png]``; a
scene is an address such as homes/test0, or homes/test0+test1 for several together, a recording two patterns of image
files. Frames are evenly spaced and scaled to 640 columns. ``--sheet`` draws up to twelve frames of each in a row.
"""

from __future__ import annotations

import argparse
import glob
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from su3d_bench.core import registry
from su3d_bench.core.types import Float32Array, Frame, UInt8Array
from su3d_bench.datasets.homes.statistics import view_statistics
from su3d_bench.formats.images import decode_colour, decode_depth, read_bytes
from su3d_bench.runs.scenes import data_root

WIDTH, BLOCK = 640, 8
FLAT = 1.0  # standard deviation of luma, 0..255, below which a block has no texture
MAX_FEATURES = 5000
COLUMNS = ("ORB features", "flat blocks", "saturated pixels", "mean saturation", "missing depth")


@dataclass(frozen=True)
class Source:
    """Images of a kind: colour (H, W, 3) and depth (H, W) m, 0 where missing."""

    name: str
    images: Sequence[tuple[UInt8Array, Float32Array]]


def measured(rgb: UInt8Array, depth_m: Float32Array) -> list[float]:
    """The values of ``COLUMNS`` for one image, shares as per cent."""
    height = round(rgb.shape[0] * WIDTH / rgb.shape[1])
    image = np.asarray(cv2.resize(rgb, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    features = cv2.ORB_create(MAX_FEATURES).detect(grey, None)  # type: ignore[attr-defined]
    rows, columns = (side // BLOCK for side in grey.shape)
    blocks = grey[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).astype(np.float64)
    flat = blocks.std(axis=(1, 3)) < FLAT
    saturated = (image >= 254).any(axis=-1) | (image <= 1).all(axis=-1)
    saturation = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)[..., 1] / 255.0
    shares = (flat.mean(), saturated.mean(), saturation.mean(), (depth_m <= 0).mean())
    return [float(len(features)), *(100.0 * float(share) for share in shares)]


def scene_source(address: str, n: int) -> Source:
    name, _, scenes = address.partition("/")
    dataset = registry.load("dataset", name)(data_root())
    images = []
    for scene in scenes.split("+"):
        frames: Sequence[Frame] = dataset.frames(scene, 1)
        chosen = np.linspace(0, len(frames) - 1, n // (scenes.count("+") + 1)).astype(int)
        images += [(frame.rgb, frame.depth_m) for frame in map(frames.__getitem__, chosen)]
    return Source(address, images)


def recording_source(text: str, n: int) -> Source:
    name, _, rest = text.partition("=")
    colours, depths, units = rest.split(",")
    pairs = list(zip(sorted(glob.glob(colours)), sorted(glob.glob(depths)), strict=True))
    chosen = [pairs[int(k)] for k in np.linspace(0, len(pairs) - 1, min(n, len(pairs)))]
    images = [(decode_colour(read_bytes(Path(c), c), c), decode_depth(read_bytes(Path(d), d), d)) for c, d in chosen]
    return Source(name, [(rgb, (depth / float(units)).astype(np.float32)) for rgb, depth in images])


def table(sources: Sequence[Source]) -> Iterator[str]:
    yield f"| | {' | '.join(COLUMNS)} |"
    yield "|---|" + "---|" * len(COLUMNS)
    for source in sources:
        values = np.median([measured(*image) for image in source.images], axis=0)
        cells = [f"{values[0]:.0f}", *(f"{value:.1f} %" for value in values[1:])]
        yield f"| {source.name} ({len(source.images)}) | {' | '.join(cells)} |"


def motion(addresses: Sequence[str], stride: int) -> Iterator[str]:
    """Objects per view and motion per update of generated scenes."""
    yield f"\n| per update, stride {stride} | objects | in view | translation | rotation |"
    yield "|---|---|---|---|---|"
    for name, scene in ((a.partition("/")[0], b) for a in addresses for b in a.partition("/")[2].split("+")):
        row = view_statistics(registry.load("dataset", name)(data_root()), scene, stride)
        yield (
            f"| {name}/{scene} | {row['instances']} | {row['instances_per_view']:.0f} | "
            f"{row['translation_cm']:.0f} cm | {row['rotation_deg']:.0f} degrees |"
        )


def sheet(sources: Sequence[Source], path: Path) -> None:
    tile = (213, 160)
    rows = [
        np.concatenate([cv2.resize(rgb, tile, interpolation=cv2.INTER_AREA) for rgb, _ in source.images[:12]], axis=1)
        for source in sources
    ]
    widest = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 4), (0, widest - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    cv2.imwrite(str(path), np.concatenate(padded)[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--stride", type=int, default=40)
    parser.add_argument("--sheet", type=Path)
    given = parser.parse_args()
    scenes = [text for text in given.sources if "=" not in text]
    sources = [
        recording_source(text, given.frames) if "=" in text else scene_source(text, given.frames)
        for text in given.sources
    ]
    for line in (*table(sources), *motion(scenes, given.stride)):
        print(line)
    if given.sheet:
        sheet(sources, given.sheet)


if __name__ == "__main__":
    main()
