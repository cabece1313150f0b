"""The usual size of each model, against which small and large are judged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from su3d_bench.core.types import Float64Array

# litres of the bounding box: the median of 200 instances, seeds (7, 0) to (7, 199); a test measures them again
USUAL_VOLUME_L: Mapping[str, float] = {
    "chair": 247,
    "stool": 77.7,
    "bench": 194,
    "beanbag": 486,
    "sofa": 1.28e03,
    "bed": 2.78e03,
    "table": 849,
    "coffee_table": 234,
    "side_table": 133,
    "desk": 738,
    "nightstand": 122,
    "cabinet": 458,
    "base_cabinet": 406,
    "wall_cabinet": 174,
    "wardrobe": 1.67e03,
    "shelf": 512,
    "wall_shelf": 32.9,
    "tv_stand": 304,
    "plant_stand": 64.3,
    "door": 226,
    "window": 293,
    "curtain": 86.4,
    "blinds": 60.6,
    "switch": 0.671,
    "wall_plug": 0.52,
    "vent": 1.88,
    "pedestal_sink": 345,
    "kitchen_sink": 103,
    "toilet": 290,
    "bathtub": 741,
    "countertop": 24.8,
    "towel_rail": 24.7,
    "folded_towel": 9.33,
    "rolled_towel": 6.91,
    "refrigerator": 791,
    "cooktop": 8.76,
    "microwave": 57.7,
    "tv_screen": 148,
    "wall_tv": 40.2,
    "monitor": 48.5,
    "laptop": 27.8,
    "keyboard": 2,
    "mouse": 0.603,
    "desktop_computer": 41.2,
    "table_lamp": 41.4,
    "floor_lamp": 271,
    "desk_lamp": 20.9,
    "ceiling_lamp": 71.1,
    "indoor_plant": 72.2,
    "vase": 11.4,
    "picture": 6.87,
    "clock": 3.91,
    "candle": 5.23,
    "sculpture": 10.7,
    "books": 7.15,
    "book_stack": 5.43,
    "cardboard_box": 37.3,
    "basket": 87.8,
    "bin_": 40.7,
    "exercise_ball": 215,
    "cushion": 36.6,
    "flat_cushion": 22.9,
    "pillow": 36.6,
    "blanket": 24,
    "rolled_blanket": 13.9,
    "rug": 28.7,
    "mat": 8.71,
    "backpack": 60,
    "umbrella": 19,
    "pan": 9.73,
    "pot": 16.2,
    "plate": 1.63,
    "bowl": 3.65,
    "cup": 1.23,
    "bottle": 2.17,
    "chopping_board": 3.64,
    "knife_block": 6.25,
    "paper_towel": 8.84,
    "tissue_box": 5.66,
}
SMALL_BELOW, LARGE_ABOVE = 0.78, 1.28  # of the usual volume: about the outer quarters of the models that vary


def size_word(model: str, size: Float64Array) -> str:
    """small, medium or large, for a box of sides ``size`` metres."""
    share = 1000.0 * float(np.prod(size)) / USUAL_VOLUME_L[model]
    return "small" if share < SMALL_BELOW else "large" if share > LARGE_ABOVE else "medium"
