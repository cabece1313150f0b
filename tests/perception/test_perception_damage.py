"""Damaged external files are read by perception, or rejected in one line that names the file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from damage import damages, outcomes
from perception_fakes import CountingEncoder, still_life
from test_perception_stored import written
from test_perception_stored_images import images, write_image

from su3d_bench.perception.models.catalogue import model_entry
from su3d_bench.perception.models.encoders.encoder import transformers_spec
from su3d_bench.perception.models.files import ModelFiles
from su3d_bench.perception.models.masks.grounded_sam import RAM_FORMAT, exported_files, read_word_list
from su3d_bench.perception.stored import read_stored
from su3d_bench.perception.stored_masks import read_names

TAGGER = {
    "format": RAM_FORMAT, "name": "ram-plus", "files": {"ram_plus.onnx": "0" * 64, "ram_tag_list.txt": "1" * 64},
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
    """The spec of a folder whose other settings file is valid."""
    for name, content in (("config.json", CONFIG), ("preprocessor_config.json", PREPROCESSOR)):
        if name != path.name:
            (path.parent / name).write_text(json.dumps(content))
    entry = model_entry("siglip-base-224")
    files = ModelFiles(entry, entry.form("transformers"), path.parent, path.parent / "model.safetensors")
    return transformers_spec(files, "original")


@pytest.mark.parametrize(
    ("name", "content", "read"),
    [
        ("manifest.json", json.dumps(TAGGER), exported_files),
        ("config.json", json.dumps(CONFIG), encoder_spec),
        ("preprocessor_config.json", json.dumps(PREPROCESSOR), encoder_spec),
        ("names.toml", '48 = "book"\n132 = "box of things"\n', lambda path: read_names(path, "rgbd/desk")),
        ("words.txt", "# things\nchair\ncoffee table\n", read_word_list),
    ],
    ids=["tagger", "config", "preprocessor", "names", "words"],
)
def test_damaged_texts_are_read_or_rejected(
    tmp_path: Path, name: str, content: str, read: Callable[[Path], object]
) -> None:
    path = tmp_path / name
    check(path, content.encode(), lambda: read(path))


def test_damaged_arrays_and_images_are_read_or_rejected(tmp_path: Path) -> None:
    stored = written(tmp_path, with_features=False)
    check(stored, stored.read_bytes(), lambda: read_stored(stored, still_life(40), CountingEncoder()), named="frame 40")
    image = write_image(tmp_path / "labels")
    source = images(tmp_path / "labels")
    check(image, image.read_bytes(), lambda: source.frame(still_life(40)))


def check(path: Path, whole: bytes, read: Callable[[], object], named: str = "") -> None:
    def reading(content: bytes) -> object:
        path.write_bytes(content)
        return read()

    assert outcomes(reading, iter([whole]), must_name="") == (1, 0)
    outcomes(reading, damages(whole, 40), must_name=named or path.name)
