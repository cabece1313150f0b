"""A small scene of labelled vertices, its masks and texts as files, and the output of ``evaluate`` for them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from prediction_files import write_openmask3d

from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request

N = 600
CHAIR, TABLE = np.arange(200), np.arange(200, 400)  # the objects of the small scene; the other points are void
TRUTH = np.repeat([5001, 7002, 1003], 200)


def write_truth(folder: Path, name: str = "scene0001_00", values: Any = TRUTH) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.txt").write_text("".join(f"{value}\n" for value in values))


def scene(
    masks: list[Any], labels: list[int], scores: list[float] | None = None, name: str = "scene0001_00", n: int = N
) -> dict[str, Any]:
    full = np.zeros((len(masks), n), bool)
    for row, members in zip(full, masks, strict=True):
        row[members] = True
    return {
        "name": name,
        "masks": full,
        "labels": np.array(labels),
        "scores": np.array(scores or [1.0] * len(masks)),
        "files": [f"masks/{name}_{k}.txt" for k in range(len(masks))],
    }


def document(folder: Path, protocol: str | None = "scannet-instance", **more: Any) -> dict[str, Any]:
    """The JSON value of ``pred`` against ``gt`` in ``folder``."""
    protocols = () if protocol is None else (protocol,)
    request = Request((folder / "pred",), ground_truth=folder / "gt", protocols=protocols, **more)
    value: dict[str, Any] = json.loads(json.dumps(evaluate(request).to_json(), allow_nan=False))
    return value


def numbers(folder: Path, protocol: str = "scannet-instance", **more: Any) -> dict[str, Any]:
    found: dict[str, Any] = document(folder, protocol, **more)["protocols"][protocol]
    return found


def printed(found: dict[str, Any], beginning: str) -> str:
    """The only warning with this beginning."""
    (line,) = [line for line in found["warnings"] if line.startswith(beginning)]
    return str(line)


def feature_scene(folder: Path) -> None:
    """OpenMask3D's files of two masks, the first like a chair, the second like a table; none for the third."""
    write_truth(folder / "gt")
    features = np.zeros((3, 16))
    features[0, 3], features[1, 9] = 2.0, 5.0
    write_openmask3d(folder / "pred", scene([CHAIR, TABLE, np.arange(150)], [0, 0, 0]), features)


def write_texts(path: Path, names: list[str], of: dict[str, int], **more: Any) -> None:
    features = np.full((len(names), 16), 0.01, np.float32)
    for name, column in of.items():
        features[names.index(name), column] = 1.0
    np.savez(path, names=np.array(names), features=features, **more)
