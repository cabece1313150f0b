"""The project's own encoder, run by ONNX Runtime on the CPU, without download, GPU or torch.

Its training and its measured accuracy are in ``model_card.md`` next to the weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import ModelMissing
from su3d_bench.core.system.devices import CPU
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.perception.embedded.lexicon import DIM, TOKENIZER_VERSION, token_ids, unknown_words
from su3d_bench.perception.models.encoders.images import check_image
from su3d_bench.perception.models.onnx import open_session

IMAGE_SIZE = 64
IMAGE_FILE = "image.onnx"
TEXT_FILE = "text.onnx"
PREPROCESSING_VERSION = "1"
BATCH = 32  # images per batch: 1.6 times as fast as one by one; larger batches gain nothing
N_TRIED = 5  # images for testing that batching changes no bit; odd, so that kernels process a remainder


def shrink(image: UInt8Array) -> UInt8Array:
    """``image`` (h, w, 3) resized to 64 x 64: area resampling along an axis that shrinks, linear along one that grows.

    The axes are resampled separately because OpenCV's area mode stops averaging in both as soon as one of them grows.
    """
    import cv2

    height, width = image.shape[:2]
    across = cv2.INTER_AREA if width >= IMAGE_SIZE else cv2.INTER_LINEAR
    down = cv2.INTER_AREA if height >= IMAGE_SIZE else cv2.INTER_LINEAR
    if across == down:
        return np.asarray(cv2.resize(image, (IMAGE_SIZE, IMAGE_SIZE), interpolation=across), np.uint8)
    narrow = cv2.resize(image, (IMAGE_SIZE, height), interpolation=across)
    return np.asarray(cv2.resize(narrow, (IMAGE_SIZE, IMAGE_SIZE), interpolation=down), np.uint8)


def log_size(height: int, width: int) -> tuple[float, float]:
    """The size lost by resizing: log2 of the crop's height and width in pixels, scaled to 0 at 64 and 1 at 256."""
    return float(np.log2(height) - 6.0) / 2.0, float(np.log2(width) - 6.0) / 2.0


class EmbeddedEncoder:
    """Two small towers trained on rendered homes only; files are read at first use.

    Every text runs through the network alone and on one thread, so that a feature never depends on the rest of the
    batch or on the number of cores. Images run in batches if a test at first use shows that this changes no bit,
    otherwise one by one. ``device``: where its features are compared; the towers always run on the CPU.
    """

    name = "su3d-embedded"
    dim = DIM
    trained_on = "homes rendered by the program, without held-out models and novel classes"
    # questions/generator.py asks for "cushion on a sofa", training captions had "cushion on sofa", with equal relations
    relative_remark = (
        "relation words and the pattern of these queries are those of the captions that the embedded encoder was "
        "trained on"
    )

    def __init__(self, folder: Path | None = None, device: str = CPU) -> None:
        self._folder = Path(__file__).parent / "weights" if folder is None else folder
        self.device = device

    @cached_property
    def digest(self) -> str:
        """A digest of the weights of both towers, the preprocessing and the tokenizer."""
        content = hashlib.sha256(f"{PREPROCESSING_VERSION}/{TOKENIZER_VERSION}/{IMAGE_SIZE}/{DIM}".encode())
        for name in (IMAGE_FILE, TEXT_FILE):
            content.update(hashlib.sha256(file_bytes(self._path(name))).digest())
        return content.hexdigest()

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        """Features (N, 128) of RGB crops (h, w, 3) uint8 at their native size."""
        pixels = np.zeros((len(images), IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        log_sizes = np.zeros((len(images), 2), np.float32)
        for row, image in enumerate(images):
            pixels[row], log_sizes[row] = shrink(check_image(image, row)), log_size(*image.shape[:2])
        return self.encode_shrunk(pixels, log_sizes)

    def encode_shrunk(self, pixels: UInt8Array, log_sizes: Float32Array) -> Float32Array:
        """Features (N, 128) of ``shrink``'s images (N, 64, 64, 3) and the ``log_size`` (N, 2) of their crops."""
        return self._in_batches(pixels, log_sizes, self._batch)

    def _in_batches(self, pixels: UInt8Array, log_sizes: Float32Array, n: int) -> Float32Array:
        features = np.zeros((len(pixels), DIM), np.float32)
        for start in range(0, len(pixels), n):
            rows = slice(start, start + n)
            inputs = {"pixels": pixels[rows], "log_size": log_sizes[rows]}
            features[rows] = self._image_tower.run(None, inputs)[0]
        return features

    @cached_property
    def _batch(self) -> int:
        """The batch size of images: 1 if the kernels on this machine round differently in a batch."""
        noise = np.random.default_rng(0)
        pixels = noise.integers(0, 256, (N_TRIED, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        log_sizes = noise.uniform(-1, 1, (N_TRIED, 2)).astype(np.float32)
        alone = self._in_batches(pixels, log_sizes, 1)
        return BATCH if np.array_equal(alone, self._in_batches(pixels, log_sizes, N_TRIED)) else 1

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        """Features (N, 128) of texts; a text of only articles gets the feature of the empty text."""
        features = np.zeros((len(texts), DIM), np.float32)
        for row, ids in enumerate(token_ids(texts)):
            features[row] = self._text_tower.run(None, {"ids": ids[None]})[0][0]
        return features

    def unseen_words(self, text: str) -> tuple[str, ...]:
        """The words of ``text`` that are in no training caption, so that only their spelling is used."""
        from su3d_bench.perception.embedded.lexicon import trained_words

        return unknown_words(text, trained_words())

    @cached_property
    def _image_tower(self) -> Any:
        return open_session(self._path(IMAGE_FILE))

    @cached_property
    def _text_tower(self) -> Any:
        return open_session(self._path(TEXT_FILE))

    def _path(self, name: str) -> Path:
        path = self._folder / name
        if not path.is_file():
            raise ModelMissing(f"encoder '{self.name}': missing file {path}; reinstall the package")
        return path
