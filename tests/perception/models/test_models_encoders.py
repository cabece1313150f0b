"""Encoders with random weights: preprocessing exact to the bit, features equal to the libraries', untrusted files."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_models import noise_images, write_tiny_clip, write_tiny_siglip

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.perception.cache import FrameCache
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.encoders.encoder import EncoderSpec, FoundationEncoder
from su3d_bench.perception.models.encoders.images import ImageTransform
from su3d_bench.perception.models.files import read_weights
from su3d_bench.perception.models.loading import load_encoder

TEXTS = ("chair", "a red cup on the table", "chair", "zebra")
RAW = EncoderSpec(3, 4, 10, "clip", None, ImageTransform(4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("models")
    write_tiny_clip(root / "clip-vit-h-14")
    write_tiny_siglip(root / "siglip-base-224")
    return root


def config(folder: Path, encoder: str = "clip-vit-h-14", **settings: Any) -> ModelsConfig:
    return ModelsConfig(encoder=encoder, folder=folder, **settings)


# ---- features


@pytest.mark.parametrize("name", ["clip-vit-h-14", "siglip-base-224"])
def test_features_match_transformers_model_and_processor(folder: Path, name: str) -> None:
    import torch
    from transformers import AutoModel

    encoder = load_encoder(config(folder, name, transform="transformers"))
    assert isinstance(encoder, Encoder)
    model: Any = AutoModel.from_pretrained(str(folder / name), local_files_only=True).eval()
    spec = encoder._spec  # type: ignore[attr-defined]
    tokens = encoder._tokeniser(TEXTS)  # type: ignore[attr-defined]
    with torch.inference_mode():
        images = [
            model.get_image_features(pixel_values=torch.from_numpy(spec.transform.pixels([image]))).pooler_output
            for image in noise_images(5)
        ]
        texts = [model.get_text_features(input_ids=torch.from_numpy(row[None])).pooler_output for row in tokens]
    assert np.array_equal(encoder.encode_images(noise_images(5)), _unit(torch.cat(images).numpy()))
    assert np.array_equal(encoder.encode_texts(TEXTS), _unit(torch.cat(texts).numpy()))


def _unit(rows: Float32Array) -> Float32Array:
    return np.asarray(rows / np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True), np.float32)


@pytest.mark.parametrize("name", ["clip-vit-h-14", "siglip-base-224"])
def test_feature_does_not_depend_on_the_rest_of_its_batch(folder: Path, name: str) -> None:
    encoder = load_encoder(config(folder, name))
    images = noise_images(5)
    together = encoder.encode_images(images)
    assert together.dtype == np.float32
    assert np.allclose(np.linalg.norm(together, axis=1), 1, atol=1e-6)
    assert np.array_equal(together[3:4], encoder.encode_images(images[3:4]))
    batched = load_encoder(config(folder, name, batch=4)).encode_images(images)
    assert np.abs(batched - together).max() < 1e-5
    assert encoder.encode_images([]).shape == (0, encoder.dim)
    assert encoder.encode_texts([]).shape == (0, encoder.dim)


def test_digest_changes_with_everything_that_affects_features(folder: Path, tmp_path: Path) -> None:
    digest = load_encoder(config(folder)).digest
    assert load_encoder(config(folder, batch=4)).digest == digest
    assert load_encoder(config(folder, transform="transformers")).digest != digest
    changed = {
        "merges.txt": (b"#version: 0.2", b"#version: 0.3"),
        "model.safetensors": (b"logit_scale", b"logit_scalE"),
        "preprocessor_config.json": (b"0.48145466", b"0.5"),
    }
    for name, (old, new) in changed.items():
        path = Path(shutil.copytree(folder / "clip-vit-h-14", tmp_path / name / "clip-vit-h-14")) / name
        assert old in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(old, new))
        assert load_encoder(config(tmp_path / name)).digest != digest, name


class _CountingTowers:
    """Towers that count calls; features are sums of their inputs."""

    def __init__(self, batch: int = 2) -> None:
        self.batch = batch
        self.n_texts = 0

    def image_features(self, pixels: Float32Array) -> Float32Array:
        return np.stack([pixels.sum((1, 2, 3)), pixels[:, 0].sum((1, 2)), np.ones(len(pixels))], 1).astype(np.float32)

    def text_features(self, tokens: Int64Array) -> Float32Array:
        self.n_texts += len(tokens)
        return np.stack([tokens.sum(1), tokens[:, 0], np.ones(len(tokens))], 1).astype(np.float32)


def _counting(towers: _CountingTowers, cache: FrameCache | None = None) -> FoundationEncoder:
    def tokenise(texts: Any) -> Int64Array:
        return np.array([[len(text), ord(text[0]), 0, 0] for text in texts], np.int64)

    return FoundationEncoder("counting", RAW, lambda: towers, lambda: tokenise, lambda: {"files": "1"}, cache)


def test_text_features_are_cached_on_disk(tmp_path: Path) -> None:
    towers = _CountingTowers()
    encoder = _counting(towers, FrameCache(tmp_path))
    first = encoder.encode_texts(["a", "b", "a", "c"])
    assert towers.n_texts == 3
    assert np.array_equal(first[0], first[2])
    encoder.encode_texts(["c", "d"])
    assert towers.n_texts == 4
    later = _CountingTowers()
    assert np.array_equal(_counting(later, FrameCache(tmp_path)).encode_texts(["a", "b", "a", "c"]), first)
    assert later.n_texts == 0


def test_weights_replaced_within_the_process_are_read_again(tmp_path: Path) -> None:
    def feature(seed: int) -> Float32Array:
        write_tiny_clip(tmp_path / "clip-vit-h-14", seed=seed)
        return load_encoder(config(tmp_path)).encode_texts(["chair"])

    assert not np.allclose(feature(0), feature(1))


# ---- invalid files


class _Payload:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, ("raise SystemExit('the payload ran')",)


@pytest.mark.parametrize("name", ["pytorch_model.bin", "weights.pt", "weights.pth"])
def test_weights_file_with_code_is_rejected(tmp_path: Path, name: str) -> None:
    import torch

    for form in (pickle.dumps({"a": _Payload()}), None):
        if form is None:
            torch.save({"a": _Payload()}, tmp_path / name)
        else:
            (tmp_path / name).write_bytes(form)
        with pytest.raises(DataError, match=r"contains more than plain tensors|not readable as torch weights"):
            read_weights(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "printed"),
    [
        ({"model_type": "bert"}, "an encoder is 'clip' or 'siglip'"),
        ({"vision_config": {"num_hidden_layers": 10**6}}, "num_hidden_layers is 1000000"),
        ({"vision_config": [1]}, "vision_config is not a table"),
        ({"quantization_config": {}}, "the weights are quantised"),
        ({"vision_config": {"image_size": 64}}, "the image tower needs 64 px"),
    ],
)
def test_invalid_configuration_fails_before_loading(
    folder: Path, tmp_path: Path, change: dict[str, Any], printed: str
) -> None:
    target = tmp_path / "clip-vit-h-14"
    shutil.copytree(folder / "clip-vit-h-14", target)
    content = json.loads((target / "config.json").read_text())
    (target / "config.json").write_text(json.dumps(content | change))
    with pytest.raises(DataError, match=printed):
        load_encoder(config(tmp_path))
