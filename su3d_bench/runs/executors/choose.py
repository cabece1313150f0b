"""Which executor carries out a run, and with which options."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from su3d_bench.core.config import RunConfig, parse_value
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.files.scratch import TemporaryFolder
from su3d_bench.runs.executors.local import Outcome, Report, Unit, Work, run_inline, run_processes
from su3d_bench.store.run_folder import refuse_links

# The options of executors on other machines; a value other than the default is refused elsewhere.
USED_BY = {
    "ray_address": ("ray",),
    "gpus_per_job": ("ray", "slurm"),
    "retries": ("ray", "slurm"),
    "slurm": ("slurm",),
}
ELSEWHERE = ("ray", "slurm")  # executors whose units run on machines that share no more than a disk or a store


def executor_of(config: RunConfig, n_workers: int) -> str:
    """The executor that ``auto`` stands for: this process for one job, else processes."""
    if config.executor != "auto":
        return config.executor
    return "inline" if n_workers == 1 else "processes"


def check_execution(config: RunConfig) -> None:
    """A ``ConfigError`` where an option means nothing to the executor that was asked for."""
    for name, executors in USED_BY.items():
        value = getattr(config, name)
        if value != RunConfig.model_fields[name].default and config.executor not in executors:
            shown = " ".join(value) if isinstance(value, tuple) else value
            wanted = " or ".join(f"--executor {executor}" for executor in executors)
            raise ConfigError(
                f"--{name.replace('_', '-')} {shown}: means nothing to the executor '{config.executor}'; add {wanted}"
            )
    if config.executor == "inline" and config.jobs > 1:
        raise ConfigError(f"--jobs {config.jobs}: the executor 'inline' runs one; choose --executor processes")
    is_whole = config.gpus_per_job == int(config.gpus_per_job)
    if not is_whole and (config.executor == "slurm" or config.gpus_per_job > 1):
        what = "Slurm gives whole GPUs" if config.executor == "slurm" else "a share is below 1, more come whole"
        raise ConfigError(f"--gpus-per-job {config.gpus_per_job:g}: {what}")
    slurm_parameters(config)


def slurm_parameters(config: RunConfig) -> dict[str, Any]:
    """What ``--slurm KEY=VALUE`` says, by key."""
    parameters = {}
    for text in config.slurm:
        key, equals, value = text.partition("=")
        if not equals or not key.strip().isidentifier():
            raise ConfigError(f"--slurm {text}: expected KEY=VALUE, such as slurm_partition=gpu timeout_min=60")
        parameters[key.strip()] = parse_value(value)
    return parameters


@contextmanager
def reached(config: RunConfig, n_workers: int) -> Iterator[Any]:
    """What the executor of ``config`` works through, for ``run_units`` in the block; a ``Su3dError`` where no cluster
    answers, before a run has left anything."""
    executor = executor_of(config, n_workers)
    if executor == "ray":
        from su3d_bench.runs.executors.ray import connected

        with connected(config) as ray:
            yield ray
    elif executor == "slurm":
        from su3d_bench.runs.executors.slurm import slurm_executor

        with TemporaryFolder("su3d-slurm-") as scratch:  # submitit makes the folder when it only looks
            slurm_executor(scratch, slurm_parameters(config), int(config.gpus_per_job), n_workers)
        yield None
    else:
        yield None


def run_units(
    work: Work[Unit, Outcome],
    units: Sequence[Unit],
    report: Report,
    *,
    config: RunConfig,
    n_workers: int,
    folder: Path,
    through: Any,
    lost: Callable[[Unit, str], Outcome],
) -> Iterator[Outcome]:
    """Outcomes of ``units`` as they come in, from the executor of ``config``; ``folder`` is the run's, and ``through``
    what ``reached`` gave."""
    executor = executor_of(config, n_workers)
    if executor == "inline":
        return run_inline(work, units, report)
    if executor == "processes":
        return run_processes(work, units, report, jobs=n_workers, lost=lost)
    if executor == "ray":
        from su3d_bench.runs.executors.ray import run_ray

        return run_ray(work, units, report, jobs=n_workers, config=config, ray=through, lost=lost)
    from su3d_bench.runs.executors.slurm import run_slurm

    at, parameters = folder.absolute() / "slurm", slurm_parameters(config)
    refuse_links(at.parent, at)
    return run_slurm(work, units, report, jobs=n_workers, config=config, folder=at, parameters=parameters, lost=lost)
