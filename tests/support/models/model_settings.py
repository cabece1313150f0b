"""Files of settings and manifests of models, whole, which the fuzzer damages."""

from __future__ import annotations

import json
from pathlib import Path

from su3d_bench.perception.models.catalogue import model_entry
from su3d_bench.perception.models.encoders.towers import EncoderManifest, transformers_spec
from su3d_bench.perception.models.files import ModelFiles
from su3d_bench.perception.models.masks.sam import SamManifest

TRANSFORM = {
    "size": 32, "fit": "shortest", "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5], "resample": 3,
    "convention": "original",
}  # fmt: skip
ENCODER = {
    "format": EncoderManifest.FORMAT, "name": "clip-vit-h-14",
    "spec": {"dim": 24, "n_tokens": 16, "n_words": 90, "tokens": "clip", "pad_id": None, "transform": TRANSFORM},
    "files": {"image.onnx": "0" * 64, "text.onnx": "1" * 64},
}  # fmt: skip
SEGMENTER = {
    "format": SamManifest.FORMAT, "name": "sam-vit-h", "image_px": 64,
    "files": {"encoder.onnx": "0" * 64, "decoder.onnx": "1" * 64},
}  # fmt: skip
CONFIG = {
    "model_type": "siglip", "vision_config": {"image_size": 32, "patch_size": 8, "hidden_size": 32},
    "text_config": {"vocab_size": 90, "max_position_embeddings": 16, "hidden_size": 32, "pad_token_id": 1},
}  # fmt: skip
PREPROCESSOR = {
    "size": {"shortest_edge": 32}, "crop_size": {"height": 32, "width": 32}, "image_mean": [0.5, 0.5, 0.5],
    "image_std": [0.5, 0.5, 0.5], "resample": 3, "do_resize": True, "rescale_factor": 1 / 255,
}  # fmt: skip


def encoder_spec(path: Path) -> object:
    """The spec of a folder whose other file of settings is whole."""
    for name, content in (("config.json", CONFIG), ("preprocessor_config.json", PREPROCESSOR)):
        if name != path.name:
            (path.parent / name).write_text(json.dumps(content))
    entry = model_entry("siglip-base-224")
    files = ModelFiles(entry, entry.form("transformers"), path.parent, path.parent / "model.safetensors")
    return transformers_spec(files, "original")
