"""Exported models: the same results as torch, file checks, providers, and the export tool."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import export_onnx
import numpy as np
import pytest
from tiny_models import SAM_PX, blocks, noise_images, tiny_sam, write_tiny_clip

from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.encoders.encoder import EncoderManifest
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.loading import load_encoder
from su3d_bench.perception.models.masks.sam import Prompts, Sam, TorchSam, load_onnx_sam
from su3d_bench.perception.models.onnx import Provider, open_session

CLIP = "clip-vit-h-14"
TEXTS = ("chair", "a red cup on the table", "tv-screen")
BOXES = np.array([[5, 5, 30, 30], [0, 0, 60, 40], [22.5, 3.25, 41, 39]], np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny encoder and a tiny SAM, and their exports."""
    root = tmp_path_factory.mktemp("models")
    write_tiny_clip(root / CLIP)
    tiny_sam().save_pretrained(root / "sam-vit-h")
    (root / "sam-vit-h/preprocessor_config.json").write_text("{}")
    for name in (CLIP, "sam-vit-h"):
        words = [name, "--weights", str(root / name), "--out", str(root / f"{name}-onnx")]
        assert export_onnx.main(words) == 0
    return root


def onnx_config(folder: Path, **settings: Any) -> ModelsConfig:
    return ModelsConfig(encoder=CLIP, folder=folder, runtime="onnx", **settings)


def test_exported_encoder_matches_torch_in_any_batch(folder: Path) -> None:
    exported, batched = load_encoder(onnx_config(folder)), load_encoder(onnx_config(folder, batch=4))
    original = load_encoder(ModelsConfig(encoder=CLIP, folder=folder))
    images = noise_images(5)
    features = exported.encode_images(images)
    assert np.abs(features - original.encode_images(images)).max() < 1e-6
    assert np.abs(features - batched.encode_images(images)).max() < 1e-6
    assert np.array_equal(features[2:3], exported.encode_images(images[2:3]))
    assert np.abs(exported.encode_texts(TEXTS) - original.encode_texts(TEXTS)).max() < 1e-6
    assert exported.dim == original.dim and exported.digest != original.digest


def test_exported_sam_matches_the_masks_of_torch(folder: Path) -> None:
    sam, other = Sam(TorchSam(tiny_sam())), Sam(load_onnx_sam(locate("sam-vit-h", ("onnx",), folder=folder)))
    assert other.network.image_px == SAM_PX
    mine, theirs = sam.look(blocks(40, 60)), other.look(blocks(40, 60))
    for is_single in (False, True):
        a, scores = sam.from_boxes(mine, BOXES, is_single)
        b, other_scores = other.from_boxes(theirs, BOXES, is_single)
        np.testing.assert_allclose(scores, other_scores, atol=1e-3)
        assert (a != b).mean() < 2e-3
    prompts = Prompts(np.array([[[10, 12]], [[33, 20]]], np.float32), np.array([[1], [0]]))
    answers = [one.decode(image, prompts, is_single=False) for one, image in ((sam, mine), (other, theirs))]
    for a, b in zip(*answers, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), atol=1e-3)


@pytest.mark.parametrize(("name", "file"), [(CLIP, "text.onnx"), ("sam-vit-h", "decoder.onnx")])
def test_changed_file_is_not_run(folder: Path, tmp_path: Path, name: str, file: str) -> None:
    changed = shutil.copytree(folder / f"{name}-onnx", tmp_path / f"{name}-onnx") / file

    def load() -> object:
        if name == CLIP:
            return load_encoder(onnx_config(tmp_path)).encode_texts(TEXTS)
        return load_onnx_sam(locate(name, ("onnx",), folder=tmp_path))

    changed.write_bytes(changed.read_bytes() + b"\0")
    with pytest.raises(DataError, match=f"{file}: does not match the manifest"):
        load()
    changed.unlink()
    with pytest.raises(DataError, match=f"{file}: is missing"):
        load()


@pytest.mark.parametrize(
    ("path", "value", "printed"),
    [
        (("format",), "x", "format is 'x'"),
        (("files", "../x.onnx"), "0", "files must be names inside the folder"),
        (("spec", "dim"), 10**9, "is not the manifest of an exported model"),
    ],
)
def test_invalid_manifest_gives_one_line_error(
    folder: Path, tmp_path: Path, path: tuple[str, ...], value: Any, printed: str
) -> None:
    content = json.loads((folder / f"{CLIP}-onnx/manifest.json").read_text())
    inner = content
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    (tmp_path / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=printed):
        EncoderManifest.read(tmp_path / "manifest.json")


def test_missing_provider_and_damaged_file_give_one_line_errors(folder: Path, tmp_path: Path) -> None:
    import onnxruntime

    providers: tuple[Provider, ...] = ("cuda", "tensorrt")
    for provider in () if "CUDAExecutionProvider" in onnxruntime.get_available_providers() else providers:
        with pytest.raises(ModelMissing, match=f"provider '{provider}': not available in this onnxruntime \\(cpu"):
            open_session(folder / f"{CLIP}-onnx/text.onnx", provider)
    with pytest.raises(ModelMissing, match="file not found"):
        open_session(tmp_path / "x.onnx")
    (tmp_path / "x.onnx").write_bytes(b"no protobuf")
    with pytest.raises(DataError, match=r"x\.onnx: ONNX Runtime cannot load it"):
        open_session(tmp_path / "x.onnx")
