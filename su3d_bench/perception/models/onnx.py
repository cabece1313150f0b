"""Models exported to ONNX: their ``manifest.json``, and deterministic sessions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.perception.models.files import bounded, file_sha256, read_settings

Provider = Literal["cpu", "cuda", "tensorrt"]
PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}


def has_provider(provider: Provider) -> bool:
    """Whether the installed onnxruntime has ``provider``."""
    import onnxruntime

    return PROVIDERS[provider] in onnxruntime.get_available_providers()


class OnnxManifest(BaseModel):
    """The fields read from every manifest: ``files`` name -> SHA-256; ``tools/export_onnx.py`` writes more fields.

    Each kind has the ``FORMAT`` of its file, and the files that it ``REQUIRES``.
    """

    model_config = ConfigDict(strict=True, frozen=True)
    FORMAT: ClassVar[str]
    REQUIRES: ClassVar[tuple[str, ...]]

    name: str
    files: dict[str, str]

    @classmethod
    def read(cls, path: Path) -> Self:
        """The manifest at ``path``; raises ``DataError`` for anything else, and if a required file is not listed."""
        content = read_settings(path)
        layout = content.get("format")
        if layout != cls.FORMAT:
            raise DataError(f"{path}: format is {str(layout)[:60]!r}; expected {cls.FORMAT!r}; export it again")
        try:
            manifest = cls.model_validate_json(json.dumps(content))
        except ValidationError as error:
            raise DataError(f"{path}: is not the manifest of an exported model ({bounded(error, 120)})") from error
        if any(Path(name).name != name for name in manifest.files) or not {*cls.REQUIRES} <= set(manifest.files):
            needed = " and ".join(cls.REQUIRES)
            raise DataError(f"{path}: files must be names inside the folder, including {needed}; export it again")
        return manifest


def wrong_files(manifest: OnnxManifest, folder: Path) -> list[str]:
    """One line per file of the exported model in ``folder`` that is missing or differs from the exported one."""
    wrong = []
    for name, digest in manifest.files.items():
        path = folder / name
        if not path.is_file():
            wrong.append(f"{path}: is missing; export it again")
        elif file_sha256(path) != digest:
            wrong.append(f"{path}: does not match the manifest; export it again")
    return wrong


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
    on_device = {"device_id": device_index}
    # the default selects an algorithm by timing, which may differ from run to run
    fixed = {**on_device, "cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"}
    chains: dict[Provider, list[Any]] = {
        "cpu": [],
        "cuda": [(PROVIDERS["cuda"], fixed)],
        "tensorrt": [(PROVIDERS["tensorrt"], on_device), (PROVIDERS["cuda"], on_device)],
    }
    return [*chains[provider], PROVIDERS["cpu"]]
