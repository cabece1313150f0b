"""Preprocessing of images and texts for encoders: equal to the originals to the bit, without skipped steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_models import CLIP_PX, N_TOKENS, noise_images, write_clip_tokenizer

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.system.devices import Batches, device_for, precision_for
from su3d_bench.core.types import Float32Array
from su3d_bench.perception.models.encoders.images import ImageTransform, read_transform
from su3d_bench.perception.models.encoders.texts import canonical_text


def test_centre_crop_window_is_rounded_as_in_each_library() -> None:
    # 7 wide after the resize, 4 kept: a surplus of 3. torchvision: round(1.5) = 2; transformers: 3 // 2 = 1.
    columns = np.arange(7, dtype=np.uint8) * 10
    image = np.tile(columns[None, :, None], (4, 1, 3))
    plain = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
    original = ImageTransform(4, **plain).pixels([image])  # type: ignore[arg-type]
    other = ImageTransform(4, convention="transformers", **plain).pixels([image])  # type: ignore[arg-type]
    assert np.array_equal(np.rint(original[0, 0, 0] * 255), [20, 30, 40, 50])
    assert np.array_equal(np.rint(other[0, 0, 0] * 255), [10, 20, 30, 40])


def test_clip_images_match_transformers_to_the_bit() -> None:
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    side = {"height": CLIP_PX, "width": CLIP_PX}
    theirs = CLIPImageProcessorPil(size={"shortest_edge": CLIP_PX}, crop_size=side)
    ours = ImageTransform(CLIP_PX, convention="transformers")
    random = np.random.default_rng(5)
    for _ in range(40):
        image = random.integers(0, 256, (*random.integers(1, 90, 2), 3), dtype=np.uint8)
        answer = theirs(images=[image], return_tensors="np", input_data_format="channels_last")["pixel_values"]
        assert np.array_equal(ours.pixels([image]), answer), image.shape


def test_siglip_images_match_transformers_to_the_bit() -> None:
    from transformers.models.siglip.image_processing_pil_siglip import SiglipImageProcessorPil

    theirs = SiglipImageProcessorPil(size={"height": CLIP_PX, "width": CLIP_PX})
    ours = ImageTransform(CLIP_PX, "squash", (0.5,) * 3, (0.5,) * 3, convention="transformers")
    for image in noise_images(5):
        answer = theirs(images=[image], return_tensors="np", input_data_format="channels_last")["pixel_values"]
        assert np.array_equal(ours.pixels([image]), answer), image.shape


def test_old_and_new_processor_files_give_the_same_transform(tmp_path: Path) -> None:
    path = tmp_path / "preprocessor_config.json"
    usual = {"image_mean": [0.1, 0.2, 0.3], "image_std": [1, 2, 3], "resample": 3}
    path.write_text(json.dumps(usual | {"size": 224, "crop_size": 224, "do_center_crop": True}))
    expected = ImageTransform(224, "shortest", (0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    assert read_transform(path, "original") == expected
    crop = {"height": 224, "width": 224}
    path.write_text(json.dumps(usual | {"size": {"shortest_edge": 224}, "crop_size": crop, "do_center_crop": True}))
    assert read_transform(path, "original") == expected
    path.write_text(json.dumps(usual | {"size": crop, "image_processor_type": "SiglipImageProcessor"}))
    assert read_transform(path, "original").fit == "squash"


@pytest.mark.parametrize(
    ("change", "printed"),
    [
        ({"do_normalize": False}, "do_normalize is False"),
        ({"rescale_factor": 1}, "rescale_factor is 1"),
        ({"size": {"longest_edge": 9}}, "expected a shortest edge"),
        ({"image_std": [0, 1, 1]}, r"std\.0 is 0"),
        ({"image_std": [1, float("nan"), 1]}, r"std\.1 is nan"),
    ],
)
def test_processor_file_with_unusual_steps_is_rejected(tmp_path: Path, change: dict[str, Any], printed: str) -> None:
    path = tmp_path / "preprocessor_config.json"
    usual = {"size": 32, "crop_size": 32, "image_mean": [0, 0, 0], "image_std": [1, 1, 1], "do_center_crop": True}
    path.write_text(json.dumps(usual | change))
    with pytest.raises(DataError, match=printed):
        read_transform(path, "original")


# ---- texts


def test_siglip_texts_lose_capitals_and_punctuation() -> None:
    assert canonical_text(" A  TV-screen, in the scene. ") == "a tvscreen in the scene"


def test_long_texts_are_truncated_and_keep_their_end_token(tmp_path: Path) -> None:
    from su3d_bench.perception.models.encoders.texts import read_tokeniser

    write_clip_tokenizer(tmp_path)
    words = json.loads((tmp_path / "vocab.json").read_text())
    tokens = read_tokeniser(tmp_path, "clip", N_TOKENS, None, len(words))(["chair", "chair " * 50])
    end = words["<|endoftext|>"]
    assert tokens.shape == (2, N_TOKENS)
    assert tokens[0, :3].tolist() == [words["<|startoftext|>"], words["chair</w>"], end]
    assert tokens[1, -1] == end
    assert (tokens[1, 1:-1] == words["chair</w>"]).all()


def test_batches_are_halved_when_memory_runs_out() -> None:
    import torch

    seen: list[int] = []

    def work(batch: Any) -> Float32Array:
        seen.append(len(batch))
        if len(batch) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return np.asarray(batch, np.float32)

    batches = Batches(8)
    assert np.concatenate(batches.run(range(7), work)).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert seen == [7, 3, 3, 1]
    assert batches.size == 3


def test_jobs_are_assigned_to_gpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0) if device == "cuda:0" else (6, 1))
    assert [device_for("cuda", k) for k in range(5)] == ["cuda:0", "cuda:1", "cuda:2", "cuda:0", "cuda:1"]
    assert device_for("cuda:1", 7) == "cuda:1"
    with pytest.raises(ConfigError, match="this machine has 3 GPUs"):
        device_for("cuda:3", 0)
    assert precision_for("auto", "cuda:0") == "float16"
    assert precision_for("auto", "cuda:1") == "float32"
    assert precision_for("bfloat16", "cuda:1") == "bfloat16"


def test_cpu_uses_float32_and_missing_gpu_gives_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    assert device_for("cpu", 3) == "cpu"
    assert precision_for("auto", "cpu") == "float32"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="torch finds no GPU"):
        device_for("cuda", 0)
