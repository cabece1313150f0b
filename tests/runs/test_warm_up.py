"""Before the clock runs, a scratch of a method that asks for it is fed a made-up frame."""

from __future__ import annotations

import pytest

from su3d_bench.core import registry
from su3d_bench.core.interfaces import TakesTools, WarmsUp
from su3d_bench.runs.frame_loop import warm_up

WARMED = [name for name in registry.METHODS if isinstance(registry.load("method", name), WarmsUp)]


@pytest.mark.parametrize("name", WARMED)
def test_a_made_up_frame_goes_through_every_step(name: str) -> None:
    # Keeps the map. A class of its own: what ``isinstance`` has said of the method's own class would be remembered.
    method = type("Kept", (registry.load("method", name),), {"close": lambda self: None})()
    warm_up(method)
    assert method.n_points > 0
    assert not isinstance(method, TakesTools) or vars(method)["_tools"] is None
