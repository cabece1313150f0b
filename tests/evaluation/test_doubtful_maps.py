"""Maps that score too low for a reason that only a warning can tell; the same warnings in runs and evaluations."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluated_text import CHAIR, TABLE, numbers, scene, write_truth
from prediction_files import write_scannet_text

import su3d_bench as su3d
from su3d_bench.cli.main import main
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.scoring import score_located

RULES = su3d.load_protocol("rooms-instance")
NAMES = [entry.name for entry in RULES.scored[:3]]
SETS = np.split(np.arange(600), 3)
POINTS = np.random.default_rng(0).uniform(0, [2, 5, 3], (600, 3)).astype(np.float32)
POINTS[:, 0] += np.repeat([0, 2, 4], 200)
LABELS = LabelSet("replica", (*(entry.id for entry in RULES.scored[:3]), 999), (*NAMES, "left out"))
TRUTH = GroundTruth(
    POINTS,
    np.repeat([entry.id for entry in RULES.scored[:3]], 200).astype(np.int32),
    np.repeat([1, 2, 3], 200).astype(np.int32),
    LABELS,
    RULES.ground_truth,
    "by hand",
)
SCORES = [0.9, 0.8, 0.7]
MAP = Instances.of(POINTS, SETS, SCORES, labels=NAMES)
SHUFFLED = np.random.default_rng(1).permutation(600)
LOW = "less than half of the scored points have a predicted point within 10 cm: "
TURNED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.float32)


def with_points(points: Any) -> Instances:
    return Instances.of(points.astype(np.float32), SETS, SCORES, labels=NAMES)


def warnings_of(prediction: Instances) -> tuple[str, ...]:
    return score_located(RULES, TRUTH, prediction, None).warnings


@pytest.mark.parametrize(
    ("prediction", "line"),
    [
        (MAP, None),
        (with_points(POINTS + 0.005), None),
        (with_points(np.concatenate([POINTS[:-1], [[9000, 0, 0]]])), None),  # a stray point
        (replace(MAP, labels=(*NAMES[:2], "left out")), None),  # a class that the protocol leaves out
        (replace(MAP, labels=tuple(name.upper() for name in NAMES)),
         f"3 of 3 labels are not classes of the protocol, such as {NAMES[0].upper()!r}; did you mean {NAMES[0]!r}?"),
        (replace(MAP, labels=(f"{NAMES[0]} ", *NAMES[1:])),
         f"1 of 3 labels are not classes of the protocol, such as '{NAMES[0]} '; did you mean {NAMES[0]!r}?"),
        (Instances.of(POINTS, [], labels=()), "the prediction is empty"),
        (Instances.of(POINTS[:0], [], labels=()), "the prediction is empty"),
        (Instances.of(POINTS, [[], *SETS[1:]], SCORES, labels=NAMES), "1 empty mask, the first is mask 0"),
        (replace(MAP, scores=np.array([-0.9, 0.8, 0.7])), "1 of 3 confidences are negative or above 1 (-0.9 to 0.8): "),
        (replace(MAP, scores=np.array([90.0, 80, 70])), "3 of 3 confidences are negative or above 1 (70 to 90): "),
        (replace(MAP, scores=np.array([1 + 1e-7, 0.8, 0.7])), None),
        (Instances.of(POINTS, [np.sort(SHUFFLED[k::9]) for k in range(3)], SCORES, labels=NAMES),
         "no mask reaches IoU 0.25 with any object: "),
        (with_points(POINTS / 2), f"{LOW}is it of another scene, "),
        (with_points(POINTS @ TURNED), f"{LOW}is it of another scene, "),
        (with_points(POINTS + 2.5), f"{LOW}is it of another scene, "),
        (Instances.of(POINTS[:200], SETS[:1], labels=NAMES[:1]), f"{LOW}the map is incomplete"),
    ],
)  # fmt: skip
def test_doubtful_map_has_one_warning_and_a_good_one_none(prediction: Instances, line: str | None) -> None:
    found = warnings_of(prediction)
    assert len(found) == (line is not None), found
    assert line is None or found[0].startswith(line)


@pytest.mark.parametrize(("factor", "unit"), [(1000, "millimetres"), (100, "centimetres"), (0.001, "kilometres")])
def test_map_in_other_units_is_refused(factor: float, unit: str) -> None:
    with pytest.raises(PredictionError, match=rf"the cloud spans .* m: {unit}\? coordinates must be metres"):
        warnings_of(with_points(POINTS * factor))


def test_class_agnostic_protocols_accept_any_label_and_partitions_can_be_empty() -> None:
    free = RULES.model_copy(update={"class_agnostic": "scored"})
    assert not score_located(free, TRUTH, replace(MAP, labels=("a", "b", "c")), None).warnings
    for points in (POINTS[:0], POINTS):
        nothing = Partition(points, np.full(len(points), -1, np.int32), np.zeros((int(not len(points)), 4), np.float32))
        (line,) = score_located(free, TRUTH, nothing, None).warnings
        assert line.startswith("the prediction is empty")


# ---- masks on vertices


@pytest.mark.parametrize(
    ("masks", "scores", "line"),
    [
        ([CHAIR, TABLE], [0.9, 0.8], None),
        ([], [], "scene0001_00: the prediction is empty"),
        ([CHAIR, TABLE], [-0.9, 0.8], "scene0001_00: 1 of 2 confidences are negative or above 1 (-0.9 to 0.8): "),
        ([np.arange(0, 600, 3), np.arange(1, 600, 3)], [0.9, 0.8], "scene0001_00: no mask reaches IoU 0.25 with any"),
    ],
)
def test_masks_on_vertices_have_the_same_warnings(
    tmp_path: Path, masks: list[Any], scores: list[float], line: str | None
) -> None:
    write_truth(tmp_path / "gt")
    write_scannet_text(tmp_path / "pred", scene(masks, [5, 7][: len(masks)], scores))
    found = numbers(tmp_path)["warnings"]
    assert len(found) == (line is not None), found
    assert line is None or found[0].startswith(line)


def test_scene_without_a_file_is_only_called_missed(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0001_01"):
        write_truth(tmp_path / "gt", name)
    write_scannet_text(tmp_path / "pred", scene([CHAIR, TABLE], [5, 7], [0.9, 0.8]))
    for protocol in ("scannet-instance", "scannet-panoptic"):  # in the second it counts as missed
        assert sum("scene0001_01" in line for line in numbers(tmp_path, protocol)["warnings"]) == 1


# ---- a run and an evaluation, in every output

METHOD = """
from dataclasses import replace

from pydantic import BaseModel

from su3d_bench.baselines.oracle import Oracle


class Mangled(Oracle):
    name = "mangled"

    class Config(BaseModel):
        fault: str = ""

    def finish(self):
        found = super().finish()
        if self.config.fault == "case":
            return replace(found, labels=tuple(map(str.upper, found.labels)))
        return replace(found, points=found.points * 1000)
"""
RUN = ["run", "--scenes", "rooms/bathroom0", "--methods", "mangled.py:Mangled", "--protocols", "rooms-instance"]
MAPS = "run/scenes/rooms.bathroom0/mangled"
FOREIGN = "labels are not classes of the protocol, such as '"


def test_warning_is_once_in_text_json_page_and_python_of_a_run_and_an_evaluation(
    tmp_path: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    Path("mangled.py").write_text(METHOD)
    shown = []
    assert main([*RUN, "--set", "mangled.fault=case", "--no-pictures", "--jobs", "1", "--out", "run"]) == 0
    shown.append(capsys.readouterr().out)
    assert main(["evaluate", MAPS, "--protocols", "rooms-instance", "--out", "again", "--json", "numbers.json"]) == 0
    shown.append(capsys.readouterr().out)
    shown += [Path(name).read_text() for name in ("run/metrics.json", "again/metrics.json", "numbers.json")]
    for run in ("run", "again"):
        assert main(["report", "html", run, "--out", f"{run}.html", "--quiet"]) == 0
        shown += [Path(f"{run}.html").read_text(), "\n".join(su3d.load_run(run).remarks)]
    shown.append("\n".join(su3d.evaluate(MAPS, protocols="rooms-instance").remarks))
    assert [text.count(FOREIGN) for text in shown] == [1] * len(shown)
    for line in json.loads(shown[2])["results"][0]["result"]["warnings"]:
        assert any(line.partition(": ")[2] in remark for remark in su3d.load_run("run").remarks)

    assert main([*RUN, "--set", "mangled.fault=units", "--no-pictures", "--jobs", "1", "--out", "units"]) == 3
    assert "rooms/bathroom0: the cloud spans " in capsys.readouterr().err
