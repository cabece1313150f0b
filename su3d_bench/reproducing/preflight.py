"""What a reproduction needs: what of it is here, what is missing and how to get it, and what all will cost."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import Settings, read_assignments, resolve
from su3d_bench.core.errors import GroundTruthMissing, ModelMissing, Su3dError
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.interfaces import HasGroups, NeedsSurface
from su3d_bench.core.system.devices import require_installed
from su3d_bench.fetching.sources import built_in
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.perception.models.catalogue import PAPERS_ENCODERS, PROFILE_MODELS, FormName, model_entry
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.loading import DETECTOR, PACKAGES, TAGGER
from su3d_bench.perception.profiles import PerceptionConfig
from su3d_bench.reproducing.asked import AskedRun
from su3d_bench.reproducing.costs import FILE, NAME, Estimate, UnitCosts, Work, calibrated_ms, estimated, read_costs
from su3d_bench.runs.frame_loop import surface_of
from su3d_bench.runs.job import build_dataset, build_method, part_of
from su3d_bench.runs.plan import method_part, named_method
from su3d_bench.runs.scenes import data_root, split_address

PAPER = "paper"
FETCHED_FOR_PAPER = (*PROFILE_MODELS[PAPER], *PAPERS_ENCODERS)
CAN_DO_WITHOUT = (TAGGER,)  # without RAM++ a list of words names what is looked for
MB = 1_000_000
FRAMES = 1000  # of a scene of which neither the dataset nor the table of what can be fetched says how many


@dataclass(frozen=True)
class Need:
    """One thing that runs need: ``kind`` is package, model, scene, mesh, truth, disk, memory or GPU memory.

    ``n_bytes``: what is to be fetched or has to be free, None where nobody says. ``is_required`` false: the run does
    without it, and ``remark`` says how.
    """

    kind: str
    name: str
    is_here: bool
    n_bytes: float | None = None
    how: str = ""
    is_required: bool = True
    remark: str = ""


@dataclass(frozen=True)
class Preflight:
    """Everything that is needed, and an estimate a run."""

    needs: tuple[Need, ...]
    estimates: tuple[Estimate, ...]

    @property
    def missing(self) -> tuple[Need, ...]:
        return tuple(need for need in self.needs if not need.is_here and need.is_required)

    @property
    def hours(self) -> float | None:
        """Of all runs one after the other; None where the price of one is not known."""
        seconds = [one.seconds for one in self.estimates]
        return None if None in seconds else sum(second for second in seconds if second is not None) / 3600.0

    def to_json(self) -> dict[str, Any]:
        return {
            "needs": [asdict(need) for need in self.needs],
            "estimates": [asdict(one) for one in self.estimates],
            "hours": self.hours,
        }


def preflight(runs: Sequence[AskedRun], out: Path) -> Preflight:
    """What ``runs`` into ``out`` need and will cost; no frame is read, nothing is written and nobody is asked."""
    needs: dict[tuple[str, str], Need] = {}
    for run in runs:
        for need in (*_models(run), *_data(run)):
            needs.setdefault((need.kind, need.name), need)
    costs = known_costs(out)
    scale = 1.0 if not costs else calibrated_ms()
    estimates = tuple(_estimate(run, costs, scale) for run in runs)
    return Preflight((*needs.values(), *_machine(runs, out, estimates)), estimates)


def known_costs(out: Path) -> tuple[UnitCosts, ...]:
    """Tables of prices, the nearest first: what a probe measured here, then what the program brings."""
    own = out / NAME
    return (*((read_costs(own),) if is_file(own) else ()), read_costs(FILE))


def _estimate(run: AskedRun, tables: Sequence[UnitCosts], calibration_ms: float) -> Estimate:
    work = work_of(run)
    last = Estimate(run.name, None, None, None, None, run.methods, "nowhere")
    for costs in tables:
        last = estimated(work, costs, calibration_ms / costs.calibration_ms)
        if last.seconds is not None:
            return last
    return last


def work_of(run: AskedRun) -> Work:
    """How many updates each scene and method of a run will have."""
    limit = int(dict(run.values).get("limit") or 0)
    n_updates: dict[tuple[str, str], int] = {}
    scenes = list(scene_names(run.dataset, run.scenes))
    for method in run.methods:
        stride = _stride(run, method)
        for scene in scenes:
            n = -(-_n_frames(run.dataset, scene) // stride)
            n_updates[scene, method] = min(n, limit) if limit else n
    jobs = int(dict(run.values).get("jobs") or 0) or os.cpu_count() or 1
    return Work(run.name, run.profile, run.device or "cpu", n_updates, max(1, min(jobs, len(scenes))))


def _stride(run: AskedRun, method: str) -> int:
    if run.stride:
        return run.stride
    named = named_method(method)
    own = {entry.path[2:]: entry.value for entry in named.settings}
    default = getattr(registry.load("method", named.target).Config(), "stride", 1)
    return max(1, int(own.get(("stride",), default)))


@dataclass(frozen=True)
class SceneSize:
    """A scene of a dataset before it is here, on average: frames, bytes to be fetched, and the command that does it."""

    n_frames: int = FRAMES
    n_bytes: float | None = None
    how: str = "see docs/datasets.md"


def scene_size(dataset: str) -> SceneSize:
    """What the table of what can be fetched says of the scenes of ``dataset``."""
    for source in built_in().entries.values():
        if source.group == dataset and source.scenes is not None:
            counts, n_bytes = source.scenes, source.n_bytes
            mean = None if n_bytes is None else n_bytes / counts.n_scenes
            return SceneSize(
                round(counts.n_frames / counts.n_scenes), mean, f"su3d-bench datasets fetch {source.group}"
            )
    return SceneSize()


def _dataset(name: str) -> Any:
    return build_dataset(part_of("dataset", name, Settings()), data_root())


def _known_scenes(dataset: Any) -> tuple[str, ...]:
    try:
        return tuple(dataset.scenes())
    except Su3dError:
        return ()


def scene_names(dataset_name: str, addresses: Sequence[str]) -> Iterator[str]:
    """The scenes that ``addresses`` of a dataset name; a group's members, and what of a pattern is here."""
    import fnmatch

    dataset = _dataset(dataset_name)
    groups = dataset.groups() if isinstance(dataset, HasGroups) else {}
    for address in addresses:
        _, name = split_address(address)
        if any(character in name for character in "*?["):
            yield from (scene for scene in _known_scenes(dataset) if fnmatch.fnmatchcase(scene, name))
        else:
            yield from groups.get(name, (name,))


def _n_frames(dataset: str, scene: str) -> int:
    """As many as there are, or where the scene is not here, as its publisher says."""
    with suppress(Su3dError):
        return int(_dataset(dataset).info(scene, 1).n_frames)
    return scene_size(dataset).n_frames


def _data(run: AskedRun) -> Iterator[Need]:
    """A need a scene, and one a truth that its protocols ask for."""
    dataset = _dataset(run.dataset)
    known = _known_scenes(dataset)
    size = scene_size(run.dataset)
    for scene in scene_names(run.dataset, run.scenes):
        address = f"{run.dataset}/{scene}"
        fault = "" if scene in known else f"not below {data_root()}"
        if not fault:
            try:
                dataset.info(scene, 1)
            except Su3dError as error:
                fault = str(error)
        yield Need(
            "scene", address, not fault, 0.0 if not fault else size.n_bytes, size.how if fault else "", remark=fault
        )
        if not fault:
            yield from _surface(run, dataset, scene, size.how)
            yield from _truths(run, dataset, scene, size.how)


def _surface(run: AskedRun, dataset: Any, scene: str, how: str) -> Iterator[Need]:
    """The scan's mesh, where it is missing and a method cannot do without."""
    named = [named_method(text) for text in run.methods]
    settings = read_assignments(run.settings, tuple({*run.methods, *(one.base for one in named)}), (run.dataset,))
    methods = {one.name: build_method(method_part(one, settings)) for one in named}
    asking = [name for name, method in methods.items() if isinstance(method, NeedsSurface) and method.needs_surface]
    if not asking:
        return
    try:
        surface_of(dataset, scene)
    except Su3dError as error:
        remark = f"{error}; {', '.join(asking)} cannot do without"
        yield Need("mesh", f"{run.dataset}/{scene}: the scan's mesh", is_here=False, how=how, remark=remark)


def _truths(run: AskedRun, dataset: Any, scene: str, how: str) -> Iterator[Need]:
    """The truths that are missing; one that another protocol of the run can do without is not required."""
    variants: dict[str, list[str]] = {}
    for name in run.protocols:
        variants.setdefault(load_protocol(name).ground_truth, []).append(name)
    missing: dict[str, str] = {}
    for variant in variants:
        try:
            dataset.ground_truth(scene, variant)
        except GroundTruthMissing as error:
            missing[variant] = str(error)
        except Su3dError as error:
            missing[variant] = str(error)
    for variant, why in missing.items():
        left = [other for other in variants if other not in missing]
        remark = f"{why}; without it {', '.join(variants[variant])} scores nothing"
        name = f"{run.dataset}/{scene}: {variant}"
        brings = how if "su3d-bench datasets fetch" in why else ""  # labels of others are not among what is fetched
        yield Need("truth", name, is_here=False, how=brings, is_required=not left, remark=remark)


def _models(run: AskedRun) -> Iterator[Need]:
    """Packages and weights of the profile ``paper``; an encoder beside any other."""
    methods = {named_method(method).base for method in run.methods}
    settings = read_assignments(run.settings, tuple({*methods, *run.methods}), (run.dataset,))
    config = resolve(settings, ("perception",), PerceptionConfig)
    names = [run.encoder] if run.encoder != "embedded" else []
    if run.profile == PAPER:
        names += [config.paper.segmenter, DETECTOR, *([] if config.paper.tagger == "words" else [TAGGER])]
    for package in PACKAGES if names else ():
        try:
            require_installed(package, "profile 'paper'")
        except Su3dError as error:
            yield Need("package", package, is_here=False, how="pip install 'su3d-bench[models]'", remark=str(error))
        else:
            yield Need("package", package, is_here=True)
    for name in dict.fromkeys(names):
        yield _model(name, config, is_required=name not in CAN_DO_WITHOUT or config.paper.tagger != "auto")


def _model(name: str, config: PerceptionConfig, *, is_required: bool) -> Need:
    forms: tuple[FormName, ...] | None = None
    if name == TAGGER:  # its own checkpoint runs by its own package alone
        forms = ("onnx", "original") if find_spec("ram") is not None else ("onnx",)
    place = config.models.paths.get(name), config.models.folder
    remark = "" if is_required else "without it the words of a list are looked for"
    try:
        files = locate(name, forms, path=place[0], folder=place[1])
    except ModelMissing:
        n_bytes = built_in().named(name, "models").n_bytes
        how = f"su3d-bench models fetch {'--for paper' if name in FETCHED_FOR_PAPER else name}"
        return Need("model", name, is_here=False, n_bytes=n_bytes, how=how, is_required=is_required, remark=remark)
    return Need("model", name, is_here=True, n_bytes=0.0, remark=str(files.folder))


def _machine(runs: Sequence[AskedRun], out: Path, estimates: Sequence[Estimate]) -> Iterator[Need]:
    """Room on the disk, in memory and on the GPU, where it is known how much is needed; what is estimated is not
    required, a GPU where one is asked for is."""
    import psutil

    disk = [one.disk_bytes for one in estimates if one.disk_bytes is not None]
    if disk:
        yield _room("disk", str(out), sum(disk), shutil.disk_usage(_existing(out)).free)
    memory = [one.memory_bytes for one in estimates if one.memory_bytes is not None]
    if memory:
        yield _room("memory", "of the machine", max(memory), psutil.virtual_memory().available)
    on_gpu = [run for run in runs if (run.device or "cpu").startswith("cuda")]
    if on_gpu:
        weights = max(sum(_weights(run)) for run in on_gpu)
        yield _room("GPU memory", "weights alone, images come on top", weights, _gpu_bytes())


def _room(kind: str, name: str, needed: float, free: float | None) -> Need:
    remark = "no GPU is seen by torch here" if free is None else f"{free / 1e9:.1f} GB are free"
    is_enough = free is not None and needed <= free
    return Need(kind, name, is_here=is_enough, n_bytes=needed, is_required=free is None, remark=remark)


def _existing(path: Path) -> Path:
    return next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())


def _weights(run: AskedRun) -> Iterator[float]:
    """Bytes of the weights of a run's models on a GPU, in float16."""
    for need in _models(run):
        if need.kind == "model":
            yield model_entry(need.name).memory_mb(2) * float(MB)


def _gpu_bytes() -> float | None:
    try:
        import torch
    except ImportError:
        return None
    return float(torch.cuda.mem_get_info()[0]) if torch.cuda.is_available() else None
