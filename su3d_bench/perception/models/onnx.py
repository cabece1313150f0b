"""Deterministic sessions of ONNX Runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.perception.models.files import bounded

Provider = Literal["cpu", "cuda"]
PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
}


def has_provider(provider: Provider) -> bool:
    """Whether the installed onnxruntime has ``provider``."""
    import onnxruntime

    return PROVIDERS[provider] in onnxruntime.get_available_providers()


def open_session(path: Path, provider: Provider = "cpu", device_index: int = 0, n_threads: int = 1) -> Any:
    """An ``InferenceSession`` of the model at ``path``; raises if the provider is missing or the file damaged.

    ``n_threads`` on the CPU: one, so that no sum depends on the machine's number of cores. Operators that a GPU
    provider does not support run on the CPU.
    """
    import onnxruntime

    available = onnxruntime.get_available_providers()
    if PROVIDERS[provider] not in available:
        known = ", ".join(name for name, long in PROVIDERS.items() if long in available)
        raise ModelMissing(
            f"provider '{provider}': not available in this onnxruntime ({known}); install onnxruntime-gpu instead"
        )
    if not path.is_file():
        raise ModelMissing(f"{path}: file not found; export the model with tools/export_onnx.py")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=_chain(provider, device_index))
    except _refusals() as error:
        raise DataError(f"{path}: ONNX Runtime cannot load it: {bounded(error)}; export it again") from error
    used = session.get_providers()
    if PROVIDERS[provider] not in used:
        # ONNX Runtime falls back to the CPU if a provider's own libraries do not load
        raise ModelMissing(f"provider '{provider}': onnxruntime failed to start it; install its CUDA libraries")
    return session


def _refusals() -> tuple[type[Exception], ...]:
    """ONNX Runtime's own exceptions for a file, which have no common class except ``Exception``."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    found = (value for value in vars(state).values() if isinstance(value, type))
    return tuple(value for value in found if issubclass(value, Exception))


def _chain(provider: Provider, device_index: int) -> list[Any]:
    # the default selects an algorithm by timing, which may differ from run to run
    fixed = {"device_id": device_index, "cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"}
    return [*([(PROVIDERS["cuda"], fixed)] if provider == "cuda" else []), PROVIDERS["cpu"]]
