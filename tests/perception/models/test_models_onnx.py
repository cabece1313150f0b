"""Exported encoders: parity with torch within the stated tolerance, files that can be trusted, providers."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_models import noise_images, write_tiny_clip, write_tiny_siglip

from su3d_bench.core.errors import CheckFailed, ConfigError, DataError, ModelMissing
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.encoders.towers_onnx import (
    LARGEST_DIFFERENCE,
    check_parity,
    export_encoder,
    read_manifest,
)
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.loading import load_encoder
from su3d_bench.perception.models.onnx import Provider, open_session
from su3d_bench.perception.models.onnx import export as onnx_export
from su3d_bench.perception.models.onnx.export import Parity, compare_outputs, export_onnx, measure_parity

pytestmark = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("torch", "transformers", "onnx")),
    reason="torch, transformers and onnx are not installed: pip install 'su3d-bench[models]'",
)

TEXTS = ("chair", "a red cup on the table", "tv-screen")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tiny encoders and what ``export_encoder`` makes of them."""
    root = tmp_path_factory.mktemp("models")
    write_tiny_clip(root / "clip-vit-h-14")
    write_tiny_siglip(root / "siglip-base-224")
    for name in ("clip-vit-h-14", "siglip-base-224"):
        export_encoder(locate(name, ("transformers",), folder=root), root / f"{name}-onnx")
    return root


@pytest.mark.parametrize("name", ["clip-vit-h-14", "siglip-base-224"])
def test_the_exported_encoder_gives_torchs_features_within_the_tolerance(folder: Path, name: str) -> None:
    exported = load_encoder(ModelsConfig(encoder=name, folder=folder, runtime="onnx"))
    original = load_encoder(ModelsConfig(encoder=name, folder=folder))
    images = noise_images(5)
    assert np.abs(exported.encode_images(images) - original.encode_images(images)).max() < 1e-6
    assert np.abs(exported.encode_texts(TEXTS) - original.encode_texts(TEXTS)).max() < 1e-6
    assert exported.dim == original.dim
    assert exported.digest != original.digest


def test_the_exported_encoder_takes_batches_and_gives_each_image_its_own_feature(folder: Path) -> None:
    alone = load_encoder(ModelsConfig(encoder="clip-vit-h-14", folder=folder, runtime="onnx"))
    batched = load_encoder(ModelsConfig(encoder="clip-vit-h-14", folder=folder, runtime="onnx", batch=4))
    images = noise_images(5)
    together = alone.encode_images(images)
    assert np.array_equal(together[2:3], alone.encode_images(images[2:3]))
    assert np.abs(batched.encode_images(images) - together).max() < 1e-6


def test_the_manifest_names_every_file_its_source_and_the_parity(folder: Path) -> None:
    source = locate("clip-vit-h-14", ("transformers",), folder=folder)
    manifest = read_manifest(folder / "clip-vit-h-14-onnx" / "manifest.json")
    beside = {path.name for path in (folder / "clip-vit-h-14-onnx").iterdir()} - {"manifest.json"}
    assert set(manifest.files) == beside >= {"image.onnx", "text.onnx", "merges.txt", "vocab.json"}
    assert manifest.source["files"] == source.digests()
    assert [one.output for one in manifest.parity] == ["image", "text"]
    assert all(one.max_abs_difference < LARGEST_DIFFERENCE for one in manifest.parity)


def test_an_export_that_differs_from_torch_is_refused(folder: Path) -> None:
    manifest = read_manifest(folder / "clip-vit-h-14-onnx" / "manifest.json")
    for worse in (Parity("text", 3, 2e-4, 1.0), Parity("text", 3, 0.0, 0.999)):
        object.__setattr__(manifest, "parity", (manifest.parity[0], worse))
        with pytest.raises(CheckFailed, match="the text tower differs between torch and ONNX Runtime"):
            check_parity(manifest)


def test_a_changed_file_is_not_run(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "clip-vit-h-14-onnx", tmp_path / "clip-vit-h-14-onnx")
    changed = tmp_path / "clip-vit-h-14-onnx" / "text.onnx"
    changed.write_bytes(changed.read_bytes() + b"\0")
    encoder = load_encoder(ModelsConfig(encoder="clip-vit-h-14", folder=tmp_path, runtime="onnx"))
    with pytest.raises(DataError, match=r"text\.onnx: is not the file that the manifest describes"):
        encoder.encode_texts(TEXTS)
    changed.unlink()
    with pytest.raises(DataError, match=r"text\.onnx: is missing"):
        encoder.encode_texts(TEXTS)


def _changed(manifest: dict[str, Any], *path: str, value: Any) -> dict[str, Any]:
    inner: Any = manifest
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return manifest


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("format",), "x", "format is 'x'"),
        (("files", "../x.onnx"), "0", "files must be names inside the folder"),
        (("files",), {}, "files must be names inside the folder"),
        (("spec", "dim"), 10**9, "out of range"),
        (("spec", "transform", "size"), 10**9, "out of range"),
        (("spec", "surprise"), 1, "is no manifest of an encoder"),
        (("parity",), 5, "is no manifest of an encoder"),
    ],
)
def test_a_manifest_without_sense_is_one_line(
    folder: Path, tmp_path: Path, path: tuple[str, ...], value: Any, said: str
) -> None:
    content = json.loads((folder / "clip-vit-h-14-onnx" / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(_changed(content, *path, value=value)))
    with pytest.raises(DataError, match=said):
        read_manifest(tmp_path / "manifest.json")


def test_the_folder_of_another_encoder_is_refused(folder: Path) -> None:
    paths = {"clip-vit-b-32": folder / "clip-vit-h-14-onnx"}
    with pytest.raises(ConfigError, match="holds 'clip-vit-h-14', not 'clip-vit-b-32'"):
        load_encoder(ModelsConfig(encoder="clip-vit-b-32", paths=paths, runtime="onnx"))


def test_an_encoder_that_was_not_exported_is_one_line_with_the_command(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelMissing, match="su3d-bench models export clip-vit-b-32 --out"):
        load_encoder(ModelsConfig(encoder="clip-vit-b-32", folder=folder, runtime="onnx"))
    missing = tmp_path / "nothing"
    with pytest.raises(ModelMissing, match=f"there is no {missing}"):
        load_encoder(ModelsConfig(encoder="clip-vit-b-32", paths={"clip-vit-b-32": missing}, runtime="onnx"))


# ---- the exporter itself


def _affine() -> Any:
    import torch

    class Affine(torch.nn.Module):  # type: ignore[misc, name-defined, unused-ignore]
        def __init__(self) -> None:
            super().__init__()
            self.layer = torch.nn.Linear(64, 32)  # 8 kB: weights below 1 kB stay in the model's own file

        def forward(self, rows: Any, shift: Any) -> tuple[Any, Any]:
            made = self.layer(rows)
            return made + shift, made.sum(1)

    torch.manual_seed(0)
    return Affine().eval()


def _inputs(n: int) -> Mapping[str, Any]:
    import torch

    generator = torch.Generator().manual_seed(n)
    return {"rows": torch.randn(n, 64, generator=generator), "shift": torch.randn(32, generator=generator)}


@pytest.mark.parametrize("largest_single_file", [2**31, 1000])
def test_any_module_is_exported_also_where_its_weights_need_a_file_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, largest_single_file: int
) -> None:
    monkeypatch.setattr(onnx_export, "LARGEST_SINGLE_FILE", largest_single_file)
    module = _affine()
    axes = {"rows": {0: "n"}, "sum": {0: "n"}, "sums": {0: "n"}}
    path = tmp_path / "made" / "affine.onnx"
    written = export_onnx(module, _inputs(2), path, ["sum", "sums"], axes)
    names = ["affine.onnx"] if largest_single_file > 1000 else ["affine.onnx", "affine.onnx.data"]
    assert [file.name for file in written] == names
    assert sorted(file.name for file in path.parent.iterdir()) == names
    parity = measure_parity(module, open_session(path), _inputs(5), ["sum", "sums"])
    assert [(one.output, one.n_values) for one in parity] == [("sum", 160), ("sums", 5)]
    assert max(one.max_abs_difference for one in parity) < 1e-5


def test_an_export_over_an_older_one_leaves_no_weights_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_export, "LARGEST_SINGLE_FILE", 1000)
    export_onnx(_affine(), _inputs(2), tmp_path / "a.onnx", ["sum", "sums"])
    monkeypatch.setattr(onnx_export, "LARGEST_SINGLE_FILE", 2**31)
    export_onnx(_affine(), _inputs(2), tmp_path / "a.onnx", ["sum", "sums"])
    assert [file.name for file in tmp_path.iterdir()] == ["a.onnx"]


def test_the_fused_attention_is_on_again_after_an_export(tmp_path: Path) -> None:
    import torch

    assert torch.backends.mha.get_fastpath_enabled()
    export_onnx(_affine(), _inputs(2), tmp_path / "a.onnx", ["sum", "sums"])
    assert torch.backends.mha.get_fastpath_enabled()


def test_parity_is_the_largest_difference_and_the_smallest_cosine() -> None:
    mine = np.array([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0]])
    other = np.array([[3.0, 4.5], [0.0, 0.0], [0.0, 1.0]])
    parity = compare_outputs("x", mine, other)
    assert parity == Parity("x", 6, 1.0, 0.0)
    first = compare_outputs("x", mine[:2], other[:2])
    # (9 + 18) / (5 * sqrt(29.25)): rows that are zero on both sides agree
    assert first.max_abs_difference == 0.5
    assert first.min_cosine == pytest.approx(27 / (5 * 29.25**0.5))
    assert compare_outputs("x", np.zeros((0, 2)), np.zeros((0, 2))) == Parity("x", 0, 0.0, 1.0)


def test_a_provider_that_is_not_here_is_one_line(folder: Path) -> None:
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("this onnxruntime has CUDA")
    providers: tuple[Provider, ...] = ("cuda", "tensorrt")
    for provider in providers:
        with pytest.raises(ModelMissing, match=f"provider '{provider}': this onnxruntime has cpu alone"):
            open_session(folder / "clip-vit-h-14-onnx" / "text.onnx", provider)


def test_a_damaged_onnx_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    with pytest.raises(ModelMissing, match="there is no such file"):
        open_session(path)
    path.write_bytes(b"no protobuf")
    with pytest.raises(DataError, match=r"x\.onnx: ONNX Runtime cannot load it"):
        open_session(path)
