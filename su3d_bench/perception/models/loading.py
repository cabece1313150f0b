"""Encoders and the networks of the profile ``paper`` from the configuration, each read at first use."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import ConfigError, DataError, ModelMissing
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.devices import CPU, device_for, precision_for, require, require_installed
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.models.catalogue import PROFILE_MODELS, FormName, ModelEntry, model_entry
from su3d_bench.perception.models.config import EMBEDDED, ModelsConfig, PaperConfig
from su3d_bench.perception.models.encoders import encoder as encoders
from su3d_bench.perception.models.encoders.encoder import FoundationEncoder, Towers
from su3d_bench.perception.models.encoders.texts import read_tokeniser
from su3d_bench.perception.models.files import PICKLED, ModelFiles, locate, read_settings, read_weights
from su3d_bench.perception.models.masks import grounded_sam
from su3d_bench.perception.models.masks.grounded_sam import Networks, Tagger
from su3d_bench.perception.models.masks.grounding_dino import load_grounding_dino
from su3d_bench.perception.models.masks.sam import Sam, load_sam
from su3d_bench.perception.models.onnx import Provider, has_provider, open_session

_log = logging.getLogger(__name__)
PACKAGES = ("torch", "transformers")


def load_encoder(
    config: ModelsConfig, *, default: str = EMBEDDED, cache: FrameCache | None = None, job_index: int = 0
) -> Encoder:
    """The encoder named in ``config``, or ``default``, the profile's own, if it names none.

    ``cache`` stores the features of texts; ``job_index`` chooses among several GPUs. Raises ``ModelMissing`` for a
    missing package or file, before anything heavy is loaded.
    """
    name = config.encoder or default
    if name == EMBEDDED:
        from su3d_bench.perception.embedded.encoder import EmbeddedEncoder

        return EmbeddedEncoder(device=device_for(config.device, job_index))
    files = encoder_files(config, name)
    for package in PACKAGES:
        require(package, f"encoder '{name}'")
    return _torch_encoder(config, files, cache, job_index)


def check_encoder(config: ModelsConfig, name: str) -> None:
    """Raises the errors of ``load_encoder`` for packages and files of encoder ``name``; nothing is imported or read."""
    encoder_files(config, name)
    for package in PACKAGES:
        require_installed(package, f"encoder '{name}'")


def encoder_files(config: ModelsConfig, name: str) -> ModelFiles:
    """The files of encoder ``name``."""
    model_entry(name, "encoder")
    return locate(name, ("transformers",), path=config.paths.get(name), folder=config.folder)


def _torch_encoder(
    config: ModelsConfig, files: ModelFiles, cache: FrameCache | None, job_index: int
) -> FoundationEncoder:
    device = device_for(config.device, job_index)
    precision = precision_for(config.precision, device)
    load_towers = partial(_torch_towers, files, files.state, device, precision, config.batch)

    def identity() -> Mapping[str, Any]:
        kind = device.partition(":")[0]
        return {"runtime": "torch", "files": files.digests(), "precision": precision, "device": kind}

    spec = encoders.transformers_spec(files, config.transform)
    tokeniser = partial(read_tokeniser, files.folder, spec.tokens, spec.n_tokens, spec.pad_id, spec.n_words)
    return FoundationEncoder(files.entry.known_as, spec, load_towers, tokeniser, identity, cache, device)


# A worker creates a new encoder for each method and scene; the towers, which take gigabytes, are cached.
@lru_cache(maxsize=1)
def _torch_towers(files: ModelFiles, state: object, device: str, precision: str, batch: int) -> Towers:
    return encoders.TransformersTowers(encoders.load_transformers(files), device, precision, batch)


PAPER_ENCODER, DETECTOR, TAGGER = "clip-vit-h-14", "grounding-dino", "ram-plus"
_SAM_FORMS: tuple[FormName, ...] = ("transformers", "original")


def load_networks(config: PaperConfig, models: ModelsConfig, encoder: Encoder, job_index: int = 0) -> Networks:
    """Tagger, detector and segmenter as configured.

    Raises ``ModelMissing`` for a missing package or file, before anything heavy is read.
    """
    for package in PACKAGES:
        require(package, "profile 'paper'")
    sam = _locate_sam(config, models)
    detector = _locate(models, DETECTOR, ("transformers",))
    device = device_for(models.device, job_index)
    precision = precision_for(models.precision, device)
    # Numbers depend on the kind of device, not on which of several is used.
    digests = [content_key(device.partition(":")[0], precision)]
    digests += [text for files in (sam, detector) for pair in sorted(files.digests().items()) for text in pair]
    return Networks(
        _tagger(config, models, encoder, device),
        lambda: load_grounding_dino(detector, device, precision),
        lambda: Sam(load_sam(sam, device, precision)),
        content_key(*digests),
    )


def is_front_end_available(config: PaperConfig, models: ModelsConfig) -> bool:
    """Whether the profile can run: packages, encoder, detector and segmenter are installed; RAM++ is optional."""
    try:
        _check_networks(config, models)
    except (ModelMissing, ConfigError):
        return False
    return True


def check_front_end(config: PaperConfig, models: ModelsConfig) -> None:
    """Raises ``ModelMissing`` for the first missing package or file; nothing heavy is imported or read."""
    _check_networks(config, models)
    if config.tagger == "ram-onnx":
        _locate(models, TAGGER, ("onnx",))


def _check_networks(config: PaperConfig, models: ModelsConfig) -> None:
    for package in PACKAGES:
        require_installed(package, "profile 'paper'")
    if models.encoder != EMBEDDED:
        check_encoder(models, models.encoder or PAPER_ENCODER)
    _locate_sam(config, models)
    _locate(models, DETECTOR, ("transformers",))


def _locate(models: ModelsConfig, name: str, forms: tuple[FormName, ...]) -> ModelFiles:
    return locate(name, forms, path=models.paths.get(name), folder=models.folder)


def _locate_sam(config: PaperConfig, models: ModelsConfig) -> ModelFiles:
    return _locate(models, config.segmenter, _SAM_FORMS)


def _tagger(config: PaperConfig, models: ModelsConfig, encoder: Encoder, device: str) -> Tagger:
    """The configured tagger, or with ``auto`` the first that is available."""
    if config.tagger in ("ram-onnx", "auto"):
        with _skip_missing(config.tagger):
            files = _locate(models, TAGGER, ("onnx",))
            if wrong := grounded_sam.wrong_tagger(files):
                raise DataError(wrong[0])
            tags = grounded_sam.read_word_list(files.folder / grounded_sam.RAM_TAG_LIST)
            provider, index = provider_for(device)
            key = [] if provider == "cpu" else [provider]
            load = partial(open_session, files.weights, provider, index)
            return grounded_sam.OnnxRamTagger(load, tags, content_key(*key, *files.digests().values()))
    return grounded_sam.WordTagger(encoder, grounded_sam.read_word_list(config.words), config.n_tags)


def provider_for(device: str) -> tuple[Provider, int]:
    """The provider and GPU of the exported RAM++: those of ``device`` if onnxruntime has them, otherwise the CPU."""
    if device == CPU:
        return "cpu", 0
    if not has_provider("cuda"):
        _log.info("exported RAM++ runs on the CPU: this onnxruntime has no CUDA provider")
        return "cpu", 0
    return "cuda", int(device.partition(":")[2] or 0)


def _skip_missing(tagger: str) -> AbstractContextManager[None]:
    """Ignore a missing model for ``auto``; if it was requested by name, the error is raised."""
    return suppress(ModelMissing) if tagger == "auto" else nullcontext()


@dataclass(frozen=True)
class ModelState:
    """A model of the catalogue and its forms on this machine; if there is none, ``missing`` names what to download."""

    entry: ModelEntry
    files: tuple[ModelFiles, ...]
    missing: str | None

    @property
    def profiles(self) -> tuple[str, ...]:
        """The profiles that load the model."""
        return tuple(name for name, models in PROFILE_MODELS.items() if self.entry.name in models)


def model_state(entry: ModelEntry, path: Path | None = None, folder: Path | None = None) -> ModelState:
    """The forms of ``entry`` on this machine, at ``path`` or where models are searched."""
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
    """Everything that is wrong with the files of a model, one line each; only the names of the weights are read."""
    problems = files.wrong_digests()
    try:
        if files.form.form == "onnx":
            return problems + grounded_sam.wrong_tagger(files)
        if files.form.form == "transformers":
            if files.entry.kind == "encoder":
                encoders.transformers_spec(files, "original")
            else:
                read_settings(files.folder / "config.json")
        if files.weights.suffix in PICKLED or files.weights.suffix == ".safetensors":
            read_weights(files.weights, "meta")
    except (DataError, ModelMissing) as error:
        problems.append(str(error))
    return problems


def models_record(names: Sequence[str], config: ModelsConfig) -> dict[str, dict[str, str]]:
    """For a run's record: the SHA-256 of every file of the installed models ``names``, by model and file name."""
    states = [model_state(model_entry(name), config.paths.get(name), config.folder) for name in dict.fromkeys(names)]
    return {state.entry.name: state.files[0].digests() for state in states if state.files}
