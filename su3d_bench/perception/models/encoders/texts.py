"""Text preprocessing for text towers: cleaned as in open_clip or SigLIP, and converted to rows of tokens.

Cleaning is what ``SimpleTokenizer`` of open_clip 3.3 does with ``ftfy.fix_text`` (ftfy 6.3), ``html.unescape`` and
``str.lower``, except for broken encodings ("cafÃ©"), which ftfy repairs by letter statistics.
"""

from __future__ import annotations

import html
import re
import string
import unicodedata
from collections.abc import Callable, Sequence
from html.entities import html5
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import require, require_transformers
from su3d_bench.core.types import Int64Array
from su3d_bench.perception.models.files import bounded, check_settings_size, read_settings

# Two letters in one character, by ftfy's table; ſ and ʼ are unchanged.
_LIGATURES = {
    "Ĳ": "IJ", "ĳ": "ij", "ŉ": "ʼn", "Ǳ": "DZ", "ǲ": "Dz", "ǳ": "dz", "Ǆ": "DŽ", "ǅ": "Dž", "ǆ": "dž",
    "Ǉ": "LJ", "ǈ": "Lj", "ǉ": "lj", "Ǌ": "NJ", "ǋ": "Nj", "ǌ": "nj",
    "ﬀ": "ff", "ﬁ": "fi", "ﬂ": "fl", "ﬃ": "ffi", "ﬄ": "ffl", "ﬅ": "ſt", "ﬆ": "st",
}  # fmt: skip
# Characters of bytes of Windows' code page that were read as Latin-1; five of them are undefined.
_WINDOWS = {code: bytes([code]).decode("cp1252", "ignore") or chr(code) for code in range(0x80, 0xA0)}
_QUOTES = {**dict.fromkeys("\u02bc\u2018\u2019\u201a\u201b", "'"), **dict.fromkeys("\u201c\u201d\u201e\u201f", '"')}
_FULL_AND_HALF_WIDTH = {chr(code): unicodedata.normalize("NFKC", chr(code)) for code in range(0xFF01, 0xFFF0)}
# Applied in this order, because a later one may change the result of an earlier one.
_STRAIGHT = tuple(
    str.maketrans(table) for table in (_WINDOWS, _LIGATURES, {**_FULL_AND_HALF_WIDTH, "\u3000": " "}, _QUOTES)
)
_NO_TEXT = dict.fromkeys(
    [*range(0x09), 0x0B, *range(0x0E, 0x20), 0x7F, *range(0x206A, 0x2070), 0xFEFF, *range(0xFFF9, 0xFFFD)]
)
_TERMINAL_COMMAND = re.compile(r"\x1b\[[\d;]*[a-zA-Z]")
_ENTITY = re.compile(r"&#?[0-9A-Za-z]{1,24};")
_MARK = re.compile(r"<\|(startoftext|endoftext)\|>")


def plain_text(text: str) -> str:
    """``text`` as returned by open_clip's ``_clean_lower``.

    >>> plain_text("  The “Caﬀè”  &amp; bar\\x07 ")
    'the "caffè" & bar'
    """
    may_unescape, lines = True, []
    for line in text.split("\n"):
        # ftfy treats a text with a "<" as HTML from that line on, and does not unescape its entities.
        may_unescape = may_unescape and "<" not in line
        lines.append(_straightened(line, may_unescape))
    plain = html.unescape(html.unescape("\n".join(lines)))
    return " ".join(plain.split()).lower()


def without_marks(text: str) -> str:
    """Lower-case ``text`` in which CLIP's start and end marks are split into ordinary words.

    The spaces are where open_clip's tokenizer splits these texts anyway. Its own ``<start_of_text>`` and
    ``<end_of_text>``, which begin and end a text there at any position, are words here too: no text can end another.

    >>> without_marks("a chair<|endoftext|>")
    'a chair<| endoftext |>'
    """
    return _MARK.sub(r"<| \1 |>", text)


def _straightened(line: str, may_unescape: bool) -> str:
    """A line as in ``ftfy.fix_text``: its steps in its order until nothing changes any more."""
    while True:
        before = line
        if may_unescape:
            line = _ENTITY.sub(lambda match: _character(match[0]), line)
        for table in _STRAIGHT:
            line = line.translate(table)
        line = _without_surrogates(line)
        line = unicodedata.normalize("NFC", _TERMINAL_COMMAND.sub("", line).translate(_NO_TEXT))
        if line == before:
            return line


def _character(entity: str) -> str:
    """The character of an HTML ``entity``; for ``&EACUTE;``, which does not exist, the capital of ``&eacute;``."""
    name = entity[1:]
    if name in html5:
        return html5[name]
    plain = html.unescape(entity)
    if name.startswith("#"):
        return entity if ";" in plain else plain
    if plain == entity and name == name.upper() and name.lower() in html5:
        return html5[name.lower()].upper()
    return entity


def _without_surrogates(line: str) -> str:
    """``line`` with pairs of surrogates replaced by their characters, and single ones by U+FFFD."""
    if not any("\ud800" <= character <= "\udfff" for character in line):
        return line
    return line.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")


TokensKind = Literal["clip", "siglip"]
Tokeniser = Callable[[Sequence[str]], Int64Array]
_CLIP_FILES = ("tokenizer.json", "vocab.json", "merges.txt", "tokenizer_config.json", "special_tokens_map.json")
TOKENS_VERSION = "2"


def read_tokeniser(folder: Path, kind: TokensKind, n_tokens: int, pad_id: int | None, n_words: int) -> Tokeniser:
    """A function from texts to rows (N, n_tokens) of ids below ``n_words``; longer texts keep their end token.

    ``clip``: transformers' ``CLIPTokenizer`` on texts cleaned as in open_clip. ``siglip``: the folder's
    ``tokenizer.json`` on lower-case texts without punctuation, padded with ``pad_id`` as in training.
    """
    encode = _clip(folder, n_tokens) if kind == "clip" else _siglip(folder, n_tokens, pad_id or 0)

    def tokens(texts: Sequence[str]) -> Int64Array:
        if not texts:
            return np.zeros((0, n_tokens), np.int64)
        ids = np.array(encode(list(texts)), np.int64).reshape(len(texts), n_tokens)
        if ids.max() >= n_words or ids.min() < 0:
            raise DataError(
                f"{folder}: the tokenizer returns id {int(ids.max())}, but the text tower has only {n_words} words; "
                "the files belong to different models, download them again"
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
    read_settings(folder / "tokenizer.json")  # checks its size and reports an invalid file
    tokenizer = _load(folder, lambda: tokenizers.Tokenizer.from_file(str(folder / "tokenizer.json")))
    tokenizer.enable_truncation(n_tokens)
    tokenizer.enable_padding(length=n_tokens, pad_id=pad_id)
    return lambda texts: [encoding.ids for encoding in tokenizer.encode_batch([canonical_text(text) for text in texts])]


def canonical_text(text: str) -> str:
    """``text`` in lower case without punctuation, words separated by one space, as in SigLIP's training."""
    bare = text.translate(str.maketrans("", "", string.punctuation))
    return " ".join(bare.lower().split())


def _load(folder: Path, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as error:  # tokenizers raises plain Exception for an invalid file; others are re-raised
        if type(error) is Exception or isinstance(error, OSError | ValueError | KeyError | TypeError | AttributeError):
            raise DataError(f"{folder}: unreadable tokenizer: {bounded(error)}; download it again") from error
        raise
