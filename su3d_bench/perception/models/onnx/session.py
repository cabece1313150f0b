"""Sessions of ONNX Runtime on a chosen provider, set up to give the same answer every time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.perception.models.files import bounded

Provider = Literal["cpu", "cuda", "tensorrt"]
PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}


def open_session(path: Path, provider: Provider = "cpu", device_index: int = 0, n_threads: int = 1) -> Any:
    """An ``InferenceSession`` of the model at ``path``; raises where the provider is absent or the file damaged.

    ``n_threads`` on the CPU: one, so that no sum depends on the machine's number of cores. Operators that a GPU
    provider lacks run on the CPU.
    """
    import onnxruntime

    available = onnxruntime.get_available_providers()
    if PROVIDERS[provider] not in available:
        known = ", ".join(name for name, long in PROVIDERS.items() if long in available)
        raise ModelMissing(
            f"provider '{provider}': this onnxruntime has {known} alone; pip install onnxruntime-gpu in its place"
        )
    if not path.is_file():
        raise ModelMissing(f"{path}: there is no such file; export the model with su3d-bench models export")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=_chain(provider, device_index))
    except _refusals() as error:
        raise DataError(f"{path}: ONNX Runtime cannot load it: {bounded(error)}; export it anew") from error
    used = session.get_providers()
    if PROVIDERS[provider] not in used:
        # ONNX Runtime falls back to the CPU where a provider's own libraries do not load
        raise ModelMissing(
            f"provider '{provider}': onnxruntime could not start it; install the CUDA libraries it needs"
        )
    return session


def _refusals() -> tuple[type[Exception], ...]:
    """What ONNX Runtime raises for a file: classes of its own, with none in common but ``Exception``."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    found = (value for value in vars(state).values() if isinstance(value, type))
    return tuple(value for value in found if issubclass(value, Exception))


def _chain(provider: Provider, device_index: int) -> list[Any]:
    on_device = {"device_id": device_index}
    if provider == "cuda":
        # the default searches an algorithm by timing, which may differ from run to run
        return [
            (PROVIDERS["cuda"], {**on_device, "cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"}),
            PROVIDERS["cpu"],
        ]
    if provider == "tensorrt":
        return [(PROVIDERS["tensorrt"], on_device), (PROVIDERS["cuda"], on_device), PROVIDERS["cpu"]]
    return [PROVIDERS["cpu"]]
