"""A 1200x680 image of a wall with 24 masks, used by several benchmarks."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import Detections, Frame

WIDTH, HEIGHT, FOCAL = 1200, 680, 600.0
DISTANCE_M = 2.5
VOXEL_M = 0.02


def view() -> tuple[Frame, Detections]:
    intrinsics = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    depth_m = np.full((HEIGHT, WIDTH), DISTANCE_M, np.float32)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    masks = np.zeros((24, HEIGHT, WIDTH), np.bool_)
    for k in range(24):
        row, column = divmod(k, 6)
        masks[k, 170 * row + 10 : 170 * row + 150, 200 * column + 10 : 200 * column + 180] = True
    n = len(masks)
    detections = Detections(
        frame_index=0,
        masks=masks,
        boxes=np.zeros((n, 4), np.float32),
        scores=np.full(n, 0.5, np.float32),
        names=("thing",) * n,
        captions=("",) * n,
        crop_ratios=(0.8, 1.0, 1.2),
        crop_features=np.ones((n, 3, 128), np.float32),
        global_feature=np.ones(128, np.float32),
    )
    return Frame(0, 0.0, rgb, depth_m, np.eye(4), intrinsics), detections
