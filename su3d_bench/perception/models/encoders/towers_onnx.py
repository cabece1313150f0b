"""Encoders as two ONNX files: their manifest, their export with a report of parity, and how they are run.

A folder holds ``image.onnx``, ``text.onnx`` (and ``.data`` files beside large ones), the tokenizer's files and
``manifest.json``: the spec, the SHA-256 of every file, the digests of the weights they were made from, the parity.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import CheckFailed, DataError, StoreError
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.core.system.devices import CPU
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.perception.models.encoders import towers_transformers
from su3d_bench.perception.models.encoders.encoder import EncoderSpec, check_spec, unit_rows
from su3d_bench.perception.models.encoders.image_transform import Convention
from su3d_bench.perception.models.encoders.text_tokens import read_tokeniser
from su3d_bench.perception.models.files import ModelFiles, bounded
from su3d_bench.perception.models.onnx.export import as_module, compare_outputs, export_onnx
from su3d_bench.perception.models.onnx.manifest import OnnxManifest, wrong_files
from su3d_bench.perception.models.onnx.session import Provider, open_session

IMAGE_FILE, TEXT_FILE = "image.onnx", "text.onnx"
TOKENIZER_FILES = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json", "vocab.json", "merges.txt")
# Of features at length 1. ViT-H-14 in float32 agrees to 2e-7; a wrong operator shows in the second decimal.
LARGEST_DIFFERENCE = 1e-4
SMALLEST_COSINE = 0.99999
PROBES = ("chair", "an image of a tv-screen", "a red cup on the table in a scene")
GPU_BATCH = 32


class Manifest(OnnxManifest):
    """The manifest of an exported encoder."""

    FORMAT = "su3d-bench onnx encoder 1"
    IS_OF = "an encoder"
    REQUIRES = (IMAGE_FILE, TEXT_FILE)

    spec: EncoderSpec


def export_encoder(files: ModelFiles, folder: Path) -> Manifest:
    """Write the two towers of a transformers model into ``folder``; ``CheckFailed`` where ONNX Runtime disagrees."""
    import torch

    spec = towers_transformers.read_spec(files, "original")
    model = towers_transformers.load_model(files)
    towers = towers_transformers.TransformersTowers(model, CPU, "float32", 1)
    make_folder(folder)
    pixels, tokens = _probes(files, spec)
    written = []
    parity = []
    for name, tower, values in (
        (IMAGE_FILE, as_module(towers.encode_image, model), torch.from_numpy(pixels)),
        (TEXT_FILE, as_module(towers.encode_text, model), torch.from_numpy(tokens)),
    ):
        kind = name.partition(".")[0]
        inputs = {"pixels" if kind == "image" else "tokens": values}
        axes = {key: {0: "n"} for key in (*inputs, "features")}
        # two rows are traced and three compared: the number of rows must not be part of the file
        traced = {key: value[:2] for key, value in inputs.items()}
        written += export_onnx(tower, traced, folder / name, ["features"], axes)
        with torch.inference_mode():
            mine = tower(values).numpy()
        other = open_session(folder / name).run(["features"], {key: value.numpy() for key, value in inputs.items()})[0]
        parity.append(compare_outputs(kind, unit_rows(mine, kind), unit_rows(other, kind)))
    written += _copy_tokenizer(files.folder, folder)
    manifest = Manifest.of_export(files, written, parity, str(torch.__version__), spec=spec)
    check_parity(manifest)
    return manifest


def check_parity(manifest: Manifest) -> None:
    """Raise ``CheckFailed`` where a tower's features differ by more than the tolerance."""
    for parity in manifest.parity:
        if parity.max_abs_difference > LARGEST_DIFFERENCE or parity.min_cosine < SMALLEST_COSINE:
            raise CheckFailed(
                f"{manifest.name}: the {parity.output} tower differs between torch and ONNX Runtime by "
                f"{parity.max_abs_difference:.2e} (cosine {parity.min_cosine:.6f}); tolerance {LARGEST_DIFFERENCE:.0e}"
            )


def _probes(files: ModelFiles, spec: EncoderSpec) -> tuple[Float32Array, Int64Array]:
    """Fixed inputs: three images of noise in blocks, three texts."""
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (8, 12, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1) for _ in PROBES]
    tokenise = read_tokeniser(files.folder, spec.tokens, spec.n_tokens, spec.pad_id, spec.n_words)
    return spec.transform.pixels(images), tokenise(PROBES)


def _copy_tokenizer(source: Path, folder: Path) -> list[Path]:
    try:
        return [
            Path(shutil.copyfile(source / name, folder / name)) for name in TOKENIZER_FILES if (source / name).is_file()
        ]
    except (OSError, shutil.SameFileError) as error:
        raise StoreError(f"{folder}: the tokenizer cannot be copied from {source}: {bounded(error)}") from error


def read_manifest(path: Path) -> Manifest:
    """The manifest of an exported encoder; raises ``DataError`` for anything else."""
    manifest = Manifest.read(path)
    check_spec(manifest.spec, path)
    return manifest


def read_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """The spec in the manifest, images prepared as ``convention`` says."""
    spec = read_manifest(files.weights).spec
    return replace(spec, transform=replace(spec.transform, convention=convention))


class OnnxTowers:
    """The towers of an exported encoder, each loaded at its first use."""

    def __init__(self, files: ModelFiles, provider: Provider, device_index: int, batch: int) -> None:
        if wrong := wrong_files(read_manifest(files.weights), files.folder):
            raise DataError(wrong[0])
        self._session = cache(lambda name: open_session(files.folder / name, provider, device_index))
        self.batch = batch or (1 if provider == "cpu" else GPU_BATCH)

    def image_features(self, pixels: Float32Array) -> Float32Array:
        return np.asarray(self._session(IMAGE_FILE).run(["features"], {"pixels": pixels})[0], np.float32)

    def text_features(self, tokens: Int64Array) -> Float32Array:
        return np.asarray(self._session(TEXT_FILE).run(["features"], {"tokens": tokens})[0], np.float32)
