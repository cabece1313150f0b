"""Torch modules as ONNX files, and how far the two agree."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.core.files.locks import bring_to_disk, unfinished_folder

# 17 has LayerNormalization as one operator; newer ones bring nothing that our towers use.
OPSET = 17
# A protobuf message may hold 2 GiB; what is larger keeps its weights in a file beside it.
LARGEST_SINGLE_FILE = 2**31 - 2**24


@dataclass(frozen=True)
class Parity:
    """How far one output of ONNX Runtime is from torch's on fixed inputs.

    ``max_abs_difference`` over all values; ``min_cosine`` over the rows along the last axis; rows that are zero on
    both sides agree.
    """

    output: str
    n_values: int
    max_abs_difference: float
    min_cosine: float


def as_module(compute: Callable[..., Any], model: Any) -> Any:
    """``compute``, which runs parts of ``model``, as a torch module in evaluation mode, which the exporter takes."""
    import torch

    class Computing(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, *values: Any) -> Any:
            return compute(*values)

    return Computing().eval()


def export_onnx(
    module: Any,
    inputs: Mapping[str, Any],
    path: Path,
    output_names: Sequence[str],
    dynamic_axes: Mapping[str, Mapping[int, str]] | None = None,
) -> list[Path]:
    """Write ``module`` as ``path`` and return the files made: the weights of a large one lie in ``<path>.data``.

    ``inputs`` are the module's positional arguments in order, by the names that they get. ``dynamic_axes`` names, for
    inputs and outputs, the axes whose size may differ from that of ``inputs``. The module's own mode is kept; give it
    in evaluation mode.
    """
    import torch

    make_folder(path.parent)
    with unfinished_folder(path) as folder:
        draft = folder / path.name
        with _slow_attention(torch), torch.no_grad(), warnings.catch_warnings():
            # The exporter warns of its own age and of every shape that it takes as constant; parity is what counts.
            warnings.simplefilter("ignore")
            # dynamo=False: the newer exporter needs one more package and always splits the file.
            torch.onnx.export(
                module,
                tuple(inputs.values()),
                str(draft),
                input_names=list(inputs),
                output_names=list(output_names),
                dynamic_axes={name: dict(axes) for name, axes in (dynamic_axes or {}).items()},
                opset_version=OPSET,
                do_constant_folding=True,
                dynamo=False,
            )
        return settle(draft, path)


def settle(draft: Path, path: Path) -> list[Path]:
    """Move the exporter's files to where they belong, the many files of a large model's weights as one."""
    import onnx

    # The weights name their file relative to the model's folder, so the last name is used from the start.
    data = path.with_name(f"{path.name}.data")
    size = sum(file.stat().st_size for file in draft.parent.iterdir())
    try:
        if size < LARGEST_SINGLE_FILE:
            bring_to_disk(draft)
            os.replace(draft, path)
            data.unlink(missing_ok=True)
            return [path]
        model = onnx.load(str(draft))
        settled = draft.parent / "settled"
        settled.mkdir()
        onnx.save_model(
            model, str(settled / path.name), save_as_external_data=True, location=data.name, size_threshold=1024
        )
        for file in (settled / data.name, settled / path.name):
            bring_to_disk(file)
        os.replace(settled / data.name, data)
        os.replace(settled / path.name, path)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    return [path, data]


@contextmanager
def _slow_attention(torch: Any) -> Iterator[None]:
    """Without the fused kernel of ``nn.MultiheadAttention``, for which the exporter has no operator."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(before)


def measure_parity(
    module: Any, session: Any, inputs: Mapping[str, Any], output_names: Sequence[str]
) -> tuple[Parity, ...]:
    """Torch's and ONNX Runtime's outputs on ``inputs``, compared one by one."""
    import torch

    with torch.no_grad():
        answer = module(*inputs.values())
    ours = [answer] if isinstance(answer, torch.Tensor) else list(answer)
    feed = {name: value.detach().cpu().numpy() for name, value in inputs.items()}
    theirs = session.run(list(output_names), feed)
    return tuple(
        compare_outputs(name, mine.detach().float().cpu().numpy(), np.asarray(other))
        for name, mine, other in zip(output_names, ours, theirs, strict=True)
    )


def compare_outputs(name: str, mine: NDArray[Any], other: NDArray[Any]) -> Parity:
    """The ``Parity`` of two arrays of one shape."""
    assert mine.shape == other.shape, f"{name}: {mine.shape} and {other.shape}"
    a, b = mine.astype(np.float64), other.astype(np.float64)
    rows_a, rows_b = (array.reshape(-1, array.shape[-1] if array.ndim else 1) for array in (a, b))
    norms = np.linalg.norm(rows_a, axis=1) * np.linalg.norm(rows_b, axis=1)
    products = (rows_a * rows_b).sum(axis=1)
    both_zero = ~rows_a.any(axis=1) & ~rows_b.any(axis=1)
    cosines = np.where(both_zero, 1.0, products / np.where(norms > 0, norms, 1.0))
    return Parity(name, a.size, float(np.abs(a - b).max(initial=0.0)), float(min(cosines.min(initial=1.0), 1.0)))
