"""Numba kernel that colours a rendering, which sheets do hundreds of times."""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.compiled import njit


@njit(cache=True)
def averaged_colours(point: Any, shade: Any, palette: Any, steps: int) -> Any:
    """The mean colour (h / steps, w / steps, 3) of blocks of pixels, in the order in which numpy would add them.

    ``palette`` (N + 1, 3) float32 ends with the background, which is shown where ``point`` (h, w) is -1.
    """
    height, width = point.shape[0] // steps, point.shape[1] // steps
    background = palette.shape[0] - 1
    picture = np.empty((height, width, 3), np.uint8)
    total = np.empty(3, np.float32)
    for row in range(height):
        for column in range(width):
            total[:] = 0.0
            for y in range(row * steps, (row + 1) * steps):
                for x in range(column * steps, (column + 1) * steps):
                    place = point[y, x]
                    light = shade[y, x]
                    if place < 0:
                        place, light = background, np.float32(1.0)
                    for c in range(3):
                        total[c] += palette[place, c] * light
            for c in range(3):
                picture[row, column, c] = np.uint8(np.rint(total[c] / np.float32(steps * steps)))
    return picture
