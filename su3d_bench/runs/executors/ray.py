"""Where units of work run: on the machines of an existing Ray cluster.

Each unit has a fresh worker process, as with processes here. Ray's own retries are switched off: only a unit whose
worker or machine was lost runs again, a bounded number of times, and what its work answers is final.
"""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from su3d_bench.core.config import RunConfig
from su3d_bench.core.digests import NUMERIC_PACKAGES, code_digest, package_versions
from su3d_bench.core.errors import ConfigError, ModelMissing, StoreError
from su3d_bench.core.system.endings import Ended, ending_in_order, kept_handlers
from su3d_bench.runs.executors.local import Outcome, Report, Unit, Work, answer_of, limit_threads, unwrap

CONNECT_S = 5.0  # a machine of a cluster in one network answers within milliseconds
ENDED = "ended"  # the kind of answer of a worker that was asked to end
MOST_AT_ONCE = 1000  # each pending task costs the driver memory, and each wait a look at all of them


def run_ray(
    work: Work[Unit, Outcome],
    units: Sequence[Unit],
    report: Report,
    *,
    jobs: int,
    config: RunConfig,
    ray: Any,
    lost: Callable[[Unit, str], Outcome],
) -> Iterator[Outcome]:
    """Outcomes of ``units`` as they come in, at most ``jobs`` of them handed to the cluster at once.

    ``ray`` is what ``connected`` gave. A unit whose worker or machine was lost ``config.retries`` + 1 times has the
    outcome that ``lost`` makes. A ``Su3dError`` that leaves ``work``, or an interrupt, stops all. ``report`` hears
    nothing from inside a unit.
    """
    remote = ray.remote(num_cpus=1, num_gpus=config.gpus_per_job, max_retries=0, max_calls=1)(_on_node)
    versions = _versions()
    waiting = deque((unit, 1) for unit in units)
    running: dict[Any, tuple[Unit, int]] = {}
    while waiting or running:
        while waiting and len(running) < min(jobs, MOST_AT_ONCE):
            unit, attempt = waiting.popleft()
            running[remote.remote(work, unit, versions)] = unit, attempt
        for reference in ray.wait(list(running), num_returns=1)[0]:
            unit, attempt = running.pop(reference)
            answer, reason = _answer(ray, reference)
            if reason is None:
                yield unwrap(answer)
            elif attempt <= config.retries:
                waiting.appendleft((unit, attempt + 1))
            else:
                yield lost(unit, f"{reason}, {attempt} times; see the cluster's logs, or raise --retries")


def _answer(ray: Any, reference: Any) -> tuple[Any, str | None]:
    """What a task answered, or a clause that says how the task was lost."""
    errors = ray.exceptions
    try:
        answer = ray.get(reference)
        return answer, f"the worker was ended by {answer[1]}" if answer[0] == ENDED else None
    except errors.RayTaskError as error:  # the task itself raises nothing, so it could not even begin
        last = str(error).strip().splitlines()[-1]
        raise ConfigError(
            f"a machine of the Ray cluster cannot run su3d-bench ({last[:200]}); install the same version on each"
        ) from error
    except errors.OutOfMemoryError:
        return None, "the worker was killed for want of memory"
    except (errors.WorkerCrashedError, errors.LocalRayletDiedError, errors.NodeDiedError):
        return None, "the worker or its machine was lost"
    except (errors.ObjectLostError, errors.OutOfDiskError, errors.RaySystemError) as error:
        return None, f"the outcome was lost ({type(error).__name__})"


def _on_node(work: Work[Unit, Outcome], unit: Unit, versions: dict[str, str]) -> tuple[str, Any]:
    """What becomes of ``unit`` in a worker of the cluster; a worker of another version must not mix its numbers in."""
    limit_threads()  # before numerical libraries are loaded
    own = _versions()
    for name in versions:
        if own.get(name) != versions[name]:
            message = f"{socket.gethostname()}: has {name} {own.get(name)}, the run {versions[name]}; install the same"
            return "user-error", StoreError(message)
    try:
        with ending_in_order():  # where Ray's own handler would leave the work as if it had failed
            return answer_of(work, unit, lambda event: None)
    except Ended as end:
        return ENDED, str(end)


def _versions() -> dict[str, str]:
    return {"su3d-bench's code": code_digest(), **package_versions(NUMERIC_PACKAGES)}


@contextmanager
def connected(config: RunConfig) -> Iterator[Any]:
    """The module ``ray``, connected to the cluster that ``config`` names, which has a machine for each job.

    The address ``local`` starts a cluster of this machine alone, for the time of the block.
    """
    try:
        import ray
    except ImportError as error:
        raise ModelMissing("the executor 'ray' needs the ray extra: pip install 'su3d-bench[ray]'") from error
    was_connected = ray.is_initialized()
    if not was_connected:
        _refuse_silent(config.ray_address)
        _connect(ray, config.ray_address)
    try:
        _refuse_too_many_gpus(ray, config.gpus_per_job)
        yield ray
    finally:
        if not was_connected:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    try:
        with kept_handlers():  # Ray's own would end the process as if a check had failed
            ray.init(address=address or "auto", log_to_driver=False, logging_level="error")
    except (ConnectionError, RuntimeError, ValueError, OSError, TimeoutError) as error:
        if not address and isinstance(error, ConnectionError):
            named = os.environ.get("RAY_ADDRESS")
            where = f"at RAY_ADDRESS={named}" if named else "on this machine"
            raise ConfigError(
                f"no Ray cluster runs {where}; add --ray-address local to start one here for this run, or name another "
                "with --ray-address HOST:PORT"
            ) from error
        line = " ".join(str(error).split())[:300]
        raise ConfigError(
            f"no Ray cluster at '{address}' takes this run: {line}; start one with ray start --head, or name another "
            "with --ray-address"
        ) from error


def _refuse_silent(address: str) -> None:
    """Ray waits a minute for a machine that is not there."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdigit():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        reason = (getattr(error, "strerror", None) or str(error) or "no answer").lower()
        raise ConfigError(
            f"no Ray cluster answers at '{address}' ({reason}); start one with ray start --head, or name another with "
            "--ray-address"
        ) from error


def _refuse_too_many_gpus(ray: Any, gpus_per_job: float) -> None:
    """Ray waits for ever for a machine that has what a task asks for."""
    most = max((node["Resources"].get("GPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
    if gpus_per_job > most:
        raise ConfigError(
            f"--gpus-per-job {gpus_per_job:g}: no machine of the Ray cluster has more than {most:g}; lower it"
        )
