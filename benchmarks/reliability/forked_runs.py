"""Runs of the command as forked processes, for scripts that disturb them, and the resulting content of their folders.

Each run is forked from a process with loaded modules, so that disturbances hit the work, not the
start.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from folders import ROOT

SCENES = ROOT / "tests/support/scenes"
METHODS = ("opensu3d", "sam3d", "conceptfusion")
RUN = ("run", "--protocols", "rooms-semantic", "rooms-instance", "--anytime", "0.5", "--no-pictures", "--quiet")
SUBJECTS = {
    "light": (
        *RUN, "--scenes", *(f"{SCENES}/kill_subject.py:Painted/{scene}" for scene in "abc"),
        "--methods", f"{SCENES}/painted.py:Collector", f"{SCENES}/kill_subject.py:Dense",
        "--set", "painted.n_frames=4", "painted.frame_ms=10.0", "collector.noise_m=0.01",
    ),
    "opensu3d": (
        *RUN, "--scenes", *(f"{SCENES}/painted.py:Painted/{scene}" for scene in "ab"),
        "--methods", *METHODS, "--profile", "oracle",
        "--set", "painted.n_frames=4", *(f"{name}.stride=1" for name in METHODS),
    ),
}  # fmt: skip
# The method ``command``; ``command.command`` is set once there is a prediction for the program to write.
SUBJECTS["program"] = (
    *RUN, "--scenes", *(f"{SCENES}/kill_subject.py:Painted/{scene}" for scene in "ab"),
    "--methods", "command", "--set", "painted.n_frames=2",
)  # fmt: skip
EXECUTORS = {
    "inline": ("--jobs", "1"),
    "processes": ("--jobs", "2"),
}
PROGRAM_FIELDS = ("info: program: ", "info: the program took ")
TIMES = ("_ms", "rss_bytes")
COMPLETE, INCOMPLETE = 0, 3  # exit codes of the command


class ForkedProcess:
    """The command line ``words``, executed in the folder ``at`` by a separate process group."""

    def __init__(self, words: Sequence[str], log: Path, at: Path | None = None) -> None:
        self._log = log
        self.started = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            self._become_command(list(words), at)

    def _become_command(self, words: list[str], at: Path | None) -> None:
        code = 4
        try:
            os.setsid()
            signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
            if at is not None:
                os.chdir(at)
            log = os.open(self._log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            from su3d_bench.cli.main import main

            code = main(words)
            sys.stdout.flush()
            sys.stderr.flush()
        except KeyboardInterrupt:  # just before or after the command
            code = 130
        finally:
            os._exit(code)

    def finish(self) -> int:
        """The exit code; the negative signal number if a signal ended it."""
        _, status = os.waitpid(self.pid, 0)
        return os.waitstatus_to_exitcode(status)

    def has_ended(self) -> bool:
        """Whether it has ended; its exit code remains available."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def output(self) -> str:
        return self._log.read_text(errors="replace")[-2000:]


class Run(ForkedProcess):
    """A run into ``folder``, executed next to it."""

    def __init__(self, folder: Path, request: Sequence[str], log: Path | None = None) -> None:
        super().__init__((*request, "--out", str(folder)), log or folder.with_suffix(".log"), folder.parent)


def outcome(folder: Path) -> dict[str, Any]:
    """Content of every file of a run folder, without times and measurements."""
    return {
        path.relative_to(folder).as_posix(): _timeless(path) for path in sorted(folder.rglob("*")) if path.is_file()
    }


def program_of(ready: Path) -> str:
    """The setting by which the method ``command`` starts a program that starts another one and writes ``ready``."""
    words = [sys.executable, str(Path(__file__).with_name("kill_program.py")), "{output}", str(ready)]
    return f"command.command={json.dumps(words)}"


def _timeless(path: Path) -> Any:
    content = path.read_bytes()
    if path.name == "log.txt":
        return [line for line in content.decode().splitlines() if not line.startswith(PROGRAM_FIELDS)]
    if path.name == "updates.csv":
        rows = list(csv.DictReader(io.StringIO(content.decode())))
        return [{name: value for name, value in row.items() if not name.endswith(TIMES)} for row in rows]
    if path.name == "done.json":
        record = json.loads(content)
        for step in record["steps"].values():
            step["files"].pop("updates.csv", None)
            step["remarks"].pop("costs", None)
            if path.parent.name == "command":  # its log contains times and folders
                step["files"].pop("log.txt", None)
                step["remarks"].pop("log", None)
        return record
    return content


def false_seals(folder: Path, expected: dict[str, Any]) -> list[str]:
    """Files covered by a completion record, or by a run read as finished, that differ from those of a complete run."""
    from su3d_bench.core.digests import digest_file
    from su3d_bench.core.errors import Su3dError
    from su3d_bench.runs.finished import read_run
    from su3d_bench.store.run_folder import JobFolder

    wrong = []
    for done in folder.rglob("done.json"):
        for mark_complete in JobFolder(done.parent).completion_records().values():
            files = {done.parent / name: sha for name, sha in mark_complete.files.items()}
            if all(path.is_file() and digest_file(path) == sha for path, sha in files.items()):
                names = [path.relative_to(folder).as_posix() for path in files]
                wrong += [name for name in names if _timeless(folder / name) != expected.get(name)]
    with contextlib.suppress(Su3dError):
        run = read_run(folder)
        if run.is_incomplete:
            return wrong
        for method in run.methods:
            run.scores(method)
        present = outcome(folder)
        wrong += [f"{name} of a run that reads as finished" for name in expected if present.get(name) != expected[name]]
    return wrong


def load_modules(subject: str) -> None:
    """Import a run's modules in this process, which must not start threads."""
    from su3d_bench.runs.executors import limit_threads

    limit_threads()
    import su3d_bench.cli.main
    import su3d_bench.reports.tables.run
    import su3d_bench.runs.plan
    import su3d_bench.runs.runner

    if subject == "opensu3d":
        import sklearn.cluster  # noqa: F401

        import su3d_bench.baselines.conceptfusion.method
        import su3d_bench.baselines.sam3d.method
        import su3d_bench.opensu3d.pipeline  # noqa: F401
