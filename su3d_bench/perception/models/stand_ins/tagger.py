"""A tiny RAM++ with random weights, as the export of the published one: ``ram_plus.onnx`` beside its list of tags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.system.devices import require
from su3d_bench.perception.models.masks.tagging import RAM_PX, RAM_TAG_LIST

RAM_FILE = "ram_plus.onnx"
_CELL_PX = 96
_N_SEEN = 3 * (RAM_PX // _CELL_PX) ** 2  # mean colours of 4 x 4 cells
_OPSET, _IR_VERSION = 17, 8  # that any ONNX Runtime reads which the project takes


def write_tagger(folder: Path, tags: Sequence[str], seed: int = 0) -> Path:
    """A network that answers ``image`` (1, 3, 384, 384) with ``tag`` (1, T): 1 for some of ``tags``, by colours."""
    onnx = require("onnx", "a stand-in of RAM++")
    helper, numpy_helper, kinds = onnx.helper, onnx.numpy_helper, onnx.TensorProto
    random = np.random.default_rng(seed)
    weight = (random.normal(size=(_N_SEEN, len(tags))) / _N_SEEN**0.5).astype(np.float32)
    bias = (random.normal(size=len(tags)) * 0.5).astype(np.float32)
    nodes = [
        helper.make_node("AveragePool", ["image"], ["cells"], kernel_shape=[_CELL_PX] * 2, strides=[_CELL_PX] * 2),
        helper.make_node("Flatten", ["cells"], ["seen"]),
        helper.make_node("Gemm", ["seen", "weight", "bias"], ["logits"]),
        helper.make_node("Greater", ["logits", "zero"], ["is_there"]),
        helper.make_node("Cast", ["is_there"], ["tag"], to=kinds.FLOAT),
    ]
    constants = {"weight": weight, "bias": bias, "zero": np.zeros(1, np.float32)}
    graph = helper.make_graph(
        nodes,
        "ram_plus",
        [helper.make_tensor_value_info("image", kinds.FLOAT, [1, 3, RAM_PX, RAM_PX])],
        [helper.make_tensor_value_info("tag", kinds.FLOAT, [1, len(tags)])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    onnx.checker.check_model(model)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RAM_FILE).write_bytes(model.SerializeToString())
    (folder / RAM_TAG_LIST).write_text("\n".join(tags) + "\n")
    return folder
