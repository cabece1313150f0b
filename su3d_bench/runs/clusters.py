"""The executor of a run: this process, local processes, or Slurm jobs through submitit.

Only a unit whose job died runs again, a bounded number of times; the answer of its work is final.

submitit exchanges units and outcomes as pickles in a folder of the run, which all machines must see and no other user
may write to.
"""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from su3d_bench.core.config import RunConfig
from su3d_bench.core.errors import ConfigError, ModelMissing
from su3d_bench.core.files.atomic import TemporaryFolder
from su3d_bench.runs import executors
from su3d_bench.runs.executors import Outcome, Report, Unit, Work, answer_of, limit_threads, unwrap
from su3d_bench.store.run_folder import check_no_links

RunUnits = Callable[..., Iterator[Any]]
MAX_AT_ONCE = 1000  # Slurm's default MaxArraySize is 1001
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
        parameters["gpus_per_node"] = config.gpus_per_job
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

    ``folder`` is the run's. A ``Su3dError`` if there is no cluster, before the run has written anything.
    """
    executor = executors.executor_of(config, n_workers)
    if executor == "inline":
        yield lambda work, units, lost: executors.run_inline(work, units, report)
    elif executor == "processes":
        yield partial(executors.run_processes, report=report, jobs=n_workers, memory=config.memory)
    else:
        with TemporaryFolder("su3d-slurm-") as scratch:  # submitit creates the folder even for a mere check
            slurm_executor(scratch, config, n_workers)
        yield partial(run_slurm, jobs=n_workers, config=config, folder=folder.absolute() / "slurm")
