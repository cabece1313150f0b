"""What of the catalogue is on this machine, whether it is whole, and what a profile's models take to run once."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, DataError, ModelMissing
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Frame, PerceptionNeeds, SceneInfo
from su3d_bench.perception.models.catalogue import PROFILE_MODELS, ModelEntry, model_entry
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.encoders import towers
from su3d_bench.perception.models.files import PICKLED, ModelFiles, locate, read_settings, read_weights
from su3d_bench.perception.models.masks.sam import SamManifest
from su3d_bench.perception.models.masks.tagging import wrong_tagger
from su3d_bench.perception.models.onnx import OnnxManifest, wrong_files

WARM_TEXT = "a chair in a scene"


@dataclass(frozen=True)
class ModelState:
    """A model of the catalogue and the forms of it that are here; where none is, ``missing`` says what to fetch."""

    entry: ModelEntry
    files: tuple[ModelFiles, ...]
    missing: str | None

    @property
    def profiles(self) -> tuple[str, ...]:
        """The profiles that load the model."""
        return tuple(name for name, models in PROFILE_MODELS.items() if self.entry.name in models)


def model_state(entry: ModelEntry, path: Path | None = None, folder: Path | None = None) -> ModelState:
    """Which forms of ``entry`` are here, at ``path`` or where models are looked for."""
    forms = []
    for form in entry.forms:
        with suppress(ModelMissing, ConfigError):
            if form.is_read:
                forms.append(locate(entry.name, (form.form,), path=path, folder=folder))
    try:
        missing = None if forms else str(locate(entry.name, path=path, folder=folder))
    except (ModelMissing, ConfigError) as error:
        missing = str(error)
    return ModelState(entry, tuple(forms), missing)


def problems_of(files: ModelFiles) -> list[str]:
    """Everything that is wrong with the files of a model, a line each; of the weights the names alone are read."""
    problems = files.wrong_digests()
    try:
        if files.form.form == "onnx":
            return problems + _problems_of_export(files)
        if files.form.form == "transformers":
            if files.entry.kind == "encoder":
                towers.transformers_spec(files, "original")
            else:
                read_settings(files.folder / "config.json")
        if files.weights.suffix in PICKLED or files.weights.suffix == ".safetensors":
            read_weights(files.weights, "meta")
    except (DataError, ModelMissing) as error:
        problems.append(str(error))
    return problems


def _problems_of_export(files: ModelFiles) -> list[str]:
    if files.entry.kind == "tagger":
        return wrong_tagger(files)
    kind: type[OnnxManifest] = towers.EncoderManifest if files.entry.kind == "encoder" else SamManifest
    manifest = kind.read(files.weights)
    wrong = wrong_files(manifest, files.folder)
    if manifest.name != files.entry.name:
        wrong.append(f"{files.folder}: holds '{manifest.name}', not '{files.entry.name}'; correct models.paths")
    return wrong


def models_record(names: Sequence[str], config: ModelsConfig) -> dict[str, dict[str, str]]:
    """For a run's record: the SHA-256 of every file of the models ``names`` that are here, by model and file name."""
    states = [model_state(model_entry(name), config.paths.get(name), config.folder) for name in dict.fromkeys(names)]
    return {state.entry.name: state.files[0].digests() for state in states if state.files}


@dataclass(frozen=True)
class WarmUp:
    """What it took to load and run something once: ``stages_ms`` of the run, ``memory_mb`` at most meanwhile.

    ``memory_of``: ``cuda:0`` for what torch took there, ``process`` for the whole process in main memory.
    """

    what: str
    load_s: float
    run_s: float
    stages_ms: dict[str, float]
    memory_mb: float
    memory_of: str
    digest: str


def warm_encoder(encoder: Encoder, device: str) -> WarmUp:
    """Load the towers of ``encoder`` and run them on one image and one text."""
    images = [warm_frame().rgb]

    def load() -> None:
        encoder.encode_images(images)
        encoder.encode_texts([WARM_TEXT])

    return _warmed(encoder.name, device, load, lambda _: encoder.encode_images(images), lambda: encoder.digest)


def warm_perception(perception: Any, device: str) -> WarmUp:
    """Let ``perception``, a profile that was built, detect in one made frame twice: loading, then running."""
    needs = PerceptionNeeds(crop_ratios=(0.8, 1.0, 1.2))  # S_r of the paper
    frame = warm_frame()

    def run(timer: Timer) -> None:
        perception.detect(frame, needs, timer)

    return _warmed(perception.profile, device, lambda: run(Timer()), run, lambda: perception.digest)


def _warmed(
    what: str, device: str, load: Callable[[], object], run: Callable[[Timer], object], digest: Callable[[], str]
) -> WarmUp:
    if device != "cpu":
        import torch

        torch.cuda.reset_peak_memory_stats(device)
    start = time.perf_counter()
    load()
    loaded = time.perf_counter()
    timer = Timer()
    run(timer)
    run_s = time.perf_counter() - loaded
    memory_mb, memory_of = _peak_memory(device)
    stages = {name: round(ms, 3) for name, ms in timer.take().items()}
    return WarmUp(what, loaded - start, run_s, stages, memory_mb, memory_of, digest())


def warm_scene() -> SceneInfo:
    """The scene of ``warm_frame``."""
    return SceneInfo("warm", "frame", 1, 1, "camera")


def warm_frame() -> Frame:
    """A made frame (480, 640): three coloured boxes before a wall."""
    rgb = np.full((480, 640, 3), 205, np.uint8)
    depth_m = np.full((480, 640), 3.0, np.float32)
    for left, colour, distance_m in ((60, (190, 40, 40), 2.0), (260, (50, 140, 60), 2.3), (460, (40, 60, 180), 2.6)):
        rgb[180:380, left : left + 120] = colour
        depth_m[180:380, left : left + 120] = distance_m
    intrinsics = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])
    return Frame(0, 0.0, rgb, depth_m, np.eye(4), intrinsics)


def _peak_memory(device: str) -> tuple[float, str]:
    if device != "cpu":
        import torch

        return torch.cuda.max_memory_allocated(device) / 1e6, device
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB on Linux, bytes on macOS
    return peak / (1e6 if sys.platform == "darwin" else 1e3), "process"
