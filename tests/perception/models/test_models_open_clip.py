"""Encoders through open_clip: a small stand-in for the package, with only the functions that are called."""

from __future__ import annotations

import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_models import noise_images

from su3d_bench.core.errors import ModelMissing
from su3d_bench.core.interfaces import Encoder
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.encoders.images import ImageTransform
from su3d_bench.perception.models.loading import load_encoder

SIZE, DIM, WORDS = 8, 6, 300


def _tiny(seed: int) -> Any:
    """A linear tower for pixels and a sum of word vectors for texts, with open_clip's methods."""
    import torch

    torch.manual_seed(seed)

    class TwoTowers(torch.nn.Module):  # type: ignore[misc, name-defined, unused-ignore]
        def __init__(self) -> None:
            super().__init__()
            self.visual = torch.nn.Linear(3 * SIZE * SIZE, DIM)
            self.words = torch.nn.Embedding(WORDS, DIM)

        def encode_image(self, pixels: Any) -> Any:
            return self.visual(pixels.flatten(1))

        def encode_text(self, tokens: Any) -> Any:
            return self.words(tokens).sum(1)

    return TwoTowers()


def _tokens(texts: Sequence[str]) -> Any:
    import torch

    return torch.tensor([[ord(letter) % WORDS for letter in text.ljust(77)[:77]] for text in texts])


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The stand-in installed as ``open_clip``; the architectures that were requested from it."""
    asked: list[str] = []

    def create_model(name: str, pretrained: None, precision: str, device: str) -> Any:
        assert (pretrained, precision, device) == (None, "fp32", "cpu")
        asked.append(name)
        return _tiny(seed=99)

    def get_model_config(name: str) -> dict[str, Any] | None:
        known = {"embed_dim": DIM, "vision_cfg": {"image_size": SIZE}, "text_cfg": {"vocab_size": WORDS}}
        return known if name in ("ViT-H-14", "ViT-L-14-336-quickgelu") else None

    module = types.ModuleType("open_clip")
    vars(module).update(
        __version__="0",
        create_model=create_model,
        get_model_config=get_model_config,
        get_tokenizer=lambda name: _tokens,
    )
    monkeypatch.setitem(sys.modules, "open_clip", module)
    return asked


def _write(folder: Path, name: str, seed: int = 0, file: str = "open_clip_model.safetensors") -> Any:
    import torch
    from safetensors.torch import save_file

    model = _tiny(seed)
    (folder / name).mkdir(parents=True)
    if file.endswith(".safetensors"):
        save_file(model.state_dict(), folder / name / file)
    else:
        torch.save(model.state_dict(), folder / name / file)
    return model


def _encoder(folder: Path, name: str = "clip-vit-h-14", **settings: Any) -> Encoder:
    return load_encoder(ModelsConfig(encoder=name, folder=folder, runtime="open_clip", **settings))


@pytest.mark.parametrize("file", ["open_clip_model.safetensors", "open_clip_pytorch_model.bin"])
def test_features_match_the_weights_in_the_file(tmp_path: Path, made: list[str], file: str) -> None:
    import torch

    model = _write(tmp_path, "clip-vit-h-14", file=file)
    encoder = _encoder(tmp_path)
    pixels = torch.from_numpy(ImageTransform(SIZE).pixels(noise_images(3)))
    with torch.inference_mode():
        images = torch.nn.functional.normalize(model.encode_image(pixels), dim=1).numpy()
        texts = torch.nn.functional.normalize(model.encode_text(_tokens(["a chair", "b"])), dim=1).numpy()
    assert np.allclose(encoder.encode_images(noise_images(3)), images, atol=1e-6)
    assert np.allclose(encoder.encode_texts(["a chair", "b"]), texts, atol=1e-6)
    assert (made, encoder.dim, encoder.name) == (["ViT-H-14"], DIM, "ViT-H-14/laion2b_s32b_b79k")


def test_openai_weights_run_with_their_training_activation(tmp_path: Path, made: list[str]) -> None:
    _write(tmp_path, "clip-vit-l-14-336")
    _encoder(tmp_path, "clip-vit-l-14-336").encode_texts(["chair"])
    assert made == ["ViT-L-14-336-quickgelu"]


def test_missing_open_clip_gives_one_line_naming_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path, "clip-vit-h-14")
    monkeypatch.setitem(sys.modules, "open_clip", None)
    with pytest.raises(ModelMissing, match="needs the package 'open_clip': pip install open_clip_torch"):
        _encoder(tmp_path)
