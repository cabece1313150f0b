"""Results on a torch device compared with the CPU: labels and cosines, the embedded encoder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from su3d_bench.cli.main import main
from su3d_bench.metrics.matching.labelling import cosines, most_similar
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder

TORCH_ON_CPU = "cpu:0"  # torch's other name of the CPU; for "cpu" the package does not use torch
on_each_device = pytest.mark.parametrize("device", [TORCH_ON_CPU, pytest.param("cuda:0", marks=pytest.mark.gpu)])


@on_each_device
def test_device_labels_match_the_cpu_also_for_ties(device: str) -> None:
    rng = np.random.default_rng(0)
    text = rng.normal(size=(40, 96)).astype(np.float32)
    text[7] = text[3]  # two classes with the same feature: the first wins
    features = rng.normal(size=(20_000, 96)).astype(np.float32)
    features[:50] = text[7] + rng.normal(0, 1e-8, (50, 96))
    features[9000:9100], features[9100] = 0, np.nan
    chosen = most_similar(features, text)
    np.testing.assert_array_equal(most_similar(features, text, device), chosen)
    assert (chosen[:50] == 3).all() and (chosen[9000:9101] == 0).all()
    one = text[:1]
    np.testing.assert_array_equal(most_similar(features, one, device), np.zeros(len(features)))


@on_each_device
def test_device_cosines_match_the_cpu(device: str) -> None:
    rng = np.random.default_rng(1)
    features, text = rng.normal(size=(300, 512)).astype(np.float16), rng.normal(size=(70, 512))
    features[5], features[6, 3] = 0, np.inf
    found = cosines(features, text, device)
    np.testing.assert_allclose(found, cosines(features, text), rtol=0, atol=1e-12)
    assert (found[5:7] == 0).all()


@on_each_device
def test_embedded_encoder_features_on_a_device_match_the_cpu(device: str) -> None:
    rng = np.random.default_rng(2)
    images = [rng.integers(0, 256, (*size, 3), np.uint8) for size in ((12, 40), (64, 64), (200, 90))] * 13
    texts = ["chair", "a plant on the shelf", "the", ""]
    here, there = EmbeddedEncoder(), EmbeddedEncoder(device=device)
    tolerance = 1e-5 if device == TORCH_ON_CPU else 1e-4  # a GPU uses other convolution algorithms
    np.testing.assert_allclose(there.encode_images(images), here.encode_images(images), rtol=0, atol=tolerance)
    np.testing.assert_allclose(there.encode_texts(texts), here.encode_texts(texts), rtol=0, atol=tolerance)


def test_run_on_a_missing_gpu_fails_early_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["run", "--device", "cuda", "--scenes", "rooms/living0", "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "device 'cuda': torch sees no GPU here; use --device cpu" in error
    assert not (tmp_path / "run").exists()
