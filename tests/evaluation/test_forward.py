"""A prediction goes through ``evaluate`` forward: read, checked, scored, answered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from evaluated_text import scene
from house import PAGE, first_calls, page_with, prediction_trip, returns, stations
from painted import Painted
from places import SCENES
from prediction_files import write_scannet_text

from su3d_bench.evaluation.evaluate import Request, evaluate


def test_the_trip_of_a_prediction_never_climbs_back_and_is_the_one_on_the_page(tmp_path: Path) -> None:
    trip = prediction_trip(tmp_path)
    assert trip[0] == "evaluation/evaluate" and returns(trip) == []
    page = PAGE.read_text(encoding="utf-8")
    assert page_with({"prediction": stations(trip)}, page) == page, "the trip has changed; run: make architecture"


def test_masks_on_the_points_of_a_dataset_go_forward_too(tmp_path: Path) -> None:
    truth = Painted(tmp_path, Painted.Options()).ground_truth("a", "mesh-vertices")
    masks = [np.flatnonzero(truth.instance == instance) for instance in (1, 2, 3)]
    write_scannet_text(tmp_path / "pred", scene(masks, [20, 76, 80], name="a", n=len(truth.points)))
    protocols = ("rooms-instance", "rooms-semantic")
    request = Request((tmp_path / "pred",), f"{SCENES}/painted.py:Painted", protocols=protocols, scenes=("a",))
    evaluate(request)  # compiles what is compiled, which enters modules of its own
    assert returns(first_calls(lambda: evaluate(request))) == []


def test_a_step_that_climbs_back_is_found() -> None:
    assert returns(["evaluation/a", "metrics/b", "evaluation/c"]) == ["evaluation/c after metrics/b"]
    assert returns(["evaluation/a", "evaluation/b", "metrics/c", "formats/d", "metrics/e"]) == []
