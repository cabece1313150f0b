"""Both towers to ONNX, and the check that ONNX Runtime answers as torch does."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch

from su3d_bench.perception.embedded.encoder import IMAGE_FILE, IMAGE_SIZE, TEXT_FILE, EmbeddedEncoder
from su3d_bench.perception.embedded.text import N_IDS, N_WORDS, token_ids
from su3d_bench.perception.embedded.training.crops import CropSet
from su3d_bench.perception.embedded.training.loop import Towers

OPSET = 17


def export(towers: Towers, folder: Path) -> None:
    """The two ONNX files in ``folder``, each written beside its place first and then moved there."""
    folder.mkdir(parents=True, exist_ok=True)
    pixels = torch.zeros(1, IMAGE_SIZE, IMAGE_SIZE, 3, dtype=torch.uint8)
    ids = torch.zeros(1, N_WORDS, N_IDS, dtype=torch.int64)
    _export(towers.image, (pixels, torch.zeros(1, 2)), ["pixels", "log_size"], folder / IMAGE_FILE)
    _export(towers.text, (ids,), ["ids"], folder / TEXT_FILE)


def _export(tower: torch.nn.Module, example: tuple[torch.Tensor, ...], inputs: list[str], path: Path) -> None:
    draft = path.with_suffix(".draft")
    with warnings.catch_warnings():
        # The exporter that needs onnx alone is announced to go; the newer one needs onnxscript besides.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            tower.to(memory_format=torch.contiguous_format),  # type: ignore[call-overload]
            example,
            str(draft),
            dynamo=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=["features"],
            dynamic_axes={name: {0: "n"} for name in (*inputs, "features")},
        )
    draft.replace(path)


def largest_difference(towers: Towers, folder: Path, crops: CropSet, texts: list[str]) -> float:
    """The largest absolute difference of any feature between torch and ONNX Runtime, over ``crops`` and ``texts``."""
    encoder = EmbeddedEncoder(folder)
    with torch.inference_mode():
        images = towers.image(torch.from_numpy(crops.pixels), torch.from_numpy(crops.log_sizes)).numpy()
        captions = towers.text(torch.from_numpy(token_ids(texts))).numpy()
    of_images = np.abs(images - encoder.encode_shrunk(crops.pixels, crops.log_sizes)).max()
    of_texts = np.abs(captions - encoder.encode_texts(texts)).max()
    return float(max(of_images, of_texts))
