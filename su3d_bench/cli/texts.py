"""``su3d-bench protocols texts``: features of what predictions are named with, for ``evaluate --text-features``."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either, remark
from su3d_bench.cli.shared.flags import add_settings, add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError, shown, suggest

SUFFIX = ".npz"
FORMS_OF_EVALUATE = (".toml", ".csv")  # of queries, with the objects that they speak of


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        "texts",
        "Encode every text of a protocol: its classes under its prompts, or queries, for evaluate --text-features.",
        (
            "su3d-bench protocols texts --protocol rooms-semantic --encoder embedded --out texts.npz",
            "su3d-bench protocols texts --protocol replica-openmask3d --encoder clip-vit-l-14-336 --out texts.npz",
        ),
        call,
    )
    parser.add_argument("--protocol", required=True, metavar="P", help="whose texts; a name, or a .toml file")
    parser.add_argument(
        "--encoder", metavar="E", help="what encodes them, a name of su3d-bench models list (default: the protocol's)"
    )
    add_queries(parser)
    parser.add_argument("--device", help="cpu, cuda or cuda:1 (default: cpu)")
    add_settings(parser, "a setting of perception, such as perception.models.folder=/data/models")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="where names and features go")


def add_queries(parser: argparse.ArgumentParser) -> None:
    """``--queries``: the texts of a protocol that has no classes."""
    parser.add_argument(
        "--queries",
        type=Path,
        metavar="FILE",
        help="texts for a protocol without classes: .toml or .csv as evaluate takes them, .json of OpenLex3D, or .txt "
        "with one a line",
    )


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.cli.models import perception_config
    from su3d_bench.core.files.atomic import make_folder, write_npz
    from su3d_bench.evaluation.texts import distinct_texts, named_texts, text_arrays
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.perception.models.loading import load_encoder
    from su3d_bench.store.run_folder import refuse_records

    out: Path = arguments.out
    if out.suffix != SUFFIX:
        raise ConfigError(f"protocols texts: --out {shown(out)}: give a file that ends in {SUFFIX}")
    rules = load_protocol(arguments.protocol)
    named = named_texts(rules, arguments.queries)
    name = _encoder_name(arguments.encoder, rules.name, rules.encoder)
    refuse_records(out)
    models = perception_config(arguments).models.model_copy(update={"encoder": name})
    encoder = load_encoder(models)
    texts = distinct_texts(named)
    arrays = text_arrays(texts, encoder)
    make_folder(out.parent)
    write_npz(out, arrays)
    n_dimensions = int(arrays["features"].shape[1])
    value = {
        "file": str(out),
        "protocol": rules.name,
        "encoder": encoder.name,
        "encoder_digest": encoder.digest,
        "n_names": len(named),
        "n_texts": len(texts),
        "n_dimensions": n_dimensions,
    }
    answer_either(
        arguments,
        value,
        f"{out}: {len(texts)} texts for {len(named)} names of {rules.name}, {n_dimensions} dimensions, encoder "
        f"'{encoder.name}'",
    )
    words = ["--protocols", arguments.protocol, "--text-features", str(out)]
    if arguments.queries is not None and arguments.queries.suffix.lower() in FORMS_OF_EVALUATE:
        words += ["--queries", str(arguments.queries)]
    remark(f"use: su3d-bench evaluate PREDICTIONS {shlex.join(words)}", quiet=arguments.quiet)
    return EXIT_DONE


def _encoder_name(said: str | None, protocol: str, of_protocol: str | None) -> str:
    """The model's short name of the encoder that is asked for, else of the protocol's own."""
    from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
    from su3d_bench.perception.models.catalogue import MODELS, encoder_known_as
    from su3d_bench.perception.models.config import EMBEDDED

    known = [EMBEDDED, *(entry.name for entry in MODELS.values() if entry.kind == "encoder")]
    asked = of_protocol if said is None else said
    if asked is None:
        listed = ", ".join(known)
        raise ConfigError(f"protocols texts: protocol '{protocol}' names no encoder; name one with --encoder: {listed}")
    if asked in known:
        return asked
    if asked == EmbeddedEncoder.name:
        return EMBEDDED
    if (entry := encoder_known_as(asked)) is not None:
        return entry.name
    whose = "" if said is not None else f" of protocol '{protocol}'"
    hint = suggest(asked, known) or f"; known: {', '.join(known)}"
    raise ConfigError(f"protocols texts: unknown encoder '{asked}'{whose}{hint}")
