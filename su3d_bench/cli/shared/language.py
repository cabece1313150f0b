"""What verbs that ask a language model share: their flags, its client, what asking costs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_settings
from su3d_bench.core.errors import EXIT_DONE

if TYPE_CHECKING:
    from su3d_bench.perception.language.chat import ChatRequest
    from su3d_bench.perception.language.client import ChatClient
    from su3d_bench.perception.language.config import LanguageConfig
    from su3d_bench.store.run_folder import RunFolder


def answer_estimate(arguments: argparse.Namespace, client: ChatClient, requests: Sequence[ChatRequest]) -> int:
    """Print what asking a language model all ``requests`` would cost; the exit code."""
    estimate = client.estimate(requests)
    answer_either(arguments, estimate.to_json(), estimate.line())
    return EXIT_DONE


def answer_nothing_to_pay(arguments: argparse.Namespace, who: str) -> int:
    """Say that ``who`` asks no language model; the exit code."""
    from su3d_bench.perception.language.client import Estimate

    nothing = Estimate(n_requests=0, n_stored=0, input_tokens=0, output_tokens=0, usd=0.0, models=())
    answer_either(arguments, nothing.to_json(), f"{who} asks no model: nothing to pay")
    return EXIT_DONE


PREFIX = ("perception", "language")


def add_language_flags(parser: argparse.ArgumentParser, default: str = "the paper's gpt-4-1106-preview") -> None:
    """``--model``, ``--base-url``, ``--config``, ``--set``, ``--offline``, ``--ask-failed-again``, ``--dry-run``."""
    parser.add_argument("--model", metavar="NAME", help=f"language model (default: {default})")
    parser.add_argument(
        "--base-url", metavar="URL", help="OpenAI-compatible server (default: $OPENAI_BASE_URL, else OpenAI's)"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="a TOML file with [perception.language]")
    add_settings(parser, "such as perception.language.budget_usd=0.5")
    parser.add_argument("--offline", action="store_true", help="stored replies only; nobody is asked")
    parser.add_argument(
        "--ask-failed-again", action="store_true", help="ask again what an earlier command asked in vain"
    )
    parser.add_argument("--dry-run", action="store_true", help="say what asking would cost, and ask nothing")


def chat_client(
    arguments: argparse.Namespace, run: RunFolder, text_model: str | None = None
) -> tuple[ChatClient, LanguageConfig]:
    """The client whose replies are kept in the folder ``language`` of the run, and its settings.

    Those of the file, then ``--set``, then the flags; keys of other sections are left to other verbs. ``text_model``:
    what is asked where none of them names a model.
    """
    from su3d_bench.core.config import Setting, Settings, read_assignments, read_file, resolve
    from su3d_bench.core.errors import ConfigError
    from su3d_bench.perception.language.client import ChatClient
    from su3d_bench.perception.language.config import LanguageConfig
    from su3d_bench.perception.language.reply_store import ReplyStore

    settings = Settings() if arguments.config is None else read_file(arguments.config)
    assigned = read_assignments(arguments.set, (), ())
    for entry in assigned.entries:
        if entry.path[:2] != PREFIX:
            raise ConfigError(f"{entry.source}: only perception.language.KEY=VALUE is of use here")
    flags = [("text_model", "--model", arguments.model), ("base_url", "--base-url", arguments.base_url)]
    given = tuple(Setting((*PREFIX, key), value, flag) for key, flag, value in flags if value is not None)
    usual = () if text_model is None else (Setting((*PREFIX, "text_model"), text_model, "default"),)
    config = resolve(Settings(usual) + settings + assigned + Settings(given), PREFIX, LanguageConfig)
    store = ReplyStore(run.path / "language")
    arguments.takes_up = True  # with every reply that is there
    return ChatClient(config, store, offline=arguments.offline, ask_failed_again=arguments.ask_failed_again), config
