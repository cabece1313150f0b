"""Files of settings and manifests of models, damaged byte by byte and value by value: read, or refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from damage import damages, outcomes

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
ODD = ("null", "-1", "1e999", "NaN", "1" + "0" * 30, '"../x"', "[[1]]", '{"x": [1]}')


def values_replaced(content: Any) -> Iterator[bytes]:
    """``content`` with each of its values, however deep, in turn replaced by each odd one."""
    mark = "@here@"

    def marked(value: Any) -> Iterator[Any]:
        yield mark
        if isinstance(value, dict):
            for key in value:
                yield from ({**value, key: inner} for inner in marked(value[key]))
        elif isinstance(value, list):
            for k, one in enumerate(value):
                yield from ([*value[:k], inner, *value[k + 1 :]] for inner in marked(one))

    for one in marked(content):
        text = json.dumps(one)
        yield from (text.replace(f'"{mark}"', odd).encode() for odd in ODD)


def encoder_spec(path: Path) -> object:
    """The spec of a folder whose other file of settings is whole."""
    for name, content in (("config.json", CONFIG), ("preprocessor_config.json", PREPROCESSOR)):
        if name != path.name:
            (path.parent / name).write_text(json.dumps(content))
    entry = model_entry("siglip-base-224")
    files = ModelFiles(entry, entry.form("transformers"), path.parent, path.parent / "model.safetensors")
    return transformers_spec(files, "original")


@pytest.mark.parametrize(
    ("name", "content", "read"),
    [
        ("manifest.json", ENCODER, EncoderManifest.read),
        ("manifest.json", SEGMENTER, SamManifest.read),
        ("config.json", CONFIG, encoder_spec),
        ("preprocessor_config.json", PREPROCESSOR, encoder_spec),
    ],
)
def test_damaged_settings_are_read_or_refused_in_one_line(
    tmp_path: Path, name: str, content: Any, read: Callable[[Path], object]
) -> None:
    path = tmp_path / name

    def reading(damaged: bytes) -> object:
        path.write_bytes(damaged)
        return read(path)

    whole = json.dumps(content).encode()
    assert outcomes(reading, iter([whole]), must_name="") == (1, 0)
    for copies in (damages(whole, 40), values_replaced(content)):
        _, n_refused = outcomes(reading, copies, must_name=str(tmp_path))
        assert n_refused > 10
