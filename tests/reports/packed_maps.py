"""Reads the packed maps of an HTML report, as the browser does."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np


def unpacked(content: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Unpack a map: its JSON header and its planes, including positions in metres."""
    data = zlib.decompress(base64.b64decode(content))
    length = int.from_bytes(data[:4], "little")
    about, at, planes = json.loads(data[4 : 4 + length]), 4 + length, {}
    n = about["n"]
    cells = np.zeros((1, 3), np.int64)
    for _ in range(about["depth"]):
        is_there = (np.frombuffer(data, np.uint8, len(cells), at)[:, None] >> np.arange(8)) & 1 == 1
        at += len(cells)
        of_cell, eighth = np.nonzero(is_there)
        cells = 2 * cells[of_cell] + np.stack([eighth & 1, eighth >> 1 & 1, eighth >> 2], axis=1)
    for plane in about["planes"]:
        columns = []
        for _ in range(plane["width"]):
            part = np.frombuffer(data, np.uint8, n * plane["bytes"], at).reshape(plane["bytes"], n).astype(np.int64)
            columns.append(part[0] + (256 * part[1] if plane["bytes"] == 2 else 0))
            at += n * plane["bytes"]
        planes[plane["name"]] = np.stack(columns, axis=1).squeeze()
    assert at == len(data)
    planes["position"] = np.array(about["origin"]) + (cells if n else cells[:0]) * about["step"]
    return about, planes
