"""Images and words with which tests run the tiny networks of ``perception.models.stand_ins``."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.core.types import Frame, UInt8Array
from su3d_bench.perception.models.stand_ins.detector import write_detector
from su3d_bench.perception.models.stand_ins.segmenter import tiny_sam

needs_models = pytest.mark.skipif(
    find_spec("torch") is None or find_spec("transformers") is None,
    reason="torch and transformers are not installed: pip install 'su3d-bench[models]'",
)
DINO_PX = (48, 80)


def write_models(root: Path) -> Path:
    """Folders of tiny SAM and GroundingDINO in the hub's form under the names that they are looked for."""
    tiny_sam().save_pretrained(root / "sam-vit-h")
    (root / "sam-vit-h" / "preprocessor_config.json").write_text("{}")
    write_detector(root / "grounding-dino")
    return root


def paper_words(models: Path, out: Path, scene: str, settings: Sequence[str] = (), *words: str) -> list[str]:
    """``su3d-bench run --profile paper`` on the models of ``write_models``, over two small images of a scene."""
    lenient = [f"models.folder={models}", "models.encoder=embedded", "paper.n_tags=6"]
    # Random masks are scattered over the image; their own boxes would be too large to count.
    lenient += ["paper.grounded.boxes.box_threshold=0.3", "paper.grounded.region_boxes=detector"]
    lenient += ["paper.automatic.points_per_side=2", "paper.automatic.pred_iou_thresh=0"]
    lenient += ["paper.automatic.stability_score_thresh=0", "paper.automatic.box_nms_thresh=1.0"]
    if scene.startswith("rooms/"):
        settings = (*settings, "rooms.width=160", "rooms.height=120", "rooms.mesh_spacing_m=0.1")
        words = (*words, "--protocols", "rooms-semantic")
    options = ["--scenes", scene, "--profile", "paper", "--limit", "2", "--no-pictures", "--jobs", "1", "--quiet"]
    return ["run", *options, *words, "--out", str(out), "--set", *(f"perception.{one}" for one in lenient), *settings]


def blocks(height: int, width: int, seed: int = 0, cell: int = 8) -> UInt8Array:
    """An image of coloured squares."""
    random = np.random.default_rng(seed)
    small = random.integers(0, 256, (-(-height // cell), -(-width // cell), 3), dtype=np.uint8)
    return np.ascontiguousarray(small.repeat(cell, 0).repeat(cell, 1)[:height, :width])


def frame_of(rgb: UInt8Array, index: int = 0) -> Frame:
    """A frame that shows ``rgb`` on a wall 2 m away."""
    intrinsics = np.array([[100.0, 0, rgb.shape[1] / 2], [0, 100.0, rgb.shape[0] / 2], [0, 0, 1]])
    return Frame(index, 0.0, rgb, np.full(rgb.shape[:2], 2, np.float32), np.eye(4), intrinsics)


def noise_images(n: int, seed: int = 0) -> list[UInt8Array]:
    """RGB images of different sizes, one of them a single pixel high, in colours that differ."""
    random = np.random.default_rng(seed)
    sizes = [(1, 9), (50, 20), (33, 90), (64, 64), (120, 45)]
    return [
        random.integers(0, 256, (*sizes[k % len(sizes)], 3), dtype=np.uint8) // 2
        + random.integers(0, 128, 3, dtype=np.uint8)
        for k in range(n)
    ]
