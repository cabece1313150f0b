"""From the configuration to the networks of the profile ``paper``, each read when it is first used."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from importlib.util import find_spec

from su3d_bench.core.errors import ConfigError, DataError, ModelMissing
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.devices import device_for, precision_for, require, require_installed
from su3d_bench.perception.cache import content_key
from su3d_bench.perception.models.catalogue import FormName
from su3d_bench.perception.models.config import EMBEDDED, ModelsConfig, PaperConfig
from su3d_bench.perception.models.files import ModelFiles, locate
from su3d_bench.perception.models.loading import check_encoder
from su3d_bench.perception.models.masks.grounded_sam import Networks
from su3d_bench.perception.models.masks.sam import Sam, SamNetwork
from su3d_bench.perception.models.masks.sam_onnx import load_onnx_sam
from su3d_bench.perception.models.masks.tagging import (
    RAM_TAG_LIST,
    OnnxRamTagger,
    RamTagger,
    Tagger,
    WordTagger,
    load_ram,
    read_word_list,
    wrong_tagger,
)
from su3d_bench.perception.models.onnx.session import Provider, open_session
from su3d_bench.perception.models.pretrained import kept, load_grounding_dino, load_sam

PAPER_ENCODER, DETECTOR, TAGGER = "clip-vit-h-14", "grounding-dino", "ram-plus"
PACKAGES = ("torch", "transformers")
_FORM_OF_TAGGER: Mapping[str, FormName] = {RamTagger.name: "original", OnnxRamTagger.name: "onnx"}
_SAM_FORMS: tuple[FormName, ...] = ("transformers", "original")


def load_networks(config: PaperConfig, models: ModelsConfig, encoder: Encoder, job_index: int = 0) -> Networks:
    """Tagger, detector and segmenter as configured.

    Raises ``ModelMissing`` for a package or file that is not here, before anything heavy is read.
    """
    for package in PACKAGES:
        require(package, "profile 'paper'")
    sam = _locate_sam(config, models)
    detector = _locate(models, DETECTOR, ("transformers",))
    device = device_for(models.device, job_index)
    precision = precision_for(models.precision, device)
    # What moves a number is the kind of device, not which of several.
    digests = [content_key(device.partition(":")[0], precision)]
    digests += [text for files in (sam, detector) for pair in sorted(files.digests().items()) for text in pair]
    if config.sam_runtime == "onnx":
        provider: Provider = models.provider or ("cpu" if device == "cpu" else "cuda")
        index = 0 if provider == "cpu" else int(device.partition(":")[2] or 0)
        digests.append(provider)

        def network() -> SamNetwork:
            return kept(sam, (provider, str(index)), lambda: load_onnx_sam(sam, provider, index))
    else:

        def network() -> SamNetwork:
            return load_sam(sam, device, precision)

    tagger = _tagger(config, models, encoder, device)
    used = [sam, detector]
    if (form := _FORM_OF_TAGGER.get(tagger.name)) is not None:
        used.append(_locate(models, TAGGER, (form,)))
    return Networks(
        tagger,
        lambda: load_grounding_dino(detector, device, precision),
        lambda: Sam(network()),
        content_key(*digests),
        tuple(files.entry.name for files in used if files.is_stand_in),
    )


def is_front_end_here(config: PaperConfig, models: ModelsConfig) -> bool:
    """Whether the profile can run: packages, encoder, detector and segmenter are here; tags can do without RAM++."""
    try:
        _check_networks(config, models)
    except (ModelMissing, ConfigError):
        return False
    return True


def check_front_end(config: PaperConfig, models: ModelsConfig) -> None:
    """Raises ``ModelMissing`` for the first package or file that is not here; nothing heavy is imported or read."""
    _check_networks(config, models)
    if config.tagger == "ram":
        require_installed("ram", "tagger 'ram'")
        _locate(models, TAGGER, ("original",))
    elif config.tagger == "ram-onnx":
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
    return _locate(models, config.segmenter, ("onnx",) if config.sam_runtime == "onnx" else _SAM_FORMS)


def _tagger(config: PaperConfig, models: ModelsConfig, encoder: Encoder, device: str) -> Tagger:
    """The tagger that is asked for, or with ``auto`` the first that is here."""
    if config.tagger == "ram" or (config.tagger == "auto" and find_spec("ram") is not None):
        with _passed_over(config.tagger):
            require("ram", "tagger 'ram'")
            files = _locate(models, TAGGER, ("original",))
            digests = [text for pair in sorted(files.digests().items()) for text in pair]
            # RAM++'s own code mixes float32 in, so it runs in float32 wherever it runs.
            load = partial(kept, files, (device,), partial(load_ram, files, device))
            return RamTagger(load, device, content_key(*digests))
    if config.tagger in ("ram-onnx", "auto"):
        with _passed_over(config.tagger):
            files = _locate(models, TAGGER, ("onnx",))
            if wrong := wrong_tagger(files):
                raise DataError(wrong[0])
            tags = read_word_list(files.folder / RAM_TAG_LIST)
            return OnnxRamTagger(partial(open_session, files.weights), tags, content_key(*files.digests().values()))
    return WordTagger(encoder, read_word_list(config.words), config.n_tags)


def _passed_over(tagger: str) -> AbstractContextManager[None]:
    """A model that is not here is an error where it was asked for by its name."""
    return suppress(ModelMissing) if tagger == "auto" else nullcontext()
