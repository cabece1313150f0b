"""Encoders with two towers: CLIP and SigLIP through transformers."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import CPU, Batches, first_batch, make_deterministic, require, require_transformers
from su3d_bench.core.types import Float32Array, Int64Array, UInt8Array
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.models import files as model_files
from su3d_bench.perception.models.encoders.images import Convention, ImageTransform, read_transform
from su3d_bench.perception.models.encoders.texts import TOKENS_VERSION, TokensKind
from su3d_bench.perception.models.files import ModelFiles, read_settings

ENCODER_VERSION = "1"
# 65,536 features of 1024 numbers take 256 MB.
LARGEST_MEMORY_OF_TEXTS = 65_536


@dataclass(frozen=True)
class EncoderSpec:
    """The properties of an encoder without its weights: ``dim`` of the space, and the inputs of its towers."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    dim: Annotated[int, Field(ge=1, le=2**16)]
    n_tokens: Annotated[int, Field(ge=1, le=8192)]
    n_words: Annotated[int, Field(ge=1, le=2_000_000)]
    tokens: TokensKind
    pad_id: Annotated[int, Field(ge=0, le=2_000_000)] | None
    transform: ImageTransform


class Towers(Protocol):
    """Two networks: ``image_features`` of pixels (N, 3, S, S), ``text_features`` of tokens (N, T), not normalised.

    ``batch`` is the batch size for the device.
    """

    batch: int

    def image_features(self, pixels: Float32Array) -> Float32Array: ...

    def text_features(self, tokens: Int64Array) -> Float32Array: ...


class FoundationEncoder:
    """``Encoder`` with two towers, which are loaded at the first image or text that is not cached."""

    def __init__(
        self,
        name: str,
        spec: EncoderSpec,
        load_towers: Callable[[], Towers],
        load_tokeniser: Callable[[], Callable[[Sequence[str]], Int64Array]],
        identity: Callable[[], Mapping[str, Any]],
        cache: FrameCache | None = None,
        device: str = CPU,
    ) -> None:
        self.name = name
        self.dim = spec.dim
        self.device = device
        self._spec = spec
        self._load_towers = load_towers
        self._load_tokeniser = load_tokeniser
        self._identity = identity
        self._cache = FrameCache(None) if cache is None else cache
        self._texts: dict[str, Float32Array] = {}

    @cached_property
    def digest(self) -> str:
        """A digest of the weights, tokenizer, preprocessing, precision, kind of device and runtime."""
        return self._digest_of(self._identity())

    def is_same_space(self, digest: str) -> bool:
        """Whether ``digest`` is of the same weights and preprocessing, on any device and in any precision.

        Features then differ only by rounding, and texts of one may be compared with images of the other.
        """
        known = dict(self._identity())
        kinds = itertools.product(("cpu", "cuda"), ("float32", "float16", "bfloat16"))
        return any(digest == self._digest_of(known | {"device": d, "precision": p}) for d, p in kinds)

    def _digest_of(self, identity: Mapping[str, Any]) -> str:
        known = {
            "name": self.name,
            "transform": self._spec.transform.settings(),
            "tokens": [self._spec.tokens, TOKENS_VERSION, self._spec.n_tokens, self._spec.pad_id],
            **identity,
        }
        return content_key("encoder", ENCODER_VERSION, json.dumps(known, sort_keys=True))

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        """Features (N, dim) of RGB crops (h, w, 3) uint8 at their native size."""

        def work(batch: Sequence[UInt8Array]) -> Float32Array:
            return self._towers.image_features(self._spec.transform.pixels(batch))

        if not len(images):
            return np.zeros((0, self.dim), np.float32)
        return unit_rows(np.concatenate(self._image_batches.run(images, work)), self.name)

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        """Features (N, dim) of texts, each computed once."""
        new = [text for text in dict.fromkeys(texts) if text not in self._texts]
        features = {text: row for text in new if (row := self._stored(text)) is not None}
        missing = [text for text in new if text not in features]
        if missing:
            made = unit_rows(np.concatenate(self._text_batches.run(missing, self._text_work)), self.name)
            features |= dict(zip(missing, made, strict=True))
            for text in missing:
                self._cache.save(self._text_key(text), {"feature": features[text]})
        if len(self._texts) + len(features) <= LARGEST_MEMORY_OF_TEXTS:
            self._texts |= features
        rows = [self._texts[text] if text in self._texts else features[text] for text in texts]
        return np.array(rows, np.float32).reshape(len(texts), self.dim)

    def _text_work(self, batch: Sequence[str]) -> Float32Array:
        return self._towers.text_features(self._tokeniser(batch))

    def _stored(self, text: str) -> Float32Array | None:
        if not self._cache.is_on:
            return None
        entry = self._cache.load(self._text_key(text))
        row = None if entry is None else entry.get("feature")
        return row if row is not None and row.shape == (self.dim,) and row.dtype == np.float32 else None

    def _text_key(self, text: str) -> str:
        return content_key("text", self.digest, text) if self._cache.is_on else ""

    @cached_property
    def _towers(self) -> Towers:
        return self._load_towers()

    @cached_property
    def _tokeniser(self) -> Callable[[Sequence[str]], Int64Array]:
        return self._load_tokeniser()

    @cached_property
    def _image_batches(self) -> Batches:
        return Batches(self._towers.batch)

    @cached_property
    def _text_batches(self) -> Batches:
        return Batches(self._towers.batch)


def unit_rows(rows: Float32Array, where: str) -> Float32Array:
    """``rows`` (N, D) scaled to length 1; a zero or non-finite row indicates wrong weights or precision."""
    lengths = np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0).any():
        raise DataError(
            f"encoder '{where}': {int((~np.isfinite(lengths) | (lengths == 0)).sum())} features are zero or not "
            "finite; check the weights with su3d-bench models check, or set perception.models.precision to float32"
        )
    return np.asarray(rows / lengths, np.float32)


class TransformersTowers:
    """``Towers`` of a transformers model on one device in one precision."""

    def __init__(self, model: Any, device: str, precision: str, batch: int) -> None:
        dtype = getattr(require("torch", f"device '{device}'"), precision)
        make_deterministic(device)
        self._model, self._device, self._dtype = model, device, dtype
        model.to(device=device, dtype=dtype)
        n_bytes = sum(p.numel() * p.element_size() for p in model.parameters())
        self.batch = batch or first_batch(device, _image_values(model) * dtype.itemsize, n_bytes)

    def image_features(self, pixels: Float32Array) -> Float32Array:
        return self._features(lambda values: self._model.get_image_features(pixel_values=values), pixels, self._dtype)

    def text_features(self, tokens: Int64Array) -> Float32Array:
        # No mask: in CLIP a token only sees those before it, and SigLIP was trained without one.
        return self._features(lambda ids: self._model.get_text_features(input_ids=ids), tokens, None)

    def _features(self, encode: Callable[[Any], Any], values: NDArray[Any], dtype: Any) -> Float32Array:
        import torch

        with torch.inference_mode():
            features = encode(torch.from_numpy(values).to(device=self._device, dtype=dtype)).pooler_output
            return np.asarray(features.float().cpu().numpy(), np.float32)


_LIMITS = {
    "num_hidden_layers": 128,
    "hidden_size": 16384,
    "intermediate_size": 65536,
    "num_attention_heads": 256,
    "image_size": 2048,
    "patch_size": 256,
    "max_position_embeddings": 8192,
    "vocab_size": 2_000_000,
    "projection_dim": 16384,
}


def transformers_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """The spec of an encoder from ``config.json`` and ``preprocessor_config.json``; ``DataError`` if invalid."""
    path = files.folder / "config.json"
    config = read_settings(path)
    kind = config.get("model_type")
    if kind not in ("clip", "siglip"):
        raise DataError(f"{path}: model_type is {str(kind)[:40]!r}; an encoder is 'clip' or 'siglip'")
    if "quantization_config" in config:
        raise DataError(
            f"{path}: the weights are quantised, so this is not the published encoder; download the folder again"
        )
    text, vision = (_table(path, config, key) for key in ("text_config", "vision_config"))
    for table in (config, text, vision):
        _check_limits(path, table)
    transform = read_transform(files.folder / "preprocessor_config.json", convention)
    size = vision.get("image_size", 224)
    if transform.size != size:
        raise DataError(
            f"{files.folder}: the image tower needs {size} px, but preprocessor_config.json gives {transform.size}"
        )
    # The defaults are those of transformers for missing settings.
    if kind == "clip":
        dim = config.get("projection_dim", 512)
        n_tokens, n_words, pad_id = text.get("max_position_embeddings", 77), text.get("vocab_size", 49408), None
    else:
        dim = text.get("projection_size", text.get("hidden_size", 768))
        n_tokens, n_words = text.get("max_position_embeddings", 64), text.get("vocab_size", 32000)
        pad_id = text.get("pad_token_id", 1)
    read = {"dim": dim, "n_tokens": n_tokens, "n_words": n_words, "tokens": kind, "pad_id": pad_id}
    return model_files.checked(EncoderSpec, {**read, "transform": asdict(transform)}, path)


def _table(path: Path, config: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    table: dict[str, Any] = {}
    for name in (key, f"{key}_dict"):  # older files, such as LAION's, repeat a part there, which takes precedence
        part = config.get(name)
        if not isinstance(part, dict | None):
            raise DataError(f"{path}: {name} is not a table; download the file again")
        table |= part or {}
    return {name: value for name, value in table.items() if value is not None}


def _check_limits(path: Path, table: Mapping[str, Any]) -> None:
    """Reject sizes that no encoder has before anything of that size is allocated."""
    for key, limit in _LIMITS.items():
        value = table.get(key, 1)
        if not isinstance(value, int) or not 1 <= value <= limit:
            raise DataError(f"{path}: {key} is {str(value)[:40]}; expected 1 to {limit}")


def load_transformers(files: ModelFiles) -> Any:
    """The model in evaluation mode and float32 on the CPU; missing weights are an error, never random."""
    transformers = require_transformers(f"encoder '{files.entry.name}'")
    kind = read_settings(files.folder / "config.json").get("model_type")
    model_class = {"clip": transformers.CLIPModel, "siglip": transformers.SiglipModel}[str(kind)]
    return model_files.load_pretrained(files, model_class, attn_implementation="sdpa").eval()


def _image_values(model: Any) -> int:
    """The approximate number of values per image in memory: four times the widest layer, plus the attention."""
    vision = model.config.vision_config
    n_tokens = (vision.image_size // vision.patch_size) ** 2 + 1
    return int(4 * n_tokens * vision.intermediate_size + vision.num_attention_heads * n_tokens**2)
