"""Where units of work run: as jobs of a Slurm cluster, submitted through submitit.

submitit hands units and outcomes over as pickles in a folder of the run, which all machines must see; nobody else may
write there.
"""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from su3d_bench.core.config import RunConfig
from su3d_bench.core.errors import ConfigError, ModelMissing
from su3d_bench.runs.executors.local import Outcome, Report, Unit, Work, answer_of, limit_threads, unwrap

CLUSTERS = ("slurm", "local")  # submitit takes this machine for a cluster in silence where there is no Slurm
DEFAULTS = {"timeout_min": 240}  # submitit's own limit is 5 minutes, less than a long scene takes
MOST_AT_ONCE = 1000  # Slurm's MaxArraySize is 1001 where nobody set it
POLL_S = 0.5


def run_slurm(
    work: Work[Unit, Outcome],
    units: Sequence[Unit],
    report: Report,
    *,
    jobs: int,
    config: RunConfig,
    folder: Path,
    parameters: Mapping[str, Any],
    lost: Callable[[Unit, str], Outcome],
) -> Iterator[Outcome]:
    """Outcomes of ``units`` as they come in, at most ``jobs`` of them submitted at once, as job arrays.

    ``parameters`` are those of submitit's ``AutoExecutor``, and ``cluster``; ``folder`` is on a shared disk. A unit
    whose job died ``config.retries`` + 1 times has the outcome that ``lost`` makes. A ``Su3dError`` that leaves
    ``work``, or an interrupt, stops all. ``report`` hears nothing from inside a unit.
    """
    n_at_once = min(jobs, MOST_AT_ONCE)
    executor, failures = slurm_executor(folder, parameters, int(config.gpus_per_job), n_at_once)
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
        jobs = [executor.submit(_in_job, work, unit) for unit, _ in fresh]
    return [(job, unit, attempt) for job, (unit, attempt) in zip(jobs, fresh, strict=True)]


def _in_job(work: Work[Unit, Outcome], unit: Unit) -> tuple[str, Any]:
    limit_threads()
    return answer_of(work, unit, lambda event: None)


def slurm_executor(
    folder: Path, given: Mapping[str, Any], n_gpus: int, n_at_once: int
) -> tuple[Any, tuple[type[Exception], ...]]:
    """submitit's executor, which may make ``folder``, and the errors by which it says that a job died."""
    try:
        import submitit
    except ImportError as error:
        raise ModelMissing("the executor 'slurm' needs the slurm extra: pip install 'su3d-bench[slurm]'") from error
    parameters = {**DEFAULTS, "slurm_array_parallelism": n_at_once, **given}
    cluster = parameters.pop("cluster", CLUSTERS[0])
    if cluster not in CLUSTERS:
        raise ConfigError(f"--slurm cluster={cluster}: expected {' or '.join(CLUSTERS)}")
    if cluster == CLUSTERS[0] and shutil.which("srun") is None:
        raise ConfigError(
            "no Slurm cluster is here: there is no srun; give the command where there is, or add --slurm cluster=local "
            "to try it on this machine"
        )
    if n_gpus:
        parameters["gpus_per_node"] = n_gpus
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
        executor.update_parameters(**parameters)
    except (NameError, AssertionError, TypeError, ValueError, RuntimeError) as error:
        line = " ".join(str(error).split())[:300]
        raise ConfigError(f"--slurm: submitit refuses it: {line}") from error
    return executor, (submitit.core.utils.UncompletedJobError,)


def _last_line(error: Exception) -> str:
    """The last line of the job's own traceback where it left one, else the first of what submitit says."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    rules = [k for k, line in enumerate(lines) if set(line) == {"-"}]
    return (lines[rules[-1] - 1] if len(rules) > 1 else lines[0])[:200] if lines else type(error).__name__
