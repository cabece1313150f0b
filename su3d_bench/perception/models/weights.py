"""Weights of others' files: plain tensors by name, and nothing that runs code."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

from su3d_bench.core.devices import require
from su3d_bench.core.errors import DataError
from su3d_bench.perception.models.files import ModelFiles

LARGEST_SETTINGS = 2**24  # bytes; a tokenizer.json of 256,000 words has 2**23
PICKLED = {".bin", ".pt", ".pth", ".ckpt"}


def read_weights(path: Path, device: str = "cpu") -> dict[str, Any]:
    """The tensors of a ``.safetensors`` file, or of a torch file that is read with ``weights_only=True``.

    ``device`` ``meta`` reads names, shapes and types alone. A torch file that holds one level more, under ``model`` or
    ``state_dict``, gives that level. Raises ``DataError`` for any other content.
    """
    if path.suffix == ".safetensors":
        content = _read_safetensors(path, device)
    elif path.suffix in PICKLED:
        content = _read_pickled(path, device)
    else:
        raise DataError(f"{path}: weights are read from .safetensors, .bin, .pt or .pth, not '{path.suffix}'")
    torch = require("torch", f"{path.name}:")
    for level in ("model", "state_dict"):
        inner = content.get(level) if isinstance(content, dict) else None
        if isinstance(inner, dict):
            content = inner
            break
    if not isinstance(content, dict) or not content or not all(isinstance(v, torch.Tensor) for v in content.values()):
        raise DataError(f"{path}: is no table of tensors by name; fetch the file anew from where it was published")
    return {str(name): tensor for name, tensor in content.items()}


def _read_safetensors(path: Path, device: str) -> Any:
    safetensors = require("safetensors.torch", f"{path.name}:")
    error_class = require("safetensors", f"{path.name}:").SafetensorError
    torch = require("torch", f"{path.name}:")
    try:
        if device != "meta":
            return safetensors.load_file(str(path), device=device)
        with require("safetensors", f"{path.name}:").safe_open(str(path), framework="pt") as file:
            return {name: torch.empty(file.get_slice(name).get_shape(), device="meta") for name in file.keys()}  # noqa: SIM118
    except (error_class, OSError, ValueError, RuntimeError) as error:
        raise DataError(f"{path}: not readable as safetensors: {bounded(error)}; fetch it anew") from error


def _read_pickled(path: Path, device: str) -> Any:
    torch = require("torch", f"{path.name}:")
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except pickle.UnpicklingError as error:
        raise DataError(
            f"{path}: holds more than plain tensors, which is refused because it can run code; use the model's "
            "safetensors file"
        ) from error
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, AttributeError, IndexError, TypeError) as error:
        raise DataError(f"{path}: not readable as torch weights: {bounded(error)}; fetch it anew") from error


def check_settings_size(path: Path) -> None:
    """Refuse a file of settings or words that is far larger than any model's; one that is not there is fine."""
    if path.is_file() and path.stat().st_size > LARGEST_SETTINGS:
        raise DataError(f"{path}: has {path.stat().st_size} bytes; a model's settings have at most {LARGEST_SETTINGS}")


def read_settings(path: Path) -> dict[str, Any]:
    """The table in a JSON file of a model's folder, of bounded size; raises ``DataError`` for anything else."""
    check_settings_size(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); fetch it from where the weights come") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as JSON ({bounded(error, 80)}); fetch it anew") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {type(content).__name__}, expected a table")
    return content


def bounded(error: BaseException, limit: int = 160) -> str:
    """What ``error`` says, as one printable line of at most ``limit`` characters."""
    text = "".join(character if character.isprintable() else " " for character in str(error))
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def load_pretrained(files: ModelFiles, model_class: Any, **more: Any) -> Any:
    """A transformers model in float32 on the CPU from local files; weights that are missing are an error, never random.

    ``more`` goes to ``from_pretrained``.
    """
    if files.weights.suffix in PICKLED:
        read_weights(files.weights, "meta")  # says in our words what is wrong with the file
    try:
        model, info = model_class.from_pretrained(
            str(files.folder),
            local_files_only=True,
            use_safetensors=files.weights.suffix == ".safetensors",
            weights_only=True,
            dtype=require("torch", f"model '{files.entry.name}'").float32,
            output_loading_info=True,
            **more,
        )
    except Exception as error:
        # safetensors has an error of its own, which cannot be named without importing it
        known = OSError | ValueError | RuntimeError | KeyError | ImportError
        if type(error).__module__.startswith("safetensors") or isinstance(error, known):
            raise DataError(f"{files.weights}: cannot be loaded: {bounded(error)}; fetch the folder anew") from error
        raise
    if missing := sorted(info["missing_keys"]):
        raise DataError(
            f"{files.weights}: lacks {len(missing)} tensors, such as {missing[0][:80]}; it is no "
            f"{files.entry.name}, fetch the folder anew from {files.form.source}"
        )
    return model
