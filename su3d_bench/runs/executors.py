"""Where units of work run: in this process or each in its own spawned process; for other machines see ``clusters``.

A unit that crashes its process (killed for memory, a crash in native code) fails alone. Numerical libraries are
limited to one thread everywhere, so that no result depends on how many units run in parallel.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from su3d_bench.core.config import RunConfig, parse_value, size_bytes
from su3d_bench.core.errors import ConfigError, Su3dError
from su3d_bench.core.safe_output import answers_apart, doors
from su3d_bench.core.system.signals import Terminated, ending_in_order

ENDING_S = 20.0  # for a worker without a parent to release its resources; Slurm kills a job 30 s after asking it to end
# For a worker whose parent was asked to end. One that is loading a library or searching a tree cannot react meanwhile;
# it is killed then, as by a power failure, after which all files on disk are intact and the scene can be resumed.
PATIENCE_S = 1.0
PARENT_SIGNALS = frozenset({signal.SIGINT, signal.SIGHUP})  # a terminal sends them to both; the parent decides
SCENE_DONE = "scene"  # label of the event for a finished unit
Unit = TypeVar("Unit")
Outcome = TypeVar("Outcome")
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA")
ONE_THREAD = {"VECLIB_MAXIMUM_THREADS": "1", **{f"{library}_NUM_THREADS": "1" for library in _LIBRARIES}}


@dataclass(frozen=True)
class Event:
    """Progress of one unit: ``done`` of ``total`` steps under ``label`` (0 while unknown), ``n_instances`` so far.

    ``activity``: the activity from now on that is not one of these steps.
    """

    unit: str
    label: str
    done: int = 0
    total: int = 0
    n_instances: int | None = None
    activity: str = ""


Report = Callable[[Event], None]
Work = Callable[[Unit, Report], Outcome]


def limit_threads() -> None:
    """Limit libraries that are loaded from now on, in this process and its children, to one thread."""
    os.environ.update(ONE_THREAD)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit the libraries that are already loaded to one thread for the duration of the block."""
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        cv2.setNumThreads(before)


def run_inline(work: Work[Unit, Outcome], units: Sequence[Unit], report: Report) -> Iterator[Outcome]:
    """Outcomes of ``units`` one after the other, in this process."""
    for unit in units:
        with one_thread():
            outcome = work(unit, report)
        yield outcome


def run_processes(
    work: Work[Unit, Outcome],
    units: Sequence[Unit],
    report: Report,
    *,
    jobs: int,
    lost: Callable[[Unit, str], Outcome],
    memory: str = "",
) -> Iterator[Outcome]:
    """Outcomes of ``units`` as they complete, at most ``jobs`` in parallel, each unit in a fresh spawned process.

    ``lost`` creates the outcome of a unit whose process died, from a clause describing how. A ``Su3dError`` raised by
    ``work``, or an interrupt, stops all units. ``memory``: the limit of each process, such as 8G.
    """
    waiting = list(reversed(units))
    running: dict[Connection, tuple[Unit, BaseProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                unit = waiting.pop()
                connection, process = _start(work, unit, memory)
                running[connection] = unit, process
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                message = _receive(ready)
                if message is not None and message[0] == "event":
                    report(message[1])
                    continue
                unit, process = running.pop(ready)
                process.join()
                ready.close()
                yield lost(unit, _cause(process.exitcode, memory)) if message is None else unwrap(message)
    finally:
        _end([process for _, process in running.values()])
        for connection in running:
            connection.close()


def _end(processes: Sequence[BaseProcess]) -> None:
    """Ask workers to release their resources and end, and kill those that do not in time."""
    for process in processes:
        process.terminate()
    until = time.monotonic() + PATIENCE_S
    for process in processes:
        process.join(max(until - time.monotonic(), 0.0))
        if process.is_alive():
            process.kill()
            process.join()


def _start(work: Work[Unit, Outcome], unit: Unit, memory: str) -> tuple[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    limit_threads()
    # A worker that is still importing would answer an interrupt with a traceback, so it inherits blocked signals. The
    # resource tracker, whose start would unblock them, has started by then.
    resource_tracker.ensure_running()
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, PARENT_SIGNALS)
    try:
        process = context.Process(target=_worker, args=(work, unit, theirs, memory), daemon=True)
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    theirs.close()
    return ours, process


def _receive(connection: Connection) -> tuple[str, Any] | None:
    """The next message of a worker; None if it died, even in the middle of a message."""
    try:
        message: tuple[str, Any] = connection.recv()
    except (EOFError, OSError):
        return None
    return message


def answer_of(work: Work[Unit, Outcome], unit: Unit, report: Report) -> tuple[str, Any]:
    """The outcome of ``unit`` in this process, as a message for ``unwrap``; raises only ``Terminated``."""
    try:
        with doors(), answers_apart(), one_thread():
            return "outcome", work(unit, report)
    except Su3dError as error:
        return "user-error", error
    except Terminated:
        raise
    except BaseException:  # noqa: BLE001 - ``unwrap`` raises it again, with its traceback
        return "internal-error", traceback.format_exc()


def unwrap(message: tuple[str, Any]) -> Any:
    """The outcome in a message of ``answer_of``; an error in it is raised here."""
    kind, content = message
    if kind == "user-error":
        raise content
    if kind == "internal-error":
        raise RuntimeError(f"a worker failed:\n{content}")
    return content


def _cause(exit_code: int | None, memory: str) -> str:
    if exit_code == -signal.SIGKILL:
        return "the worker was killed (signal 9), usually because memory ran out; try fewer --jobs"
    if exit_code is not None and exit_code < 0:
        hint = f"; native code may have exceeded --memory {memory}" if memory else ""
        return f"the worker crashed (signal {-exit_code}, {signal.Signals(-exit_code).name}){hint}"
    return f"the worker ended early (exit code {exit_code})"


def limit_memory(n_bytes: int | None) -> None:
    """Limit the memory of this process and its children, each alone; None removes the limit.

    The limit is ``RLIMIT_DATA``: on Linux private writable memory, such as arrays and heaps. ``RLIMIT_AS`` also counts
    libraries and reserved address space: a process with numba, ONNX Runtime and the embedded encoder has 185 MiB of the
    former, a resident set of 200 MiB and an address space of 720 MiB.
    """
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    soft = hard if n_bytes is None or (hard != resource.RLIM_INFINITY and n_bytes > hard) else n_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


# How programs and libraries report that memory cannot be allocated: C++, Python, OpenCV, ONNX Runtime, torch, threads.
_OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "Insufficient memory", "Failed to allocate memory",
                  "can't allocate memory", "can't start new thread")  # fmt: skip


def exceeds_memory(error: BaseException, memory: str) -> str | None:
    """One line if ``error`` is the end of a method that exceeded its limit, which is removed; otherwise None."""
    if not memory or not (isinstance(error, MemoryError) or any(words in str(error) for words in _OUT_OF_MEMORY)):
        return None
    limit_memory(None)  # so that the failure can be recorded
    return f"exceeded --memory {memory}; allow more, or use a smaller --limit"


def _worker(work: Work[Unit, Outcome], unit: Unit, connection: Connection, memory: str) -> None:
    for number in PARENT_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, PARENT_SIGNALS)
    if memory:
        limit_memory(size_bytes(memory))
    try:
        with ending_in_order():
            threading.Thread(target=_end_with_parent, daemon=True).start()
            connection.send(answer_of(work, unit, lambda event: connection.send(("event", event))))
            connection.close()
        gc.freeze()  # the process ends now: what is left need not be searched for cycles
    except Terminated as end:  # all resources are released; the exit signal reports the cause to the parent
        signal.signal(end.number, signal.SIG_DFL)
        os.kill(os.getpid(), end.number)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    main = threading.main_thread().ident
    assert parent is not None and main is not None
    parent.join()
    signal.pthread_kill(main, signal.SIGTERM)
    time.sleep(ENDING_S)
    os._exit(1)


# The executor on other machines, and its options; a value other than the default is rejected for other executors.
SLURM = "slurm"
SLURM_OPTIONS = ("gpus_per_job", "retries", "slurm")


def executor_of(config: RunConfig, n_workers: int) -> str:
    """The executor that ``auto`` selects: this process for one job without a memory limit, otherwise processes."""
    if config.executor != "auto":
        return config.executor
    return "inline" if n_workers == 1 and not config.memory else "processes"


def check_execution(config: RunConfig) -> None:
    """A ``ConfigError`` if an option has no effect with the requested executor."""
    for name in SLURM_OPTIONS:
        value = getattr(config, name)
        if value != RunConfig.model_fields[name].default and config.executor != SLURM:
            flag = f"--{name.replace('_', '-')} {' '.join(value) if isinstance(value, tuple) else value}"
            raise ConfigError(f"{flag}: has no effect with the executor '{config.executor}'; add --executor {SLURM}")
    if config.executor == "inline" and config.jobs > 1:
        raise ConfigError(f"--jobs {config.jobs}: the executor 'inline' runs one job; choose --executor processes")
    if config.memory and (config.executor in ("inline", SLURM) or sys.platform != "linux"):
        raise ConfigError(
            f"--memory {config.memory}: needs Linux and --executor processes; for Slurm, --slurm mem_gb=N"
        )
    slurm_parameters(config)


def slurm_parameters(config: RunConfig) -> dict[str, Any]:
    """The values of ``--slurm KEY=VALUE``, by key."""
    parameters = {}
    for text in config.slurm:
        key, equals, value = text.partition("=")
        if not equals or not key.strip().isidentifier():
            raise ConfigError(f"--slurm {text}: expected KEY=VALUE, such as slurm_partition=gpu timeout_min=60")
        parameters[key.strip()] = parse_value(value)
    return parameters
