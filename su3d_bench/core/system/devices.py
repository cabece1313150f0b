"""Devices, precisions and batch sizes for torch."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np

from su3d_bench.core.errors import ConfigError, ModelMissing

Item = TypeVar("Item")
Done = TypeVar("Done")
CPU = "cpu"
DEVICE = re.compile(r"cpu|cuda(:[0-9]{1,2})?")
EXPECTED_DEVICE = "expected cpu, cuda or cuda:N"
LARGEST_BATCH = 256
# float16 has its own units from compute capability 7.0 (Volta) on; before, half is not faster or not supported.
HALF_CAPABILITY = (7, 0)
EXTRA_PACKAGES = {"torch", "transformers", "safetensors", "onnx", "tokenizers", "openai", "huggingface_hub"}
_log = logging.getLogger(__name__)


def require(package: str, needed_by: str) -> Any:
    """The module ``package``; if it is not installed, a one-line ``ModelMissing`` with the command to install it."""
    import importlib

    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise _not_installed((error.name or package).partition(".")[0], needed_by) from error


def require_installed(package: str, needed_by: str) -> None:
    """The same error if ``package`` is not installed, without importing it, which takes seconds for torch."""
    if find_spec(package) is None:
        raise _not_installed(package, needed_by)


def _not_installed(package: str, needed_by: str) -> ModelMissing:
    command = "'su3d-bench[models]'" if package in EXTRA_PACKAGES else package
    return ModelMissing(f"{needed_by} needs the package '{package}': pip install {command}")


def require_transformers(needed_by: str) -> Any:
    """The module transformers, without progress bars, remarks and network access."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # all files are in the model's folder
    transformers = require("transformers", needed_by)
    transformers.utils.logging.disable_progress_bar()
    transformers.utils.logging.set_verbosity_error()
    return transformers


def device_for(device: str, job_index: int) -> str:
    """The device of job ``job_index``: ``cuda`` means all GPUs, which jobs use in turn.

    Raises ``ConfigError`` for a missing GPU; torch is not imported if ``device`` is ``cpu``.
    """
    if DEVICE.fullmatch(device) is None:
        raise ConfigError(f"device {device[:40]!r}: {EXPECTED_DEVICE}")
    if device == CPU:
        return CPU
    torch = require("torch", f"device '{device}'")
    n_devices = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if n_devices == 0:
        raise ConfigError(f"device '{device}': torch finds no GPU; use --device cpu or a torch build with CUDA")
    if device == "cuda":
        return f"cuda:{job_index % n_devices}"
    if int(device.partition(":")[2]) >= n_devices:
        raise ConfigError(f"device '{device}': this machine has {n_devices} GPUs, cuda:0 to cuda:{n_devices - 1}")
    return device


def gpu_memory_bytes(device: str) -> list[int]:
    """The total memory of each GPU that jobs use with ``device``; empty for the CPU."""
    if device == CPU:
        return []
    device_for(device, 0)  # raises if there is no such GPU
    cuda = require("torch", f"device '{device}'").cuda
    numbers = range(cuda.device_count()) if device == "cuda" else [int(device.partition(":")[2])]
    return [int(cuda.get_device_properties(number).total_memory) for number in numbers]


def precision_for(precision: str, device: str) -> str:
    """The precision to use on ``device``; ``auto`` is float16 if the GPU supports it, and float32 on the CPU."""
    if precision != "auto":
        return precision
    if device == CPU:
        return "float32"
    torch = require("torch", f"device '{device}'")
    return "float16" if torch.cuda.get_device_capability(device) >= HALF_CAPABILITY else "float32"


def make_deterministic(device: str) -> None:
    """Make the GPU's libraries use deterministic algorithms and full float32 products; no effect on the CPU."""
    if device == CPU:
        return
    torch = require("torch", f"device '{device}'")
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.benchmark = False
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


def first_batch(device: str, item_bytes: int, weights_bytes: int) -> int:
    """The initial batch size: 1 on the CPU; on a GPU the power of two that fits half of the memory besides the weights.

    It depends on the GPU's total memory, not on what is free at the moment, so that the same machine uses the same
    batches; ``Batches`` halves it if other programs use the memory.
    """
    if device == CPU:
        return 1
    torch = require("torch", f"device '{device}'")
    total = int(torch.cuda.get_device_properties(device).total_memory)
    fitting = max((total - weights_bytes) // 2 // max(item_bytes, 1), 1)
    return min(int(2 ** np.floor(np.log2(fitting))), LARGEST_BATCH)


class Batches:
    """Runs items through a model in batches, and in smaller ones after the device has run out of memory."""

    def __init__(self, size: int) -> None:
        assert size >= 1
        self.size = size

    def run(self, items: Sequence[Item], work: Callable[[Sequence[Item]], Done]) -> list[Done]:
        """The results of ``work`` per batch of ``items``, in order; an item that does not fit alone is an error."""
        done: list[Done] = []
        start = 0
        while start < len(items):
            batch = items[start : start + self.size]
            try:
                done.append(work(batch))
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                self._shrink(len(batch), error)
                continue
            start += len(batch)
        return done

    def _shrink(self, n_failed: int, error: RuntimeError) -> None:
        if n_failed == 1:
            raise ConfigError(
                "out of device memory with a batch of 1; use a smaller model, float16, or --device cpu"
            ) from error
        self.size = n_failed // 2
        _log.info("out of device memory; continuing with batches of %d", self.size)
        empty_cache()


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch ran out of device memory; the class is checked by name, so that torch need not be imported."""
    return type(error).__name__ == "OutOfMemoryError" and type(error).__module__.startswith("torch")


def empty_cache() -> None:
    """Return memory that torch holds in reserve to the GPU."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.empty_cache()
