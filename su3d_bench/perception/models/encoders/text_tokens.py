"""From texts to the token rows that a text tower was trained on, by the files of its own folder."""

from __future__ import annotations

import string
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import require, require_transformers
from su3d_bench.core.types import Int64Array
from su3d_bench.perception.models.encoders.plain_text import plain_text, without_marks
from su3d_bench.perception.models.files import bounded, check_settings_size, read_settings

TokensKind = Literal["clip", "siglip"]
Tokeniser = Callable[[Sequence[str]], Int64Array]
_CLIP_FILES = ("tokenizer.json", "vocab.json", "merges.txt", "tokenizer_config.json", "special_tokens_map.json")
TOKENS_VERSION = "2"


def read_tokeniser(folder: Path, kind: TokensKind, n_tokens: int, pad_id: int | None, n_words: int) -> Tokeniser:
    """What turns texts into rows (N, n_tokens) of ids below ``n_words``; longer texts are cut, the end token stays.

    ``clip``: transformers' ``CLIPTokenizer`` on texts cleaned as open_clip cleans them. ``siglip``: the folder's
    ``tokenizer.json`` on texts without punctuation and capitals, padded with ``pad_id`` as the towers were trained.
    """
    encode = _clip(folder, n_tokens) if kind == "clip" else _siglip(folder, n_tokens, pad_id or 0)

    def tokens(texts: Sequence[str]) -> Int64Array:
        if not texts:
            return np.zeros((0, n_tokens), np.int64)
        ids = np.array(encode(list(texts)), np.int64).reshape(len(texts), n_tokens)
        if ids.max() >= n_words or ids.min() < 0:
            raise DataError(
                f"{folder}: its tokenizer gives the id {int(ids.max())} and the text tower knows {n_words} words; "
                "the files are of different models, fetch them anew"
            )
        return ids

    return tokens


def _clip(folder: Path, n_tokens: int) -> Callable[[list[str]], Any]:
    transformers = require_transformers("the tokenizer of CLIP")
    for name in _CLIP_FILES:
        check_settings_size(folder / name)
    tokenizer = _load(folder, lambda: transformers.CLIPTokenizer.from_pretrained(str(folder), local_files_only=True))

    def encode(texts: list[str]) -> Any:
        texts = [without_marks(plain_text(text)) for text in texts]
        return tokenizer(texts, padding="max_length", truncation=True, max_length=n_tokens)["input_ids"]

    return encode


def _siglip(folder: Path, n_tokens: int, pad_id: int) -> Callable[[list[str]], Any]:
    tokenizers = require("tokenizers", "the tokenizer of SigLIP")
    read_settings(folder / "tokenizer.json")  # bounds its size and says what is wrong with it
    tokenizer = _load(folder, lambda: tokenizers.Tokenizer.from_file(str(folder / "tokenizer.json")))
    tokenizer.enable_truncation(n_tokens)
    tokenizer.enable_padding(length=n_tokens, pad_id=pad_id)
    return lambda texts: [encoding.ids for encoding in tokenizer.encode_batch([canonical_text(text) for text in texts])]


def canonical_text(text: str) -> str:
    """``text`` in lower case without punctuation, its words apart by one space, as SigLIP was trained."""
    bare = text.translate(str.maketrans("", "", string.punctuation))
    return " ".join(bare.lower().split())


def _load(folder: Path, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as error:
        # the tokenizers library raises bare Exceptions for whatever is wrong with a file
        if type(error) is Exception or isinstance(error, OSError | ValueError | KeyError | TypeError | AttributeError):
            raise DataError(
                f"{folder}: its tokenizer cannot be read: {bounded(error)}; fetch its files anew"
            ) from error
        raise
