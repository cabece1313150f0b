"""What keeps a row out of a registry: rows that are ranked against each other answer the same question.

Within a registry a protocol has one set of rules, to the digest; a scene has one state of its data, to the digest; what
a protocol's features are compared with is one encoder where the protocol names one; rows of one ranking give as many
labels a mask or point; and a method stands once in a ranking.
"""

from __future__ import annotations

from collections.abc import Sequence

from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.reproducing.registry.rows import Row

N_DIGITS = 12  # of a digest, in a message


def why_not_beside(row: Row, held: Sequence[Row]) -> str | None:
    """Why ``row`` cannot stand in a registry that holds the rows ``held``, with what to do; None where it can."""
    for other in held:
        fault = (
            _rules(row, other) or _data(row, other) or _encoder(row, other) or _name(row, other) or _labels(row, other)
        )
        if fault is not None:
            return f"{row.what}: {fault}"
    return None


def _rules(row: Row, other: Row) -> str | None:
    mine, theirs = row.entry, other.entry
    if mine.protocol != theirs.protocol or (mine.version, mine.digest) == (theirs.version, theirs.digest):
        return None
    return (
        f"its protocol is version {mine.version}, digest {mine.digest[:N_DIGITS]}, that of {_where(other)} is version "
        f"{theirs.version}, digest {theirs.digest[:N_DIGITS]}; score it again by those rules, or begin another registry"
    )


def _data(row: Row, other: Row) -> str | None:
    theirs = dict(other.entry.data)
    for scene, digest in row.entry.data:
        if theirs.get(scene, digest) != digest:
            return (
                f"its data of {scene} have the digest {digest[:N_DIGITS]}, those of {_where(other)} "
                f"{theirs[scene][:N_DIGITS]}; run it on the same data, settings of the dataset included"
            )
    return None


def _encoder(row: Row, other: Row) -> str | None:
    """Features are compared with those of texts: under a protocol that names an encoder, of one encoder alone."""
    if row.entry.protocol != other.entry.protocol or None in (row.encoder, other.encoder):
        return None
    if not _names_encoder(row.entry.protocol):
        return None
    if row.encoder != other.encoder:
        return (
            f"its features are of the encoder {row.encoder}, those of {_where(other)} of {other.encoder}, and the "
            "protocol is of one encoder; run it with that one"
        )
    mine, theirs = ({one.model: one.files for one in each.weights if one.files} for each in (row, other))
    for model in mine.keys() & theirs.keys():
        if model_is_encoder(model) and mine[model] != theirs[model]:
            return f"its weights of {model} are not those of {_where(other)} (other SHA-256); run it with the same file"
    return None


def model_is_encoder(model: str) -> bool:
    """Whether a model of the catalogue encodes crops and texts."""
    from su3d_bench.perception.models.catalogue import MODELS

    return model in MODELS and MODELS[model].kind == "encoder"


def _names_encoder(protocol: str) -> bool:
    try:
        return protocol in protocol_names() and load_protocol(protocol).encoder is not None
    except ConfigError:  # somebody's own rules, which their run keeps
        return False


def _name(row: Row, other: Row) -> str | None:
    if row.entry.ranking != other.entry.ranking or row.entry.method.casefold() != other.entry.method.casefold():
        return None
    return (
        f"that name is taken by {_where(other)} over the same scenes; give the variant its own name, such as "
        f"{row.entry.method.partition('@')[0]}@KEY=VALUE, or remove the other bundle first"
    )


def _labels(row: Row, other: Row) -> str | None:
    mine, theirs = row.entry, other.entry
    if mine.ranking != theirs.ranking or mine.is_ceiling or theirs.is_ceiling or mine.labels == theirs.labels:
        return None
    return f"is of {mine.labels}, {_where(other)} of {theirs.labels}; score it with as many labels"


def _where(row: Row) -> str:
    return f"{row.entry.method} in {row.bundle.name}.zip"
