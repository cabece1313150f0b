"""All corruptions, by address ``family/name``: a new one is a function and a row of its family's file."""

from __future__ import annotations

from su3d_bench.corruptions import calibration, depth, image, light, masks, names, poses, time
from su3d_bench.corruptions.model import Corruption

FAMILIES = (calibration, depth, poses, time, light, image, masks, names)
CORRUPTIONS: dict[str, Corruption] = {row.address: row for family in FAMILIES for row in family.ROWS}
