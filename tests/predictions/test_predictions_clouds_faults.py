"""Hostile and damaged predictions with their own points: nothing is run, nothing runs away, each is one typed error."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_files import (
    a_map,
    write_map,
)
from prediction_files import refused


class Bomb:
    """What a hostile map holds: a call, hidden in an object's state."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


def fire(*_: object) -> None:
    raise AssertionError("the pickle ran code")


CALLS: list[tuple[Any, ...]] = [
    (os.system, "touch {}"),
    (eval, "open('{}', 'w')"),
    (exec, "open('{}', 'w')"),
    (getattr, os, "system"),
    (__import__, "os"),
    (open, "{}", "w"),
    (fire,),
    (np.load, "{}"),
    (np.fromfile, "{}"),
    (pickle.loads, b"."),
    (map, fire, [1]),
    (type, "x", (), {}),
]


@pytest.mark.parametrize("protocol", [2, 5])
@pytest.mark.parametrize("place", ["cfg", "mask", "pcd_np"])
@pytest.mark.parametrize("call", CALLS, ids=lambda call: getattr(call[0], "__name__", "call"))
def test_no_call_in_a_map_is_made(tmp_path: Path, call: tuple[Any, ...], place: str, protocol: int) -> None:
    proof = tmp_path / "proof"
    args = [one.format(proof) if isinstance(one, str) else one for one in call[1:]]
    if os in args:
        args = ["os", "system"]  # modules cannot be pickled
    value = a_map()
    holder = value if place in {"cfg", "class_names", "edges"} else value["objects"][0]
    holder[place] = Bomb(call[0], *args)
    path = write_map(tmp_path / "pcd_x.pkl.gz", value, protocol)
    assert "no plain data" in refused(path, "pcd_x", "conceptgraphs")
    assert not proof.exists()


# ---- damage


# Files of HDF5 have kilobytes of header; every tenth of their ends is enough.
