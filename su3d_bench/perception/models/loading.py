"""From the configuration to an encoder that is ready; its towers are read when the first feature is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.devices import CPU, device_for, precision_for, require, require_installed
from su3d_bench.perception.cache import FrameCache
from su3d_bench.perception.models.catalogue import FormName, model_entry
from su3d_bench.perception.models.config import EMBEDDED, ModelsConfig, Runtime
from su3d_bench.perception.models.encoders import towers_onnx, towers_open_clip, towers_transformers
from su3d_bench.perception.models.encoders.encoder import EncoderSpec, FoundationEncoder, Towers
from su3d_bench.perception.models.encoders.text_tokens import Tokeniser, read_tokeniser
from su3d_bench.perception.models.files import ModelFiles, locate
from su3d_bench.perception.models.onnx.session import Provider

FORM_OF_RUNTIME: Mapping[Runtime, FormName] = {"torch": "transformers", "open_clip": "open_clip", "onnx": "onnx"}
PACKAGES_OF_RUNTIME: Mapping[Runtime, tuple[str, ...]] = {
    "torch": ("torch", "transformers"),
    "open_clip": ("torch", "open_clip"),
    "onnx": ("onnxruntime", "transformers"),
}


def load_encoder(
    config: ModelsConfig, *, default: str = EMBEDDED, cache: FrameCache | None = None, job_index: int = 0
) -> Encoder:
    """The encoder that ``config`` names, or ``default``, the profile's own, where it names none.

    ``cache`` keeps the features of texts; ``job_index`` chooses among several GPUs. Raises ``ModelMissing`` for a
    package or file that is not here, before anything heavy is loaded.
    """
    name = config.encoder or default
    if name == EMBEDDED:
        from su3d_bench.perception.embedded.encoder import EmbeddedEncoder

        if config.runtime != "torch":
            raise ConfigError(
                f"perception.models.runtime '{config.runtime}': the embedded encoder has its own; choose "
                "perception.models.encoder or --profile paper"
            )
        return EmbeddedEncoder(device=device_for(config.device, job_index))
    files = encoder_files(config, name)
    for package in PACKAGES_OF_RUNTIME[config.runtime]:
        require(package, f"encoder '{name}'")
    if config.runtime == "onnx":
        return _onnx_encoder(config, files, cache, job_index)
    return _torch_encoder(config, files, cache, job_index)


def check_encoder(config: ModelsConfig, name: str) -> None:
    """Raises what ``load_encoder`` would of packages and files of encoder ``name``; nothing is imported or read."""
    encoder_files(config, name)
    for package in PACKAGES_OF_RUNTIME[config.runtime]:
        require_installed(package, f"encoder '{name}'")


def encoder_files(config: ModelsConfig, name: str) -> ModelFiles:
    """Where the files of encoder ``name`` lie in the form that the configured runtime reads."""
    model_entry(name, "encoder")
    return locate(name, (FORM_OF_RUNTIME[config.runtime],), path=config.paths.get(name), folder=config.folder)


def _torch_encoder(
    config: ModelsConfig, files: ModelFiles, cache: FrameCache | None, job_index: int
) -> FoundationEncoder:
    device = device_for(config.device, job_index)
    precision = precision_for(config.precision, device)
    load_towers = partial(_torch_towers, files, config.runtime, device, precision, config.batch)

    def identity() -> Mapping[str, Any]:
        kind = device.partition(":")[0]
        return {"runtime": config.runtime, "files": files.digests(), "precision": precision, "device": kind}

    if config.runtime == "open_clip":
        spec = towers_open_clip.read_spec(files, config.transform)
        tokeniser: Callable[[], Tokeniser] = partial(towers_open_clip.read_tokeniser, files)
    else:
        spec = towers_transformers.read_spec(files, config.transform)
        tokeniser = _tokeniser_of(files, spec)
    return FoundationEncoder(files.known_as, spec, load_towers, tokeniser, identity, cache, device)


def _onnx_encoder(
    config: ModelsConfig, files: ModelFiles, cache: FrameCache | None, job_index: int
) -> FoundationEncoder:
    provider: Provider = config.provider or ("cpu" if config.device == "cpu" else "cuda")
    device_index = 0 if provider == "cpu" else int(device_for(config.device, job_index).partition(":")[2])
    manifest = towers_onnx.read_manifest(files.weights)
    if manifest.name != files.entry.name:
        raise ConfigError(f"{files.folder}: holds '{manifest.name}', not '{files.entry.name}'; mend models.paths")
    spec = towers_onnx.read_spec(files, config.transform)

    def identity() -> Mapping[str, Any]:
        return {"runtime": "onnx", "files": dict(manifest.files), "provider": provider}

    load_towers = partial(_onnx_towers, files, provider, device_index, config.batch)
    device = CPU if provider == "cpu" else f"cuda:{device_index}"
    return FoundationEncoder(files.known_as, spec, load_towers, _tokeniser_of(files, spec), identity, cache, device)


# A worker makes a new encoder for each method and scene; the towers, gigabytes of them, are kept.
@lru_cache(maxsize=1)
def _torch_towers(files: ModelFiles, runtime: Runtime, device: str, precision: str, batch: int) -> Towers:
    if runtime == "open_clip":
        return towers_open_clip.OpenClipTowers(towers_open_clip.load_model(files), device, precision, batch)
    return towers_transformers.TransformersTowers(towers_transformers.load_model(files), device, precision, batch)


@lru_cache(maxsize=1)
def _onnx_towers(files: ModelFiles, provider: Provider, device_index: int, batch: int) -> Towers:
    return towers_onnx.OnnxTowers(files, provider, device_index, batch)


def _tokeniser_of(files: ModelFiles, spec: EncoderSpec) -> Callable[[], Tokeniser]:
    return partial(read_tokeniser, files.folder, spec.tokens, spec.n_tokens, spec.pad_id, spec.n_words)
