"""Devices, precisions and batches: what is taken where, and what happens when the memory runs out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tiny_models import needs_models

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.devices import Batches, device_for, precision_for
from su3d_bench.core.types import Float32Array


@needs_models
def test_batches_are_halved_when_the_memory_runs_out() -> None:
    import torch

    seen: list[int] = []

    def work(batch: Any) -> Float32Array:
        seen.append(len(batch))
        if len(batch) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return np.asarray(batch, np.float32)

    batches = Batches(8)
    assert np.concatenate(batches.run(range(7), work)).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert seen == [7, 3, 3, 1]
    assert batches.size == 3


def test_jobs_take_the_gpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0) if device == "cuda:0" else (6, 1))
    assert [device_for("cuda", k) for k in range(5)] == ["cuda:0", "cuda:1", "cuda:2", "cuda:0", "cuda:1"]
    assert device_for("cuda:1", 7) == "cuda:1"
    with pytest.raises(ConfigError, match="there are 3 GPUs here"):
        device_for("cuda:3", 0)
    assert precision_for("auto", "cuda:0") == "float16"
    assert precision_for("auto", "cuda:1") == "float32"
    assert precision_for("bfloat16", "cuda:1") == "bfloat16"


def test_the_cpu_takes_float32_and_a_gpu_that_is_not_here_is_one_line() -> None:
    assert device_for("cpu", 3) == "cpu"
    assert precision_for("auto", "cpu") == "float32"
    torch = pytest.importorskip("torch", reason="torch is not installed")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(ConfigError, match="torch sees no GPU here"):
        device_for("cuda", 0)
