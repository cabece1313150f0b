"""Cosines on a torch device, in float64; imported only where an encoder runs on one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from su3d_bench.core.types import Float64Array, Int64Array

# Sums of 4096 products of unit vectors differ between two orders by less than 1e-12; 1e-9 leaves room.
SURE_GAP = 1e-9


def directions_on(device: str, rows: NDArray[Any]) -> Tensor:
    """``rows`` (N, D) at length 1 on ``device``; those of no direction, or that hold what is no number, are 0."""
    there = torch.from_numpy(np.require(rows, requirements=["C", "W"])).to(device).double()
    there = torch.where(there.isfinite().all(dim=1, keepdim=True), there, 0.0)
    length = (there * there).sum(dim=1, keepdim=True).sqrt()
    return there / torch.where(length > 0, length, 1.0)


def cosines(features: Tensor, text: Tensor) -> Float64Array:
    """The cosine (K, C) of each direction of ``features`` with each of ``text``."""
    return np.asarray((features @ text.T).cpu().numpy(), np.float64)


def sure_most_similar(features: Tensor, text: Tensor) -> Int64Array | None:
    """For each direction of ``features`` (K, D) that of ``text`` (C, D) of highest cosine; row 0 where it is 0.

    None where the two highest of a row are so near that another order of the sums might choose the other.
    """
    n_highest = min(2, len(text))
    highest, index = (features @ text.T).topk(n_highest, dim=1)
    has_none = (features == 0).all(dim=1)
    if n_highest == 2 and bool((~has_none & (highest[:, 0] - highest[:, 1] < SURE_GAP)).any()):
        return None
    return np.asarray(torch.where(has_none, 0, index[:, 0]).cpu().numpy(), np.int64)
