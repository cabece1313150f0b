"""``su3d-bench``: parse the command line, call the command, turn errors into one line and an exit code."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from textwrap import wrap

from su3d_bench.cli.options import HelpFormatter, Parser
from su3d_bench.cli.output import remark
from su3d_bench.cli.paths import check_outputs
from su3d_bench.core import errors
from su3d_bench.core.errors import EXIT_DONE, EXIT_INTERNAL, EXIT_WRONG_INPUT, ConfigError, Su3dError, printable
from su3d_bench.core.safe_output import answers_apart, doors
from su3d_bench.core.system.signals import Terminated, ending_in_order
from su3d_bench.core.version import __version__

# The commands in the order of the help; each is in the module of its name, or in that of MODULE_OF.
GROUPS = {
    "run and score": ("run", "ablate", "robustness", "evaluate", "reproduce"),
    "compare and report": ("compare", "check", "report", "runs"),
    "questions and human evaluation": ("query", "sheets"),
    "data, models and methods": ("datasets", "models", "methods", "protocols"),
    "maintain": ("dev",),
}
MODULE_OF = {"ablate": "run", "check": "compare"}
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells
DESCRIPTION = "Evaluate and benchmark open-vocabulary, instance-level 3D scene understanding from RGB-D."
EPILOG = """examples:
  su3d-bench run --scenes homes/tuning0 --methods opensu3d oracle
  su3d-bench query text homes/tuning0 "plant on shelf"
"""


class Help(HelpFormatter):
    """Lists the commands in groups, each with the first clause of its help."""

    def _format_action(self, action: argparse.Action) -> str:
        if not isinstance(action, argparse._SubParsersAction):
            return super()._format_action(action)
        about = {one.dest: re.split("[:;]", str(one.help))[0] for one in action._choices_actions}
        lines = []
        for group, verbs in GROUPS.items():
            lines.append(f"  {group}:")
            for verb in verbs:
                lines += wrap(f"{verb:<10} {about[verb]}", 79, initial_indent=" " * 4, subsequent_indent=" " * 15)
        return "\n".join([*lines, ""])


def build_parser(verb: str | None = None) -> Parser:
    """The parser of all commands, or of ``verb`` only if it is one; imports nothing heavy."""
    parser = Parser(prog="su3d-bench", description=DESCRIPTION, epilog=EPILOG, formatter_class=Help)
    parser.add_argument("--version", action="version", version=f"su3d-bench {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="COMMAND", required=True)
    known = [one for group in GROUPS.values() for one in group]
    for name in dict.fromkeys(MODULE_OF.get(one, one) for one in ([verb] if verb in known else known)):
        import_module(f"su3d_bench.cli.{name}").add_parser(verbs)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` and return its exit code: 0 done, 1 check failed, 2 wrong input, 3 incomplete,
    4 internal.

    A closed pipe or stdout does not change the code; a write error on stdout, such as a full disk, turns 0 into 2.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    with doors() as out:
        code = _exit_code(words)
        out.flush()
        if out.refused is not None:
            reason = out.refused.strerror or out.refused
            remark(f"su3d-bench: stdout: write error ({reason}); results are saved, the printed output is incomplete")
            code = code or EXIT_WRONG_INPUT
    return code


def _exit_code(words: Sequence[str]) -> int:
    """Run the command; an error is one line on stderr, after its traceback with ``--debug``."""
    arguments = argparse.Namespace()
    if not words or words[0] == "help":
        words = [*words[1:], "--help"]
    try:
        parser = build_parser(words[0] if words else None)
        if "_ARGCOMPLETE" in os.environ:
            from su3d_bench.cli.completion import complete

            complete(parser)
        arguments = parser.parse_args(words)
        if "call" not in arguments:  # a group of commands without a command
            arguments = parser.parse_args([*words, arguments.without_command])
        arguments.words = words
        from su3d_bench.runs.executors import limit_threads  # late, so that --help stays fast

        if data := getattr(arguments, "data", None):
            if not os.path.isdir(data):
                raise ConfigError(f"--data {data}: no such folder; name the one that contains the datasets")
            os.environ["SU3D_DATA"] = os.path.abspath(data)  # workers inherit it
        check_outputs(arguments.parser, arguments)
        if not arguments.uses_all_cores:
            limit_threads()  # before numerical libraries are imported
        with ending_in_order(), answers_apart():
            code: int | None = arguments.call(arguments)
        return EXIT_DONE if code is None else code
    except KeyboardInterrupt as end:
        how = "interrupted" if str(end) in ("", "SIGINT") else f"stopped by {end}"
        again = "resumes" if getattr(arguments, "resumes", False) else "starts again"
        remark(f"su3d-bench: {how}; the same command {again}")
        return end.exit_code if isinstance(end, Terminated) else EXIT_INTERRUPTED
    except BaseException as error:  # noqa: BLE001 - the one place that turns every other exception into a line
        if isinstance(error, SystemExit) and "call" not in arguments:  # of the parser
            return error.code if isinstance(error.code, int) else EXIT_WRONG_INPUT if error.code else EXIT_DONE
        is_debug = "--debug" in words
        if is_debug:
            import traceback

            traceback.print_exc()
        if isinstance(error, Su3dError):
            remark(f"su3d-bench: {error}", *(f"  {note}" for note in getattr(error, "__notes__", ())))
            return error.exit_code
        if errors.user_code_line(error) or errors.is_unusable_path(error):  # of user-defined code, or a path
            remark(f"su3d-bench: {errors.error_line(error)}")
            return EXIT_WRONG_INPUT
        text = printable(f"{type(error).__name__}: {error}")
        hint = "" if is_debug else "; run again with --debug for the traceback"
        remark(f"su3d-bench: internal error: {text}{hint}")
        return EXIT_INTERNAL
