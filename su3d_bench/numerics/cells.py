"""An open-addressing hash of cells of a grid, compiled; imported only when a map is made.

``table`` holds rows of ``keys`` (N, 3), the cells' coordinates, or ABSENT; its length is a power of two above N.
"""

from __future__ import annotations

import numpy as np

from su3d_bench.core.compiled import njit

ABSENT = -1


@njit(cache=True, inline="always")
def slot_of(table, keys, x, y, z):  # type: ignore[no-untyped-def]
    """Where the cell is in ``table``, or the free slot where it belongs."""
    size = np.uint64(len(table) - 1)
    mixed = (
        np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
        ^ np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ np.uint64(z) * np.uint64(0x165667B19E3779F9)
    )
    slot = (mixed ^ (mixed >> np.uint64(32))) & size
    while True:
        row = table[slot]
        if row == ABSENT or (keys[row, 0] == x and keys[row, 1] == y and keys[row, 2] == z):
            return slot
        slot = (slot + np.uint64(1)) & size
