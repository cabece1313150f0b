"""An encoder made of two towers: preparation, batches, normalisation and what is remembered are the same for all."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import ConfigDict, Field

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import CPU, Batches
from su3d_bench.core.types import Float32Array, Int64Array, UInt8Array
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.models.encoders.images import ImageTransform
from su3d_bench.perception.models.encoders.texts import TOKENS_VERSION, TokensKind
from su3d_bench.perception.models.onnx import PROVIDERS

ENCODER_VERSION = "1"
# 65,536 features of 1024 numbers take 256 MB.
LARGEST_MEMORY_OF_TEXTS = 65_536


@dataclass(frozen=True)
class EncoderSpec:
    """What is known of an encoder without its weights: ``dim`` of the space, and what its towers take."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    dim: Annotated[int, Field(ge=1, le=2**16)]
    n_tokens: Annotated[int, Field(ge=1, le=8192)]
    n_words: Annotated[int, Field(ge=1, le=2_000_000)]
    tokens: TokensKind
    pad_id: Annotated[int, Field(ge=0, le=2_000_000)] | None
    transform: ImageTransform


class Towers(Protocol):
    """Two networks: ``image_features`` of pixels (N, 3, S, S), ``text_features`` of tokens (N, T), not normalised.

    ``batch`` is how many the device takes at once.
    """

    batch: int

    def image_features(self, pixels: Float32Array) -> Float32Array: ...

    def text_features(self, tokens: Int64Array) -> Float32Array: ...


class FoundationEncoder:
    """``Encoder`` over two towers; the towers are loaded at the first image or text that is not remembered."""

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
        """Moves with the weights, the tokenizer, the preparation, the precision, the device's kind and the runtime."""
        return self._digest_of(self._identity())

    def is_same_space(self, digest: str) -> bool:
        """Whether ``digest`` is of these weights and this preparation, be it on another device or in another precision.

        Features then differ by rounding alone, and texts of the one may be compared with images of the other.
        """
        known = dict(self._identity())
        if "provider" in known:
            return any(digest == self._digest_of(known | {"provider": name}) for name in PROVIDERS)
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
    """``rows`` (N, D) at length 1; a row without a direction means that the weights or the precision are at fault."""
    lengths = np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0).any():
        raise DataError(
            f"encoder '{where}': {int((~np.isfinite(lengths) | (lengths == 0)).sum())} features are zero or not "
            "finite; check the weights with su3d-bench models check, or set perception.models.precision to float32"
        )
    return np.asarray(rows / lengths, np.float32)
