"""The executor of a run: this process, local processes, the machines of a Ray cluster, or Slurm jobs through submitit.

Under Ray each unit has a fresh worker process, as with local processes. Ray's own retries are switched off: only a unit
whose worker or machine was lost runs again, a bounded number of times; the answer of its work is final.

submitit exchanges units and outcomes as pickles in a folder of the run, which all machines must see and no other user
may write to.
"""

from __future__ import annotations

import os
import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from su3d_bench.core.config import RunConfig
from su3d_bench.core.digests import NUMERIC_PACKAGES, code_digest, package_versions
from su3d_bench.core.errors import ConfigError, ModelMissing, StoreError
from su3d_bench.core.files.atomic import TemporaryFolder
from su3d_bench.core.system.signals import Terminated, ending_in_order, restored_handlers
from su3d_bench.runs import executors
from su3d_bench.runs.executors import Outcome, Report, Unit, Work, answer_of, limit_threads, unwrap
from su3d_bench.store.run_folder import check_no_links

RunUnits = Callable[..., Iterator[Any]]
ENDED = "ended"  # the kind of answer of a worker that was asked to end
MAX_AT_ONCE = 1000  # a pending Ray task costs the driver memory; Slurm's default MaxArraySize is 1001


def run_ray(
    work: Work[Unit, Outcome], units: Sequence[Unit], lost: Any, *, jobs: int, config: RunConfig, ray: Any
) -> Iterator[Outcome]:
    """Outcomes of ``units`` as they complete, with at most ``jobs`` of them submitted to the cluster at once.

    ``ray`` is the result of ``connected``. A unit whose worker or machine was lost ``config.retries`` + 1 times gets
    the outcome created by ``lost``. A ``Su3dError`` raised by ``work``, or an interrupt, stops all units.
    """
    remote = ray.remote(num_cpus=1, num_gpus=config.gpus_per_job, max_retries=0, max_calls=1)(_on_node)
    versions = _versions()
    waiting = deque((unit, 1) for unit in units)
    running: dict[Any, tuple[Unit, int]] = {}
    while waiting or running:
        while waiting and len(running) < min(jobs, MAX_AT_ONCE):
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
    """The answer of a task, or a clause describing how the task was lost."""
    errors = ray.exceptions
    try:
        answer = ray.get(reference)
        return answer, f"the worker was ended by {answer[1]}" if answer[0] == ENDED else None
    except errors.RayTaskError as error:  # the task itself raises nothing, so it could not start
        last = str(error).strip().splitlines()[-1]
        raise ConfigError(
            f"a machine of the Ray cluster cannot run su3d-bench ({last[:200]}); install the same version on each"
        ) from error
    except errors.OutOfMemoryError:
        return None, "the worker was killed because memory ran out"
    except (errors.WorkerCrashedError, errors.LocalRayletDiedError, errors.NodeDiedError):
        return None, "the worker or its machine was lost"
    except (errors.ObjectLostError, errors.OutOfDiskError, errors.RaySystemError) as error:
        return None, f"the outcome was lost ({type(error).__name__})"


def _on_node(work: Work[Unit, Outcome], unit: Unit, versions: dict[str, str]) -> tuple[str, Any]:
    """The answer for ``unit`` in a cluster worker; an error if its versions differ, so that numbers never mix."""
    limit_threads()  # before numerical libraries are loaded
    own = _versions()
    for name in versions:
        if own.get(name) != versions[name]:
            message = f"{socket.gethostname()}: has {name} {own.get(name)}, the run {versions[name]}; install the same"
            return "user-error", StoreError(message)
    try:
        with ending_in_order():  # Ray's own handler would end the work as if it had failed
            return answer_of(work, unit, lambda event: None)
    except Terminated as end:
        return ENDED, str(end)


def _versions() -> dict[str, str]:
    return {"su3d-bench's code": code_digest(), **package_versions(NUMERIC_PACKAGES)}


@contextmanager
def connected(config: RunConfig) -> Iterator[Any]:
    """The module ``ray``, connected to the cluster named in ``config``, which has enough GPUs for a job.

    The address ``local`` starts a single-machine cluster for the duration of the block.
    """
    try:
        import ray
    except ImportError as error:
        raise ModelMissing("the executor 'ray' needs the ray extra: pip install 'su3d-bench[ray]'") from error
    was_connected = ray.is_initialized()
    if not was_connected:
        _connect(ray, config.ray_address)
    try:
        _check_gpu_count(ray, config.gpus_per_job)
        yield ray
    finally:
        if not was_connected:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    try:
        with restored_handlers():  # Ray's own handlers would end the process as if a check had failed
            ray.init(address=address or "auto", log_to_driver=False, logging_level="error")
    except (ConnectionError, RuntimeError, ValueError, OSError, TimeoutError) as error:
        named = address or os.environ.get("RAY_ADDRESS")
        where = f"at '{named}'" if named else "on this machine"
        raise ConfigError(
            f"no Ray cluster {where} accepts this run ({' '.join(str(error).split())[:300]}); start one with ray start "
            "--head, add --ray-address local to start one for this run, or name another with --ray-address"
        ) from error


def _check_gpu_count(ray: Any, gpus_per_job: float) -> None:
    """A ``ConfigError`` if no machine has the GPUs: Ray would wait forever for one."""
    most = max((node["Resources"].get("GPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
    if gpus_per_job > most:
        raise ConfigError(
            f"--gpus-per-job {gpus_per_job:g}: no machine of the Ray cluster has more than {most:g} GPUs; lower it"
        )


CLUSTERS = ("slurm", "local")  # submitit silently uses this machine as a cluster if there is no Slurm
DEFAULTS = {"timeout_min": 240}  # submitit's own limit is 5 minutes, less than a long scene needs
POLL_S = 0.5


def run_slurm(
    work: Work[Unit, Outcome], units: Sequence[Unit], lost: Any, *, jobs: int, config: RunConfig, folder: Path
) -> Iterator[Outcome]:
    """Outcomes of ``units`` as they complete, with at most ``jobs`` of them submitted at once, as job arrays.

    ``folder`` is on a shared disk. A unit whose job died ``config.retries`` + 1 times gets the outcome created by
    ``lost``. A ``Su3dError`` raised by ``work``, or an interrupt, stops all units.
    """
    check_no_links(folder.parent, folder)
    n_at_once = min(jobs, MAX_AT_ONCE)
    executor, failures = slurm_executor(folder, config, n_at_once)
    waiting = deque((unit, 1) for unit in units)
    running: list[tuple[Any, Unit, int]] = []
    is_clean = True
    try:
        while waiting or running:
            fresh = [waiting.popleft() for _ in range(min(len(waiting), n_at_once - len(running)))]
            running += _submit(executor, work, fresh) if fresh else []
            ended = [job for job in running if job[0].done()]
            running = [job for job in running if job not in ended]
            for job, unit, attempt in ended:
                try:
                    answer = job.result()
                except failures as error:
                    if attempt <= config.retries:
                        waiting.appendleft((unit, attempt + 1))
                        continue
                    is_clean = False
                    yield lost(unit, f"its job failed {attempt} times: {_last_line(error)}; see {folder}")
                    continue
                yield unwrap(answer)
            if not ended:
                time.sleep(POLL_S)
    finally:
        for job, _, _ in running:
            job.cancel(check=False)
    if is_clean:
        shutil.rmtree(folder, ignore_errors=True)


def _submit(executor: Any, work: Work[Unit, Outcome], fresh: Sequence[tuple[Unit, int]]) -> list[tuple[Any, Unit, int]]:
    with executor.batch():
        return [(executor.submit(_in_job, work, unit), unit, attempt) for unit, attempt in fresh]


def _in_job(work: Work[Unit, Outcome], unit: Unit) -> tuple[str, Any]:
    limit_threads()
    return answer_of(work, unit, lambda event: None)


def slurm_executor(folder: Path, config: RunConfig, n_at_once: int) -> tuple[Any, tuple[type[Exception], ...]]:
    """submitit's executor, which may create ``folder``, and the errors it raises when a job died."""
    try:
        import submitit
    except ImportError as error:
        raise ModelMissing("the executor 'slurm' needs the slurm extra: pip install 'su3d-bench[slurm]'") from error
    parameters = {**DEFAULTS, "slurm_array_parallelism": n_at_once, **executors.slurm_parameters(config)}
    cluster = parameters.pop("cluster", CLUSTERS[0])
    if cluster not in CLUSTERS:
        raise ConfigError(f"--slurm cluster={cluster}: expected {' or '.join(CLUSTERS)}")
    if cluster == CLUSTERS[0] and shutil.which("srun") is None:
        raise ConfigError(
            "no Slurm cluster here (srun not found); run the command on a machine of the cluster, or add --slurm "
            "cluster=local to try it on this machine"
        )
    if config.gpus_per_job:
        parameters["gpus_per_node"] = int(config.gpus_per_job)
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
        executor.update_parameters(**parameters)
    except (NameError, AssertionError, TypeError, ValueError, RuntimeError) as error:
        line = " ".join(str(error).split())[:300]
        raise ConfigError(f"--slurm: submitit rejects the options: {line}") from error
    return executor, (submitit.core.utils.UncompletedJobError,)


def _last_line(error: Exception) -> str:
    """The last line of the job's own traceback if it left one, otherwise the first line of submitit's message."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    rules = [k for k, line in enumerate(lines) if set(line) == {"-"}]
    return (lines[rules[-1] - 1] if len(rules) > 1 else lines[0])[:200] if lines else type(error).__name__


@contextmanager
def executor_for(config: RunConfig, n_workers: int, folder: Path, report: Report) -> Iterator[RunUnits]:
    """The executor of ``config`` as a function ``run(work, units, lost)`` that yields outcomes as they complete.

    ``folder`` is the run's. A ``Su3dError`` if no cluster answers, before the run has written anything.
    """
    executor = executors.executor_of(config, n_workers)
    if executor == "inline":
        yield lambda work, units, lost: executors.run_inline(work, units, report)
    elif executor == "processes":
        yield partial(executors.run_processes, report=report, jobs=n_workers)
    elif executor == "ray":
        with connected(config) as ray:
            yield partial(run_ray, jobs=n_workers, config=config, ray=ray)
    else:
        with TemporaryFolder("su3d-slurm-") as scratch:  # submitit creates the folder even for a mere check
            slurm_executor(scratch, config, n_workers)
        yield partial(run_slurm, jobs=n_workers, config=config, folder=folder.absolute() / "slurm")
