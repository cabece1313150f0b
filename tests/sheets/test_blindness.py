"""Pictures of annotation sheets tell no method: outside of the answer they are those of a room without any map."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blindness import Drafts, all_checked, asked_alike, differs
from PIL import Image

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, UInt8Array
from su3d_bench.reports.pictures.items import ItemParts, png_bytes
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.drafts import Draft
from su3d_bench.sheets.drawing import Artist
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.sources import RunSource

METHODS = ("openmask3d", "sam3d", "conceptfusion")  # the last makes features without instances
SCENE = "rooms/bathroom0"
KINDS: tuple[SheetKind, ...] = ("retrieval", "annotation", "reasoning")
MOST = 4  # things of each kind
RUN = (
    "--profile oracle --protocols rooms-instance --stride 50 --jobs 1 --no-pictures --quiet --set rooms.width=120 "
    "rooms.height=90 rooms.n_frames=200 rooms.mesh_spacing_m=0.03"
)


@dataclass
class Seen:
    """What all methods show, of each kind."""

    source: RunSource
    drafts: dict[str, Drafts] = field(default_factory=dict)


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


@pytest.fixture(scope="module")
def seen(run: Path) -> Seen:
    source = RunSource(read_run(run))
    encoder = source.run.encoder("cpu")
    return Seen(source, {kind: asked_alike(source, encoder, kind, 1, MOST) for kind in KINDS})


@pytest.mark.proof
def test_outside_of_the_answer_every_pixel_is_that_of_a_picture_without_a_map(seen: Seen) -> None:
    artist, astray = Artist(seen.source), dict[tuple[str, str], int]()

    def check(draft: Draft, picture: UInt8Array, blank: UInt8Array, zone: BoolArray) -> None:
        files = [png_bytes(one, palette=artist.room(draft.scene).palette) for one in (picture, blank)]
        shown, plain = (np.asarray(Image.open(io.BytesIO(one))) for one in files)
        n = int((differs(picture, blank) & ~zone).sum()) + int(((shown != plain) & ~zone).sum())
        astray[draft.kind, draft.methods[0]] = astray.get((draft.kind, draft.methods[0]), 0) + n

    for drafts in seen.drafts.values():
        all_checked(artist, drafts, check)
    assert {kind for kind, _ in astray} == set(KINDS) and len(astray) >= 5
    assert set(astray.values()) == {0}


class OwnMap(Artist):
    """Draws the whole map of the method that is judged into the room, as pictures once did."""

    def parts(self, draft: Draft) -> ItemParts:
        parts, room = super().parts(draft), self.room(draft.scene)
        instances = self._source.instances(draft.scene, draft.methods[0])
        view = parts.room_view.picture.copy()
        corner = next(one for one in room.corners if one.shown.point.shape[0] // 2 == len(view))
        for row in range(len(instances)):
            shade = [(37 * row) % 256, (91 * row) % 256, (153 * row) % 256]
            view[corner.shows(room.region(instances.points[instances.mask(row)]).is_member)] = shade
        return replace(parts, room_view=replace(parts.room_view, picture=view))


@pytest.mark.proof
def test_a_map_that_is_drawn_is_found(seen: Seen) -> None:
    artist = OwnMap(seen.source)
    shown = list(seen.drafts["retrieval"].items())[:3]
    drafts = {thing: {"openmask3d": of_method["openmask3d"]} for thing, of_method in shown}
    n_astray: list[int] = []

    def check(draft: Draft, picture: UInt8Array, blank: UInt8Array, zone: BoolArray) -> None:
        n_astray.append(int((differs(picture, blank) & ~zone).sum()))

    all_checked(artist, drafts, check)
    assert min(n_astray) > 1000


@pytest.mark.proof
def test_an_instance_looks_the_same_however_dense_and_complete_its_map_is(seen: Seen) -> None:
    scene = SCENE
    whole = seen.source.instances(scene, "openmask3d")
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
    draft = next(iter(seen.drafts["annotation"].values()))["openmask3d"]

    @dataclass(frozen=True)
    class Shown:
        a_map: Instances
        opener: Any = None

        def instances(self, scene: str, method: str) -> Instances:
            return self.a_map

        def frames(self, scene: str) -> Any:
            return seen.source.frames(scene)

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
