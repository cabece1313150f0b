"""Bad input in real files: rooms written in Replica's layout, one scene damaged, the run started as by a user."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from su3d_bench.cli.main import main

MAKE = "datasets make rooms --layout replica --scenes bathroom0 office0 --jobs 1 --quiet"
SMALL = ["--set", "n_frames=4", "--set", "width=160", "--set", "height=120", "--set", "mesh_spacing_m=0.08"]
RUN = "run --scenes replica/* --stride 2 --jobs 1 --protocols rooms-semantic --no-pictures"
Damage = Callable[[Path], Any]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small rooms on disk."""
    root = tmp_path_factory.mktemp("whole")
    assert main([*MAKE.split(), *SMALL, "--out", str(root)]) == 0
    return root


@pytest.fixture(scope="module")
def clean_scene(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    """The scores of the scene that is never damaged."""
    out = tmp_path_factory.mktemp("clean")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(whole))
        patch.setenv("SU3D_CACHE", str(tmp_path_factory.mktemp("cache")))
        assert main([*RUN.split(), "--out", str(out), "--quiet"]) == 0
    return scores_of_office(out)


@pytest.fixture
def root(whole: Path, data_to_spoil: Callable[[Path], Path]) -> Path:
    """A copy of the rooms that a test may damage."""
    return data_to_spoil(whole)


def scores_of_office(out: Path) -> dict[str, float]:
    result = json.loads((out / "metrics.json").read_text())["results"][0]["result"]
    scores: dict[str, float] = result["per_scene"]["replica/office0"]
    return scores


def remarks_of(err: str) -> list[str]:
    """The lines on stderr, without finished scenes, and that four frames far apart could not be checked."""
    others = (": poses and depth could not be checked: ", " finished, ")
    return [line for line in err.splitlines() if not any(text in line for text in others)]


def remove(name: str) -> Damage:
    return lambda root: (root / name).unlink()


def pose(text: str) -> Damage:
    def damage(root: Path) -> None:
        path = root / "Replica" / "bathroom0" / "traj.txt"
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:2], text, *lines[3:]]) + "\n")

    return damage


def edit_json(name: str, change: Callable[[Any], Any]) -> Damage:
    def damage(root: Path) -> None:
        value = json.loads((root / name).read_text())
        change(value)
        (root / name).write_text(json.dumps(value))

    return damage


INFO = "replica_v1/bathroom_0/habitat/info_semantic.json"


@pytest.mark.parametrize(
    ("damage", "line"),
    [
        (remove("Replica/bathroom0/results/frame000002.jpg"), "results/frame000002.jpg is missing; copy results/"),
        (pose("nan " * 16), "traj.txt line 3: the pose has 'nan'; fix the trajectory or exclude the scene"),
    ],
)  # fmt: skip
def test_damaged_scene_is_a_one_line_error_and_does_not_affect_others(
    damage: Damage, line: str, root: Path, clean_scene: dict[str, float], capsys: pytest.CaptureFixture[str]
) -> None:
    damage(root)
    assert main([*RUN.split(), "--out", "out", "--quiet"]) == 3
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert errors[0].startswith(f"su3d-bench: replica/bathroom0: {line}")
    assert errors[1].startswith("su3d-bench: incomplete: 1 of 2 scenes failed; see out/scenes/replica.bathroom0/")
    assert scores_of_office(Path("out")) == clean_scene


@pytest.mark.parametrize(
    ("damage", "line"),
    [
        (
            edit_json(INFO, lambda info: info["objects"][3].update(class_id=777)),
            "objects with an unknown class id in habitat/info_semantic.json: 1 (the first: object 4, class 777;",
        ),
        (
            edit_json(INFO, lambda info: info["objects"].pop(3)),
            "object ids without entry in habitat/info_semantic.json: 1 (the first: 4); faces made void: ",
        ),
    ],
)
def test_unknown_annotations_become_void_with_a_one_line_warning(
    damage: Damage, line: str, root: Path, clean_scene: dict[str, float], capsys: pytest.CaptureFixture[str]
) -> None:
    damage(root)
    for _ in range(2):  # a resumed run repeats the warning
        assert main([*RUN.split(), "--out", "out"]) == 0
        remarks = remarks_of(capsys.readouterr().err)
        assert all(" su3d-bench " in line for line in remarks[2:])
        assert remarks[0].startswith(f"replica/bathroom0: {line}")
        assert remarks[1] == "run folder: out"
    assert scores_of_office(Path("out")) == clean_scene


def test_missing_ground_truth_leaves_the_scene_unscored(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "replica_v1" / "bathroom_0" / "habitat" / "mesh_semantic.ply").unlink()
    assert main([*RUN.split(), "--out", "out"]) == 0
    answer = capsys.readouterr()
    assert "- opensu3d is not scored on replica/bathroom0" in answer.out
    assert "| replica/bathroom0 | opensu3d | 14 " in answer.out.partition("**Maps without scores**")[2]
    remark = remarks_of(answer.err)[0]
    assert remark.startswith("opensu3d, oracle: not scored under rooms-semantic: replica/bathroom0: no")
