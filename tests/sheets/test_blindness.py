"""Pictures of annotation sheets tell no method: of a map they show what is judged, and of questions nothing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.drafts import annotation_drafts
from su3d_bench.sheets.drawing import Artist
from su3d_bench.sheets.sources import RunSource

METHODS = ("openmask3d", "sam3d", "conceptfusion")  # the last makes features without instances
SCENE = "rooms/bathroom0"
RUN = (
    "--profile oracle --protocols rooms-instance --stride 50 --jobs 1 --no-pictures --quiet --set rooms.width=120 "
    "rooms.height=90 rooms.n_frames=200 rooms.mesh_spacing_m=0.03"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run of methods of three sorts on a small room."""
    path = tmp_path_factory.mktemp("blind")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(path / "data"))
        patch.setenv("SU3D_CACHE", str(path / "cache"))
        words = ["run", "--scenes", SCENE, "--methods", *METHODS, *RUN.split()]
        assert main([*words, "--out", str(path / "run")]) == 0
        yield path / "run"


def test_an_instance_looks_the_same_however_dense_and_complete_its_map_is(run: Path) -> None:
    scene, source = SCENE, RunSource(read_run(run), METHODS[:2])
    whole = source.instances(scene, "openmask3d")
    row = int(np.argsort(whole.sizes)[len(whole) // 2])
    mask, random = whole.mask(row), np.random.default_rng(0)
    own = whole.points[mask]
    near = random.normal(0, 0.04, own.shape).astype(np.float32) + own  # what another map has beside it
    alone = Instances.of(own[random.permutation(len(own))], [np.ones(len(own), bool)], names=("x",), ids=[9])
    twice = np.concatenate([own, near, own])
    members = np.zeros((2, len(twice)), bool)
    members[0, : len(own)] = members[0, -len(own) :] = True
    members[1] = ~members[0]
    dense = Instances.of(twice, list(members), names=("y", "z"), ids=[700, 3])
    drafts = annotation_drafts(source, scene, 4, np.random.default_rng(0))
    draft = next(one for one in drafts if one.methods[0] == "openmask3d")

    @dataclass(frozen=True)
    class Shown:
        a_map: Instances
        opener: Any = None

        def instances(self, scene: str, method: str) -> Instances:
            return self.a_map

        def frames(self, scene: str) -> Any:
            return source.frames(scene)

    drawn = {
        Artist(Shown(one)).draw(replace(draft, scene=scene, rows=(k,)))
        for one, k in ((whole, row), (alone, 0), (dense, 0))
    }
    assert len(drawn) == 1


def test_sheets_of_questions_come_out_the_same_without_any_map(run: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare" / run.name
    shutil.copytree(run, bare, ignore=shutil.ignore_patterns("prediction*", ".cache"))
    assert list(run.rglob("prediction*")) and not list(bare.rglob("prediction*"))
    words = ["--kind", "questions", "--per-kind", "1", "--jobs", "1", "--scenes", SCENE, "--quiet"]
    made = []
    for folder in (run, bare):
        out = tmp_path / ("of-run" if folder == run else "of-bare")
        assert main(["sheets", "make", str(folder), *words, "--out", str(out)]) == 0
        made.append({str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()})
    assert made[0].keys() == made[1].keys() and len(made[0]) > 10
    different = [name for name in made[0] if made[0][name] != made[1][name]]
    assert different == []
    shown = b"".join(content for name, content in made[0].items() if name.endswith((".json", ".csv")))
    assert not [method for method in METHODS if method.encode() in shown]
