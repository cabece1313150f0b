"""Estimated time, memory, disk, requests and dollars of runs, from the unit costs of ``perception/unit_costs.toml``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from su3d_bench.core.errors import Su3dError, counted
from su3d_bench.core.system.devices import CPU
from su3d_bench.formats.tables.table import Table, text_table
from su3d_bench.perception.language.client import cost_usd
from su3d_bench.perception.profiles import MAX_PROCESSES_PER_GPU, default_jobs, models_of, resolve_profile
from su3d_bench.perception.unit_costs import UNIT_COSTS, UnitCost, gpu_memory_gb, weights_gb
from su3d_bench.reproducing.preflight import Preflight, asks, parts_of, perception_of
from su3d_bench.reproducing.recipe import RecipeRun, dataset_named, scene_names
from su3d_bench.runs.job import build_method

# Stages of the profile ``paper`` for each image, by kind of masks; "none": methods that prompt SAM themselves.
STAGES: Mapping[str, tuple[str, ...]] = {
    "grounded": ("tagger", "detector", "sam", "masks"),
    "class-agnostic": ("sam", "automatic"),
    "none": ("sam",),
}


@dataclass
class Estimate:
    """``seconds`` of all runs, with ``jobs`` in parallel; the memory of all processes.

    ``models``: the price of each language model, ``usd`` None if one has none; ``used``: the unit costs behind these
    numbers; ``unknown``: what is not counted.
    """

    seconds: float = 0.0
    jobs: int = 1
    memory_gb: float = 0.0
    gpu_memory_gb: float = 0.0
    disk_gb: float = 0.0
    n_requests: int = 0
    input_tokens: float = 0.0
    output_tokens: float = 0.0
    usd: float | None = 0.0
    models: dict[str, str] = field(default_factory=dict)
    used: dict[str, UnitCost] = field(default_factory=dict)
    unknown: list[str] = field(default_factory=list)

    def cost(self, key: str, other: str = "") -> float:
        """A unit cost, which is listed with the estimate from then on; 0 if there is none."""
        key = key if key in UNIT_COSTS else other
        if key:
            self.used[key] = UNIT_COSTS[key]
        return self.used[key].value if key else 0.0


def estimate(runs: Sequence[RecipeRun], known: Preflight) -> Estimate:
    """The estimate of ``runs``, one after the other; no frame is read and no server is contacted."""
    total = Estimate(disk_gb=sum(need.n_bytes or 0.0 for need in known.needs) / 1e9)
    for run in runs:
        _add(total, run)
    return total


def _add(total: Estimate, run: RecipeRun) -> None:
    config = perception_of(run)
    profile = resolve_profile(run.profile, "camera", config)
    device = "cpu" if config.models.device == CPU else "cuda"
    frames = [_n_frames(total, run, scene) for scene in scene_names(run.dataset, run.scenes)]
    seconds, n_maps, images, ratios = 0.0, 0, dict[tuple[str, str], float](), set[float]()
    for part in parts_of(run):
        needs, base = build_method(part).needs, part.name.partition("@")[0]
        stride = run.stride or json.loads(part.options).get("stride", 1)
        n = sum(min(math.ceil(each / stride), run.values.get("limit") or math.inf) for each in frames) * needs.frames
        seconds += n * total.cost(f"map {base}", "map")
        seconds += len(frames) * (total.cost(f"finish {base}") + total.cost("scene"))
        total.disk_gb += len(frames) * total.cost("dense" if base.startswith("conceptfusion") else "results")
        kind = needs.masks, needs.grounding if needs.masks == "grounded" else needs.automatic
        images[kind] = max(images.get(kind, 0.0), n)  # cached for the other methods
        ratios |= {*needs.crop_ratios}
        n_maps += len(frames)
    n_captions = 0.0
    for (masks, _), n in images.items():
        total.disk_gb += n * total.cost("cache")
        n_regions = n * total.cost("boxes" if masks == "grounded" else "regions")
        if profile == "paper":
            n_captions += n_regions if masks == "grounded" else 0.0
            seconds += n * sum(total.cost(f"{stage} {device}") for stage in STAGES[masks])
            seconds += (n + n_regions * len(ratios)) * total.cost(f"crop {device}")
        else:
            seconds += n * total.cost("embedded image")
    n_requests = {"captions": n_captions, "refiner": n_maps * UNIT_COSTS["instances"].value}
    n_requests["question_solver"] = n_maps * UNIT_COSTS["questions"].value
    for what in asks(run):
        total.cost({"refiner": "instances", "question_solver": "questions"}.get(what, "boxes"))
        model = config.language.vision_model if what == "captions" else config.language.text_model
        n_in, n_out = (n_requests[what] * total.cost(f"{what} tokens {way}") for way in ("in", "out"))
        usd, price = cost_usd(config.language, model, round(n_in), round(n_out)), config.language.prices.get(model)
        total.usd = None if usd is None or total.usd is None else total.usd + usd
        total.models[model] = f"{price.input_usd:g} in, {price.output_usd:g} out, {price.date}" if price else "no price"
        total.n_requests += round(n_requests[what])
        total.input_tokens += n_in
        total.output_tokens += n_out
    models, jobs = models_of(profile, config), MAX_PROCESSES_PER_GPU
    with suppress(Su3dError):  # the GPU is on another machine
        jobs = default_jobs(profile, config)
    jobs = max(1, min(run.values.get("jobs") or jobs, len(frames)))
    on_gpu = models if device == "cuda" else []
    memory_gb = total.cost("memory") + (0.0 if on_gpu else weights_gb(models, 4))
    total.jobs = max(total.jobs, jobs)
    total.memory_gb = max(total.memory_gb, jobs * memory_gb)
    total.gpu_memory_gb = max(total.gpu_memory_gb, jobs * gpu_memory_gb(on_gpu) if on_gpu else 0.0)
    total.seconds += seconds / jobs


def _n_frames(total: Estimate, run: RecipeRun, scene: str) -> float:
    with suppress(Su3dError):
        return len(dataset_named(run.dataset).frames(scene, 1))
    if f"frames {run.dataset}" not in UNIT_COSTS:
        total.unknown.append(f"images of {run.dataset}/{scene}, whose number is not known")
    return total.cost(f"frames {run.dataset}")


def estimate_tables(found: Estimate) -> list[Table]:
    """The estimate, and the unit costs that it is computed from."""
    models = "; ".join(f"{model}: USD per million tokens: {price}" for model, price in found.models.items())
    rows = [
        ["what", "estimate", "of"],
        ["time", f"{found.seconds / 3600:.1f} h", f"all runs, {counted(found.jobs, 'job')} in parallel"],
        ["memory", f"{found.memory_gb:.0f} GB", "all processes"],
        ["GPU memory", f"{found.gpu_memory_gb:.0f} GB", "all processes"],
        ["disk", f"{found.disk_gb:.0f} GB", "downloads, perception cache, results"],
        ["requests", f"{found.n_requests:,}", ", ".join(found.models) or "no language model"],
        ["tokens", f"{found.input_tokens:,.0f} in, {found.output_tokens:,.0f} out", "all requests"],
        ["US dollars", "unknown" if found.usd is None else f"{found.usd:.2f}", models or "-"],
    ]
    costs = [["unit cost", "value", "unit", "basis", "source"]]
    costs += [[one.name, f"{one.value:g}", one.unit, one.basis, one.source] for one in found.used.values()]
    caption = ": from the unit costs below; reliable to an order of magnitude."
    notes = [f"not counted: {one}" for one in dict.fromkeys(found.unknown)]
    return [
        text_table("estimate", rows, heading="Estimate", caption=caption, notes=notes),
        text_table("unit-costs", costs, heading="Unit costs", caption=" of the estimate."),
    ]
