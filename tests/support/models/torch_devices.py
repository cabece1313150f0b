"""The devices of torch that tests run on: the CPU, by a name for which the package takes torch, and a GPU if any."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

TORCH_ON_CPU = "cpu:0"  # torch's name of the CPU that is not "cpu", for which the package does without torch


def _has_gpu() -> bool:
    drivers = (Path("/dev/nvidiactl"), Path("/dev/kfd"))
    if find_spec("torch") is None or not any(driver.exists() for driver in drivers):
        return False  # without seconds for the import of torch
    import torch

    return bool(torch.cuda.is_available())


needs_torch = pytest.mark.skipif(find_spec("torch") is None, reason="needs torch: pip install 'su3d-bench[models]'")
needs_gpu = pytest.mark.skipif(not _has_gpu(), reason="needs a GPU that torch can use")
on_each_device = pytest.mark.parametrize(
    "device",
    [pytest.param(TORCH_ON_CPU, marks=needs_torch), pytest.param("cuda:0", marks=[needs_torch, needs_gpu])],
)
