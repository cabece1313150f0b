"""Encoders of a few kB with random weights, in folders as the hub has them."""

from __future__ import annotations

import json
import string
from pathlib import Path
from typing import Any

from su3d_bench.core.system.devices import require, require_transformers
from su3d_bench.perception.models.encoders.image_transform import CLIP_MEAN, CLIP_STD

WORDS = ("chair", "table", "lamp", "a", "the", "in", "scene", "red", "cup", "image", "of", "an", "on", "tv", "screen")
N_TOKENS = 16
IMAGE_SIZE = 32
DIM = 24


def write_tiny_clip(folder: Path, seed: int = 0, weights: str = "model.safetensors", n_tokens: int = N_TOKENS) -> Path:
    """A CLIP of two layers as transformers saves it; ``weights`` may be ``pytorch_model.bin``, the older form."""
    import torch

    transformers = require_transformers("a stand-in of CLIP")
    torch.manual_seed(seed)
    n_words = write_clip_tokenizer(folder)
    layers = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    config = transformers.CLIPConfig(
        vision_config={**layers, "image_size": IMAGE_SIZE, "patch_size": 8},
        text_config={
            **layers,
            "vocab_size": n_words,
            "max_position_embeddings": n_tokens,
            "bos_token_id": n_words - 2,
            "eos_token_id": n_words - 1,
            "pad_token_id": n_words - 1,
        },
        projection_dim=DIM,
    )
    model: Any = transformers.CLIPModel(config)
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

    tokenizers = require("tokenizers", "a stand-in of SigLIP")

    transformers = require_transformers("a stand-in of SigLIP")
    torch.manual_seed(seed)
    folder.mkdir(parents=True, exist_ok=True)
    words = {word: k for k, word in enumerate(["<unk>", "</s>", *WORDS])}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))
    layers = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    config = transformers.SiglipConfig(
        vision_config={**layers, "image_size": IMAGE_SIZE, "patch_size": 8},
        text_config={**layers, "vocab_size": len(words), "max_position_embeddings": N_TOKENS, "pad_token_id": 1},
    )
    model: Any = transformers.SiglipModel(config)
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
    usual = {"image_mean": list(CLIP_MEAN), "image_std": list(CLIP_STD), "resample": 3, "do_resize": True}
    (folder / "preprocessor_config.json").write_text(json.dumps(usual | settings))
