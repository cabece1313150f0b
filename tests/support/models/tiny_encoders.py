"""Folders of encoders with the real files' layout and random weights, a few kB each: no test downloads anything."""

from __future__ import annotations

import json
import string
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from su3d_bench.core.types import UInt8Array

needs_models = pytest.mark.skipif(
    find_spec("torch") is None or find_spec("transformers") is None,
    reason="torch and transformers are not installed: pip install 'su3d-bench[models]'",
)
WORDS = ("chair", "table", "lamp", "a", "the", "in", "scene", "red", "cup", "image", "of", "an", "on", "tv", "screen")
N_TOKENS = 16
IMAGE_SIZE = 32
DIM = 24


def write_tiny_clip(folder: Path, seed: int = 0, weights: str = "model.safetensors") -> Path:
    """A CLIP of two layers as transformers saves it; ``weights`` may be ``pytorch_model.bin``, the older form."""
    import torch

    from su3d_bench.core.system.devices import require_transformers

    require_transformers("this test")  # quiet from here on
    from transformers import CLIPConfig, CLIPModel

    torch.manual_seed(seed)
    n_words = write_clip_tokenizer(folder)
    layers = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    config = CLIPConfig(
        vision_config={**layers, "image_size": IMAGE_SIZE, "patch_size": 8},
        text_config={
            **layers,
            "vocab_size": n_words,
            "max_position_embeddings": N_TOKENS,
            "bos_token_id": n_words - 2,
            "eos_token_id": n_words - 1,
            "pad_token_id": n_words - 1,
        },
        projection_dim=DIM,
    )
    model: Any = CLIPModel(config)
    _spread(model)
    model.save_pretrained(str(folder))
    if weights != "model.safetensors":
        torch.save(model.state_dict(), folder / weights)
        (folder / "model.safetensors").unlink()
    size = {"shortest_edge": IMAGE_SIZE}
    crop = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    _write_preprocessor(folder, {"size": size, "crop_size": crop, "do_center_crop": True})
    return folder


def write_tiny_siglip(folder: Path, seed: int = 0) -> Path:
    """A SigLIP of two layers as transformers saves it, with a ``tokenizer.json`` of whole words."""
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers

    from su3d_bench.core.system.devices import require_transformers

    require_transformers("this test")
    from transformers import SiglipConfig, SiglipModel

    torch.manual_seed(seed)
    folder.mkdir(parents=True, exist_ok=True)
    words = {word: k for k, word in enumerate(["<unk>", "</s>", *WORDS])}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))
    layers = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    config = SiglipConfig(
        vision_config={**layers, "image_size": IMAGE_SIZE, "patch_size": 8},
        text_config={**layers, "vocab_size": len(words), "max_position_embeddings": N_TOKENS, "pad_token_id": 1},
    )
    model: Any = SiglipModel(config)
    _spread(model)
    model.save_pretrained(str(folder))
    half = [0.5, 0.5, 0.5]
    size = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    _write_preprocessor(
        folder, {"size": size, "image_mean": half, "image_std": half, "image_processor_type": "SiglipImageProcessor"}
    )
    return folder


def _spread(model: Any) -> None:
    """Larger random weights than a fresh model has, so that different inputs give clearly different features."""
    import torch

    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.normal_(0.0, 0.2)


def write_clip_tokenizer(folder: Path) -> int:
    """``vocab.json`` and ``merges.txt`` of letters and ``WORDS``; returns the number of words."""
    folder.mkdir(parents=True, exist_ok=True)
    letters = string.ascii_lowercase + string.digits + "-"
    vocabulary = [*letters, *(f"{letter}</w>" for letter in letters)]
    merges: list[str] = []
    for word in WORDS:
        left = word[0] if len(word) > 1 else ""
        for place, letter in enumerate(word[1:], start=1):
            right = f"{letter}</w>" if place == len(word) - 1 else letter
            merges.append(f"{left} {right}")
            left += right
            vocabulary.append(left)
    vocabulary = list(dict.fromkeys(vocabulary))
    vocabulary += ["<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(dict.fromkeys(merges)) + "\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer"}))
    return len(vocabulary)


def _write_preprocessor(folder: Path, settings: dict[str, object]) -> None:
    from su3d_bench.perception.models.encoders.image_transform import CLIP_MEAN, CLIP_STD

    usual = {"image_mean": list(CLIP_MEAN), "image_std": list(CLIP_STD), "resample": 3, "do_resize": True}
    (folder / "preprocessor_config.json").write_text(json.dumps(usual | settings))


def noise_images(n: int, seed: int = 0) -> list[UInt8Array]:
    """RGB images of different sizes, one of them a single pixel high, in colours that differ."""
    random = np.random.default_rng(seed)
    sizes = [(1, 9), (50, 20), (33, 90), (64, 64), (120, 45)]
    return [
        random.integers(0, 256, (*sizes[k % len(sizes)], 3), dtype=np.uint8) // 2
        + random.integers(0, 128, 3, dtype=np.uint8)
        for k in range(n)
    ]
