"""The command line called in this process, and faults in the way it ended."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence

from fuzzing import BadMessage, fault_of_message

from su3d_bench.cli.main import main
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INCOMPLETE, EXIT_INTERNAL, Su3dError

MAX_LINES = 200  # on stderr: many faults are listed one by one


class Declined(Su3dError):
    """The command reported an error properly."""


def called(words: Sequence[str]) -> None:
    """Run a command; ``Declined`` if it reports an error properly, ``BadMessage`` if it does not."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(list(words))
    printed = err.getvalue()
    lines = printed.splitlines()
    if code == EXIT_INTERNAL or "Traceback" in printed:
        raise BadMessage(f"exit code {code}: {printed[-400:]}")
    for text in (*lines, *out.getvalue().split("\n")):
        fault = fault_of_message(text) if text.strip() else None
        if fault is not None and not fault.startswith(f"message: {len(text)} characters"):
            raise BadMessage(f"exit code {code}: {fault}")
    if code in (EXIT_DONE, EXIT_CHECK_FAILED, EXIT_INCOMPLETE):
        return
    if not lines or len(lines) > MAX_LINES or not lines[-1].startswith("su3d-bench: "):
        raise BadMessage(f"exit code {code} and {len(lines)} lines: {printed[-300:]!r}")
    if (fault := fault_of_message(lines[-1].removeprefix("su3d-bench: "))) is not None:
        raise BadMessage(f"exit code {code}: {fault}")
    raise Declined(lines[-1])
