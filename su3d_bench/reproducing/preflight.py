"""Preflight check of a reproduction: what is available, what is missing, its size and how to get it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.config import Setting, Settings, read_assignments, resolve
from su3d_bench.core.errors import DataError, ModelMissing, Su3dError, counted
from su3d_bench.core.interfaces import HasSurface
from su3d_bench.core.system.devices import require_installed
from su3d_bench.core.version import documentation
from su3d_bench.fetching.sources import built_in
from su3d_bench.formats.tables.table import Table, text_table
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.perception.language.client import check_key
from su3d_bench.perception.models.catalogue import PAPERS_ENCODERS, PROFILE_MODELS, FormName
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.loading import PACKAGES, TAGGER
from su3d_bench.perception.profiles import PerceptionConfig, models_of
from su3d_bench.reproducing.recipe import RecipeRun, dataset_named, known_scenes, scene_names
from su3d_bench.runs.executors import SLURM
from su3d_bench.runs.job import Part, build_method
from su3d_bench.runs.plan import asks_language_model, method_part, named_method
from su3d_bench.runs.scenes import data_root

PAPER = "paper"
FETCHED_FOR_PAPER = (*PROFILE_MODELS[PAPER], *PAPERS_ENCODERS)
OPTIONAL_MODELS = (TAGGER,)  # without RAM++, a word list provides the detector's prompts


@dataclass(frozen=True)
class Need:
    """One requirement of runs: ``kind`` is package, model, key, scene, data (of all scenes), mesh or truth.

    ``n_bytes``: download size, None if unknown.
    ``is_required`` false: the run works without it, and ``remark`` explains how.
    """

    kind: str
    name: str
    is_available: bool
    n_bytes: float | None = None
    how: str = ""
    is_required: bool = True
    remark: str = ""


@dataclass(frozen=True)
class Preflight:
    """All requirements."""

    needs: tuple[Need, ...]

    @property
    def missing(self) -> tuple[Need, ...]:
        return tuple(need for need in self.needs if not need.is_available and need.is_required)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def preflight(runs: Sequence[RecipeRun], out: Path) -> Preflight:
    """The requirements of ``runs``; no frames are read, nothing is written and no server is contacted."""
    needs: dict[tuple[str, str], Need] = {}
    for run in runs:
        for need in (*_models(run), *language_needs(run, out), *_data(run)):
            needs.setdefault((need.kind, need.name), need)
    return Preflight(tuple(needs.values()))


def _fetched(dataset: str) -> tuple[float | None, str]:
    """Mean download size in bytes of a scene of ``dataset``, None if unknown, and the command for it."""
    for source in built_in().entries.values():
        if source.group == dataset and source.scenes is not None:
            mean = None if source.n_bytes is None else source.n_bytes / source.scenes.n_scenes
            return mean, f"su3d-bench datasets fetch {source.group}"
    return None, f"see {documentation('datasets')}"


def _data(run: RecipeRun) -> Iterator[Need]:
    """One need per scene, and one per missing mesh or ground truth that its methods or protocols require."""
    dataset = dataset_named(run.dataset)
    known = known_scenes(dataset)
    n_bytes, how = _fetched(run.dataset)
    is_complete = True
    for scene in scene_names(run.dataset, run.scenes):
        address = f"{run.dataset}/{scene}"
        fault = "" if scene in known else f"not found in {data_root()}"
        if not fault:
            try:
                dataset.info(scene, 1)
            except Su3dError as error:
                fault = str(error)
        if fault:
            is_complete = False
            yield Need("scene", address, is_available=False, n_bytes=n_bytes, how=how, remark=fault)
            continue
        yield Need("scene", address, is_available=True, n_bytes=0.0)
        yield from _surface(run, dataset, scene, how)
        yield from _truths(run, dataset, scene, how)
    for source in () if is_complete else built_in().entries.values():
        if source.group == run.dataset and source.scenes is None:  # such as Replica's meshes, for all scenes at once
            yield Need("data", source.name, is_available=False, n_bytes=source.n_bytes, how=how)


def _settings(run: RecipeRun) -> Settings:
    bases = {named_method(text).base for text in run.methods}
    device = Setting(("perception", "models", "device"), run.device, "--device")
    return Settings((device,) if run.device else ()) + read_assignments(
        run.settings, tuple({*run.methods, *bases}), (run.dataset,)
    )


def parts_of(run: RecipeRun) -> list[Part]:
    """The methods of a run with their settings."""
    return [method_part(named_method(text), _settings(run)) for text in run.methods]


def _surface(run: RecipeRun, dataset: Any, scene: str, how: str) -> Iterator[Need]:
    """The scan's mesh, if it is missing and a method requires it."""
    asking = [part.name for part in parts_of(run) if getattr(build_method(part), "needs_surface", False)]
    if not asking:
        return
    try:
        if not isinstance(dataset, HasSurface):
            raise DataError(f"{run.dataset}/{scene}: the dataset has no mesh")
        dataset.surface(scene)
    except Su3dError as error:
        remark = f"{error}; required by {', '.join(asking)}"
        yield Need("mesh", f"{run.dataset}/{scene}: the scan's mesh", is_available=False, how=how, remark=remark)


def _truths(run: RecipeRun, dataset: Any, scene: str, how: str) -> Iterator[Need]:
    """The missing ground truths; one is not required if another protocol of the run works without it."""
    variants: dict[str, list[str]] = {}
    for name in run.protocols:
        variants.setdefault(load_protocol(name).ground_truth, []).append(name)
    missing: dict[str, str] = {}
    for variant in variants:
        try:
            dataset.ground_truth(scene, variant)
        except Su3dError as error:
            missing[variant] = str(error)
    for variant, why in missing.items():
        left = [other for other in variants if other not in missing]
        remark = f"{why}; without it there is no score under {', '.join(variants[variant])}"
        name = f"{run.dataset}/{scene}: {variant}"
        gives = how if "su3d-bench datasets fetch" in why else ""  # third-party labels cannot be fetched
        yield Need("truth", name, is_available=False, how=gives, is_required=not left, remark=remark)


def perception_of(run: RecipeRun) -> PerceptionConfig:
    """The perception settings of a run."""
    config: PerceptionConfig = resolve(_settings(run), ("perception",), PerceptionConfig)
    return config


def asks(run: RecipeRun) -> list[str]:
    """What a run asks language models for: captions, question_solver, refiner."""
    uses_captions = run.profile == PAPER and perception_of(run).paper.captions == "model"
    return [*(["captions"] if uses_captions else []), *asks_language_model(run.values)]


def language_needs(run: RecipeRun, out: Path) -> Iterator[Need]:
    """The missing key of the language model, if requests would be sent."""
    has_replies = run.values.get("offline") or (run.folder(out) / "language").is_dir()
    if not asks(run) or has_replies or run.values.get("executor") == SLURM:
        return
    key = perception_of(run).language.key_variable
    try:
        check_key(perception_of(run).language)
    except ModelMissing as error:
        yield Need("key", key, is_available=False, how=f"export {key}=...", remark=str(error))


def _models(run: RecipeRun) -> Iterator[Need]:
    """Packages and weights of the profile ``paper``, and any encoder other than the embedded one."""
    config = perception_of(run)
    names = models_of(run.profile, config)
    for package in PACKAGES if names else ():
        try:
            require_installed(package, "profile 'paper'")
        except Su3dError as error:
            yield Need(
                "package", package, is_available=False, how="pip install 'su3d-bench[models]'", remark=str(error)
            )
        else:
            yield Need("package", package, is_available=True)
    for name in dict.fromkeys(names):
        yield _model(name, config, is_required=name not in OPTIONAL_MODELS or config.paper.tagger != "auto")


def _model(name: str, config: PerceptionConfig, *, is_required: bool) -> Need:
    forms: tuple[FormName, ...] | None = ("onnx",) if name == TAGGER else None
    place = config.models.paths.get(name), config.models.folder
    remark = "" if is_required else f"replaced by the {config.paper.n_tags} most likely words of a list, by the encoder"
    try:
        files = locate(name, forms, path=place[0], folder=place[1])
    except ModelMissing:
        n_bytes = built_in().named(name, "models").n_bytes
        how = f"su3d-bench models fetch {'--profile paper' if name in FETCHED_FOR_PAPER else name}"
        how += ", then tools/export_onnx.py ram-plus" if forms else ""
        return Need("model", name, is_available=False, n_bytes=n_bytes, how=how, is_required=is_required, remark=remark)
    return Need("model", name, is_available=True, n_bytes=0.0, remark=str(files.folder))


# ---- shown


def size(n_bytes: float | None) -> str:
    """A human-readable size.

    >>> size(2_564_000_000.0), size(1500.0), size(None)
    ('2.56 GB', '0.00 GB', 'unknown')
    """
    return "unknown" if n_bytes is None else f"{n_bytes / 1e9:.2f} GB"


def preflight_tables(known: Preflight) -> list[Table]:
    """The table of available and missing requirements."""
    rows = [["what", "name", "available", "bytes", "how to get it"]]
    rows += [[need.kind, need.name, _state(need), _bytes(need), need.how or "-"] for need in known.needs]
    remarks = [f"{need.name}: {need.remark}" for need in known.needs if need.remark and not need.is_available]
    return [text_table("needs", rows, heading="Requirements", caption=f": {_lines(known)}", notes=remarks)]


def _state(need: Need) -> str:
    if need.is_available or need.is_required:
        return "yes" if need.is_available else "no"
    return "no (replaced)" if need.kind == "model" else "no (optional)"


def _bytes(need: Need) -> str:
    return (
        "-" if need.is_available and not need.n_bytes else "unknown" if need.n_bytes is None else f"{need.n_bytes:,.0f}"
    )


def _lines(known: Preflight) -> str:
    missing = known.missing
    n_bytes = sum(need.n_bytes or 0.0 for need in missing if need.kind in ("model", "scene", "data"))
    if not missing:
        return "all requirements are available."
    return f"{counted(len(missing), 'requirement')} missing, about {size(n_bytes)} to fetch."


def summary(known: Preflight) -> Iterator[str]:
    """The preflight in a few lines."""
    yield f"preflight: {_lines(known)[:-1]}"
    for need in known.needs:
        if not need.is_available:
            yield f"  missing: {need.kind} {need.name}" + (f" ({need.remark})" if need.remark else "")
