"""Text features of class names: from a user's file or an available encoder; and writing such a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, converted, printable, shown
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.formats.numpy_files import read_npz
from su3d_bench.metrics.protocols.model import ProtocolRules

MAX_NAMES = 1 << 20


@dataclass(frozen=True)
class TextFeatures:
    """Features (C, D) from ``path``, one for each of ``names``, which are class names or whole prompts.

    ``encoder``: the encoder that made them, if the file names it.
    """

    path: Path
    names: tuple[str, ...]
    features: Float32Array
    encoder: str

    @property
    def dim(self) -> int:
        return int(self.features.shape[1])

    def missing(self, rules: ProtocolRules) -> list[str]:
        """The candidate classes of the protocol that have no feature here."""
        known, names = set(self.names), candidate_names(rules)
        return [name for name in names if name not in known and not known.issuperset(rules.texts_of(name))]


class GivenTextEncoder:
    """``TextFeatures`` instead of the protocol's encoder: a prompt has its own feature, or that of its class."""

    def __init__(self, given: TextFeatures, rules: ProtocolRules) -> None:
        self.name = given.encoder
        self.dim = given.dim
        self._given = given
        self._row_of = {name: row for row, name in enumerate(given.names)}
        self._class_of = {text: entry.name for entry in rules.classes for text in rules.texts_of(entry.name)}

    @property
    def digest(self) -> str:
        return digest_file(self._given.path)

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise PredictionError(f"{shown(self._given.path)}: has text features, not image features")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        rows = [self._row_of.get(text, self._row_of.get(self._class_of.get(text, text), -1)) for text in texts]
        if -1 in rows:
            raise PredictionError(f"{shown(self._given.path)}: has no feature for '{texts[rows.index(-1)]}'")
        return self._given.features[rows]


def read_text_features(path: Path | None) -> TextFeatures | None:
    """The arrays ``names`` (C,) and ``features`` (C, D) of a .npz file, and ``encoder``, a text, if present."""
    if path is None:
        return None
    where = shown(path)
    with converted(PredictionError, DataError):
        arrays = read_npz(path, ("names", "features", "encoder"))
    names, features = arrays.get("names"), arrays.get("features")
    if names is None or features is None:
        raise DataError(f"{where}: has no 'names' and 'features'; expected both, one row of features per name")
    are_arrays = names.ndim == 1 and names.dtype.kind == "U" and features.ndim == 2 and features.dtype.kind == "f"
    if not are_arrays or not 0 < len(names) == len(features) <= MAX_NAMES or not np.isfinite(features).all():
        raise DataError(
            f"{where}: names {names.shape} {names.dtype}, features {features.shape} {features.dtype}; expected texts "
            f"(C,), at most {MAX_NAMES}, and a row of finite numbers (C, D) each"
        )
    texts = tuple(str(name) for name in names)
    if len(set(texts)) < len(texts):
        twice = Counter(texts).most_common(1)[0][0]
        raise DataError(f"{where}: '{printable(twice, 80)}' occurs twice; give each name once")
    maker = arrays.get("encoder")
    if maker is not None and (maker.ndim != 0 or maker.dtype.kind != "U"):
        raise DataError(f"{where}: 'encoder' is {maker.shape} {maker.dtype.kind}; expected one text")
    encoder = f"of {path.name}" if maker is None else printable(str(maker), 80)
    return TextFeatures(path, texts, features.astype(np.float32), encoder)


def encoder_for(rules: ProtocolRules, n_dimensions: int, given: TextFeatures | None, *, is_own: bool) -> Encoder | str:
    """The encoder that classifies features of ``n_dimensions`` under a protocol, or why there is none.

    ``is_own``: the features come from a run of this program; the embedded encoder is recognized by the number of
    dimensions. The protocol's encoder is used if its files are available.
    """
    if given is not None:
        missing = given.missing(rules)
        if missing:
            return f"{given.path.name} has no feature for {len(missing)} of its classes, such as '{missing[0]}'"
        if given.dim != n_dimensions:
            return f"the features have {n_dimensions} dimensions, those in {given.path.name} {given.dim}"
        return GivenTextEncoder(given, rules)
    from su3d_bench.perception.embedded.encoder import EmbeddedEncoder

    embedded = EmbeddedEncoder()
    if n_dimensions == embedded.dim and (is_own or rules.encoder in {None, embedded.name}):
        return embedded
    how = "give features of its class names with --text-features FILE.npz (names, features)"
    if rules.encoder is None:
        return f"no encoder with {n_dimensions} dimensions is available to classify the features; {how}"
    if (encoder := _real_encoder(rules.encoder)) is None:
        return f"needs the encoder '{rules.encoder}' to classify the features, which is not available; {how}"
    if encoder.dim != n_dimensions:
        return f"the features have {n_dimensions} dimensions, those of '{rules.encoder}' {encoder.dim}; {how}"
    return encoder


def _real_encoder(name: str) -> Encoder | None:
    """The foundation model that protocols call ``name``; None if unknown or its files are not available."""
    from su3d_bench.perception.models.catalogue import encoder_known_as
    from su3d_bench.perception.models.loading import model_state

    entry = encoder_known_as(name)
    forms = () if entry is None else model_state(entry).files
    found = next((files for files in forms if files.form.form == "transformers"), None)
    return None if entry is None or found is None else _loaded(entry.name, found.folder, found.state)


@lru_cache(maxsize=2)
def _loaded(name: str, folder: Path, state: object) -> Encoder:
    """The encoder in ``folder``, cached with the features of the texts that it has encoded."""
    from su3d_bench.perception.models.config import ModelsConfig
    from su3d_bench.perception.models.loading import load_encoder

    return load_encoder(ModelsConfig(encoder=name, paths={name: folder}))


# ---- writing the file


def candidate_names(rules: ProtocolRules) -> list[str]:
    """The candidate classes of a protocol, whose texts features are compared with."""
    return [entry.name for entry in (rules.classes if rules.vocabulary == "all" else rules.scored)]


def named_texts(rules: ProtocolRules, queries: Path | None) -> dict[str, tuple[str, ...]]:
    """The texts for each name that a protocol compares features with: its classes, or those of a file.

    ``ConfigError`` if it compares none, if it has classes and a file is given, or if it has neither.
    """
    if rules.prompt is None and not rules.prompts:
        raise ConfigError(f"protocol '{rules.name}' does not compare features with texts; there is nothing to encode")
    if rules.classes and queries is not None:
        raise ConfigError(f"protocol '{rules.name}' uses its classes as texts; remove --queries")
    if not rules.classes and queries is None:
        raise ConfigError(
            f"protocol '{rules.name}' has no own texts; give them with --queries FILE: .toml or .csv as "
            "for evaluate, .json of OpenLex3D, or .txt with one per line"
        )
    names = candidate_names(rules) if queries is None else dict.fromkeys(_texts_of_file(queries))
    return {name: rules.texts_of(name) for name in names}


def _texts_of_file(path: Path) -> list[str]:
    """Every text of a query file, without its objects, or of a list with one text per line."""
    from su3d_bench.datasets.openlex3d.release import read_prompts, read_queries
    from su3d_bench.questions.query_files import read_query_rows

    if path.suffix.lower() == ".txt":
        return list(read_prompts(path, shown(path)))
    if path.suffix.lower() == ".json":
        return [query.text for query in read_queries(path, shown(path))]
    return [row.text for _, row in read_query_rows(path)]


def distinct_texts(named: Mapping[str, Sequence[str]]) -> list[str]:
    """The texts to encode, without repeats, in the order of the names."""
    return list(dict.fromkeys(text for texts in named.values() for text in texts))


def text_arrays(texts: Sequence[str], encoder: Encoder) -> dict[str, NDArray[Any]]:
    """The arrays of a file for ``read_text_features``: one feature per text; the protocol averages them."""
    features = encoder.encode_texts(texts)
    return {"names": np.array(texts, np.str_), "features": features, "encoder": np.array(encoder.name, np.str_)}
