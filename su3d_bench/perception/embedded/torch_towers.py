"""The towers of the embedded encoder in torch, with the weights of their ONNX files: what runs them on a GPU."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from su3d_bench.core.devices import make_deterministic, require
from su3d_bench.core.types import Float32Array

if TYPE_CHECKING:
    from torch import nn


class TorchTower:
    """One tower on ``device``, called as the session of ONNX Runtime that it stands in for is."""

    def __init__(self, path: Path, *, is_image: bool, device: str) -> None:
        require("torch", f"device '{device}'")
        from su3d_bench.perception.embedded.training_model import ImageTower, TextTower

        make_deterministic(device)
        self._device = device
        self._names = ("pixels", "log_size") if is_image else ("ids",)
        tower = ImageTower() if is_image else TextTower()
        self._tower = with_weights(tower.eval(), path, device).to(device)

    def run(self, _outputs: None, inputs: Mapping[str, Any]) -> list[Float32Array]:
        """The features (N, 128), as the only output."""
        import torch

        with torch.inference_mode():
            tensors = [torch.from_numpy(np.ascontiguousarray(inputs[name])).to(self._device) for name in self._names]
            return [self._tower(*tensors).cpu().numpy()]


def with_weights(tower: nn.Module, path: Path, device: str) -> nn.Module:
    """``tower`` with the weights of the file at ``path``, where each convolution holds its normalisation."""
    import torch
    from torch.nn.utils.fusion import fuse_conv_bn_eval

    onnx = require("onnx", f"the embedded encoder on device '{device}'")
    for layers in [one for one in tower.modules() if isinstance(one, torch.nn.Sequential)]:
        for k, (one, after) in enumerate(pairwise(list(layers))):
            if isinstance(one, torch.nn.Conv2d) and isinstance(after, torch.nn.BatchNorm2d):
                layers[k], layers[k + 1] = fuse_conv_bn_eval(one, after), torch.nn.Identity()
    graph = onnx.load(str(path)).graph
    stored = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    names = [name for name, layer in tower.named_modules() if isinstance(layer, torch.nn.Conv1d | torch.nn.Conv2d)]
    # Normalised convolutions have lost their names in the file; nodes stand in the order in which they run.
    nodes = [node for node in graph.node if node.op_type == "Conv"]
    state = {name: value for name, value in stored.items() if name in tower.state_dict()}
    for name, node in zip(names, nodes, strict=True):
        state[f"{name}.weight"], state[f"{name}.bias"] = (stored[key] for key in node.input[1:3])
    missing = [name for name in tower.load_state_dict(state, strict=False).missing_keys if "num_batches" not in name]
    assert not missing, missing
    return tower
