"""Time to list, resume, aggregate and report 10,000 jobs in one run folder.

    python benchmarks many_jobs --json build/measured/many_jobs.json

The folder is simulated: one real job (opensu3d on 20 frames of rooms/bathroom0) is copied 10,000 times, as 1,250
scenes under 8 methods, each with the timings, log and completion records of the real one and its own counts, but no
map. Timed are commands as a user types them, each in a separate process; aggregation is what a run does after
its last job, timed here for each of the two protocols separately. Takes about two minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.cli.main import main as su3d_bench
from su3d_bench.core.config import Setting, Settings
from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.core.types import ImageDomain, SceneInfo
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.scoring import pack_scores, unpack_scores
from su3d_bench.metrics.semantic.confusion import SemanticCounts
from su3d_bench.runs.plan import Plan, make_plan
from su3d_bench.runs.resume import FinishedScenes
from su3d_bench.runs.summary import summarise
from su3d_bench.store.run_folder import RunFolder

N_FRAMES = 20
METHODS = (
    "opensu3d",
    "conceptfusion",
    "conceptfusion-sam",
    "conceptgraphs",
    "conceptgraphs-detector",
    "openmask3d",
    "sam3d",
    "oracle",
)
SOURCE = "rooms/bathroom0"
PROTOCOLS = ("rooms-semantic", "rooms-instance")


class Many:
    """Any number of scenes, with only names and numbers of frames."""

    name = "many"
    label_space = "replica"
    variants: ClassVar[tuple[str, ...]] = ("mesh-vertices",)
    image_domain: ClassVar[ImageDomain] = "rendered-rooms"

    class Options(BaseModel):
        """Number of scenes."""

        model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

        n_scenes: int = 1250

    def __init__(self, root: Path, options: Options) -> None:
        self.options = options

    def scenes(self) -> Sequence[str]:
        return [f"s{index:05d}" for index in range(self.options.n_scenes)]

    def frames(self, scene: str, stride: int) -> Sequence[Any]:
        return [None] * len(range(0, N_FRAMES, stride))

    def digest(self, scene: str) -> str:
        return digest_bytes(scene.encode())

    def info(self, scene: str, stride: int) -> SceneInfo:
        return SceneInfo(self.name, scene, len(self.frames(scene, stride)), stride, self.image_domain)


def words(n_scenes: int, out: Path) -> list[str]:
    wanted = ["--scenes", f"{Path(__file__)}:Many/*", "--methods", *METHODS, "--protocols", *PROTOCOLS]
    return ["run", *wanted, "--no-pictures", "--set", f"many.n_scenes={n_scenes}", "--out", str(out)]


def plan_of(n_scenes: int, out: Path) -> Plan:
    """The plan created by the command ``words``."""
    values = {
        ("scenes",): [f"{Path(__file__)}:Many/*"],
        ("methods",): list(METHODS),
        ("protocols",): list(PROTOCOLS),
        ("pictures",): False,
    }
    settings = Settings(tuple(Setting(key, value, "many_jobs") for key, value in values.items()))
    return make_plan(settings, [f"many.n_scenes={n_scenes}"], out)


def simulate(plan: Plan, source: RunFolder) -> None:
    """Write every job of ``plan`` like that of ``source``, with its own numbers."""
    real = source.job(SOURCE, "opensu3d")
    scores = unpack_scores(real.counts.read_bytes())
    contents = {path.name: path.read_bytes() for path in (real.updates, real.log)}
    steps = json.loads(real.done.read_text())["steps"]
    for step in steps.values():
        step["files"].pop(real.prediction.name, None)
    scenes = FinishedScenes()
    generator = np.random.default_rng(0)
    for job in plan.jobs:
        for part in job.methods:
            folder = plan.folder.job(job.scene, part.name)
            make_folder(folder.path)
            contents[real.counts.name] = pack_scores({name: varied(one, generator) for name, one in scores.items()})
            for name, content in contents.items():
                (folder.path / name).write_bytes(content)
            inputs = scenes.inputs(job, part)
            assert inputs is not None
            steps["predict"]["key"] = inputs.predict_key()
            steps["score"]["key"] = inputs.score_key(steps["predict"]["key"], folder)
            for step in steps.values():
                step["files"] = {name: digest_bytes(contents[name]) for name in step["files"]}
            folder.done.write_text(json.dumps({"schema": 1, "steps": steps}, indent=2))


def varied(score: SceneScore, generator: np.random.Generator) -> SceneScore:
    """``score`` with other confidences, or with confusions drawn again."""
    counts = score.counts
    if isinstance(counts, InstanceCounts):
        return replace(score, counts=replace(counts, score=generator.random(len(counts.score))))
    assert isinstance(counts, SemanticCounts)
    return replace(score, counts=replace(counts, confusion=generator.poisson(counts.confusion)))


def seconds_of(command: Sequence[str]) -> float:
    """Duration of ``su3d-bench`` in a separate process."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "su3d_bench", *command], stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0, command
    return time.perf_counter() - start


def measure(n_scenes: int, folder: Path) -> Iterator[tuple[str, float]]:
    """Duration of each command, as measured."""
    out = folder / "run"
    limited = ["--limit", str(N_FRAMES), "--no-pictures", "--jobs", "1", "--quiet", "--stride", "1"]
    asked = ["run", "--scenes", SOURCE, "--methods", "opensu3d", "--protocols", *PROTOCOLS, *limited]
    assert su3d_bench([*asked, "--out", str(folder / "real")]) == 0
    plan = plan_of(n_scenes, out)
    simulate(plan, RunFolder(folder / "real"))
    yield "list: run --dry-run", seconds_of([*words(n_scenes, out), "--dry-run"])
    yield "resume the finished run: run, both protocols", seconds_of(words(n_scenes, out))
    for protocol in PROTOCOLS:
        yield f"of which aggregate: {protocol}", aggregation_s(plan, protocol)
    yield "report tables", seconds_of(["report", "tables", str(out)])
    yield "report timing", seconds_of(["report", "timing", str(out)])
    yield "report html", seconds_of(["report", "html", str(out), "--out", str(folder / "page.html")])
    yield "compare two methods", seconds_of(["compare", f"{out}:opensu3d", f"{out}:sam3d"])


def aggregation_s(plan: Plan, protocol: str) -> float:
    """Time to aggregate one protocol, including reading the counts."""
    scenes = FinishedScenes()
    outcomes = [outcome for job in plan.jobs for outcome in scenes.outcomes(job) or ()]
    alone = replace(plan, jobs=tuple(replace(job, protocols=(protocol,)) for job in plan.jobs))
    start = time.perf_counter()
    summarise(alone, outcomes)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=1250, help="number of scenes (8 methods each)")
    parser.add_argument("--json", type=Path, help="write the table to FILE")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="su3d-many-") as folder:
        rows = []
        for name, seconds in measure(arguments.scenes, Path(folder)):
            print(f"{name:<42} {seconds:6.1f} s", flush=True)
            rows.append((name, seconds))
    if arguments.json is not None:
        from measured import write_measured  # next to this file, which the commands also read as a plug-in

        n_jobs = arguments.scenes * len(METHODS)
        write_measured(
            arguments.json,
            f"{n_jobs:,} jobs in one run folder",
            "python benchmarks many_jobs --json build/measured/many_jobs.json",
            ["what", "seconds"],
            [[name, f"{seconds:.1f}"] for name, seconds in rows],
            ["The jobs have the size of one real job, without its map; each command is a separate process."],
        )


if __name__ == "__main__":
    main()
