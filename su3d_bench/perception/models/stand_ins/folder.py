"""A folder of models, as ``$SU3D_MODELS`` names one, filled with tiny networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from su3d_bench.core.errors import ConfigError, some
from su3d_bench.perception.models.stand_ins.detector import ROOM_WORDS, sparing_dino, write_detector
from su3d_bench.perception.models.stand_ins.encoders import write_tiny_clip
from su3d_bench.perception.models.stand_ins.segmenter import write_checkpoint
from su3d_bench.perception.models.stand_ins.tagger import write_tagger

CLIP_TOKENS = 77  # as published, so that no text is cut that the published one would read whole
SAM_FILE = "sam_vit_h_4b8939.pth"
TAGS = tuple(word for word in ROOM_WORDS if len(word) > 1 and word[0].isalpha() and word not in ("other", "item"))
_WRITERS: Mapping[str, Callable[[Path], object]] = {
    "clip-vit-h-14": lambda root: write_tiny_clip(root / "clip-vit-h-14", 14, n_tokens=CLIP_TOKENS),
    "clip-vit-l-14-336": lambda root: write_tiny_clip(root / "clip-vit-l-14-336", 336, n_tokens=CLIP_TOKENS),
    "sam-vit-h": lambda root: write_checkpoint(root / "sam-vit-h" / SAM_FILE),
    "grounding-dino": lambda root: write_detector(root / "grounding-dino", sparing_dino(), ROOM_WORDS),
    "ram-plus": lambda root: write_tagger(root / "ram-plus-onnx", TAGS),
}
STAND_INS = tuple(_WRITERS)


def write_stand_ins(root: Path, *names: str) -> Path:
    """The models ``names``, or all of ``STAND_INS``, where they are looked for below ``root``.

    RAM++ comes as its export, the others as they are published; a ``ConfigError`` for a name that has none. The same
    machine writes the same weights again.
    """
    for name in names or STAND_INS:
        if name not in _WRITERS:
            raise ConfigError(f"model '{name}': no tiny network stands in for it; there are {some(STAND_INS, 9)}")
        _WRITERS[name](root)
    return root
