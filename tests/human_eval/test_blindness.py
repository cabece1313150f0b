"""Pictures of annotation sheets do not reveal the method: outside the answer they show the room without any map."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import UInt8Array
from su3d_bench.human_eval import drafts
from su3d_bench.human_eval.drawing import PLACE_SHARE, ROOM_SHARE, Artist
from su3d_bench.human_eval.items import SheetKind
from su3d_bench.human_eval.sources import RunSource
from su3d_bench.questions.solver import built_in
from su3d_bench.reports.pictures.canvas import OVERSAMPLING, colour
from su3d_bench.reports.pictures.items import ItemParts, compose, jpeg_bytes
from su3d_bench.reports.pictures.maps import pale
from su3d_bench.runs.finished import read_run

METHODS = ("openmask3d", "sam3d", "conceptfusion")  # the last computes features without instances
SCENE = "rooms/bathroom0"
KINDS: tuple[SheetKind, ...] = ("retrieval", "annotation", "reasoning")
RUN = (
    "--profile oracle --protocols rooms-instance --stride 50 --jobs 1 --no-pictures --quiet --set rooms.width=120 "
    "rooms.height=90 rooms.n_frames=200 rooms.mesh_spacing_m=0.03"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run of three kinds of methods on a small room."""
    path = tmp_path_factory.mktemp("blind")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(path / "data"))
        patch.setenv("SU3D_CACHE", str(path / "cache"))
        words = ["run", "--scenes", SCENE, "--methods", *METHODS, *RUN.split()]
        assert main([*words, "--out", str(path / "run")]) == 0
        yield path / "run"


@pytest.fixture(scope="module")
def source(run: Path) -> RunSource:
    return RunSource(read_run(run))


def drafts_of(source: RunSource, kind: SheetKind) -> Sequence[drafts.Draft]:
    """Items of every method that a kind of sheet can judge."""
    is_able = source.has_features if kind == "retrieval" else source.has_instances
    source = source.of_methods([method for method in source.methods if is_able(SCENE, method)])
    encoder = source.run.encoder("cpu")
    if kind == "retrieval":
        questions = drafts.questions_of(source, SCENE, None, 1)
        return drafts.retrieval_drafts(source, SCENE, questions, encoder)
    if kind == "reasoning":
        return drafts.reasoning_drafts(source, SCENE, None, 1, built_in(encoder))
    return drafts.annotation_drafts(source, SCENE, 6, np.random.default_rng(0))


def n_astray(artist: Artist, draft: drafts.Draft) -> int:
    """Number of pixels of an item's views, outside the answer, that differ from those of the room alone."""
    parts, room = artist.parts(draft), artist.room(draft.scene)
    photo = parts.photo
    assert photo is None or any(np.array_equal(photo.picture, frame.rgb) for frame in room.frames)
    answer = room.union([artist._region(draft, row) for row in draft.rows]).is_member
    other = room.union([artist._region(draft, row) for row in draft.others]).is_member
    corner = next(view for view in room.corners if np.array_equal(view.shows(answer), np.asarray(parts.room_view.mask)))
    n = 0
    for panel, view, share in ((parts.room_view, corner, ROOM_SHARE), (parts.place, room.above, PLACE_SHARE)):
        is_other = differs(panel.picture, colour(view.shown, pale(room.colours, share)))
        height, width = is_other.shape
        points = np.append(answer | other, False)[view.shown.point]
        blocks = points.reshape(height, OVERSAMPLING, width, OVERSAMPLING)
        n += int((is_other & ~blocks.any(axis=(1, 3))).sum())
    return n


def differs(picture: UInt8Array, other: UInt8Array) -> Any:
    """Where (h, w) any channel of two pictures differs."""
    return (picture != other).any(axis=2)


@pytest.mark.proof
def test_views_outside_the_answer_show_only_the_room(source: RunSource) -> None:
    artist = Artist(source)
    every = [draft for kind in KINDS for draft in drafts_of(source, kind)]
    assert {draft.kind for draft in every} == set(KINDS)
    assert len({(draft.kind, method) for draft in every for method in draft.methods}) >= 5
    assert {n_astray(artist, draft) for draft in every} == {0}
    # and so do files: a block of 8 x 8 pixels of a file only depends on the same block of the picture
    picture = compose(artist.parts(every[0]))
    changed = picture.copy()
    changed[104:200, 104:200] = (255, 0, 0)
    files = map(jpeg_bytes, (picture, changed))
    shown, other = (np.asarray(Image.open(io.BytesIO(file)).convert("RGB")) for file in files)
    assert not (differs(shown, other) & ~differs(picture, changed)).any() and differs(shown, other).any()


class OwnMap(Artist):
    """Draws the complete map of the judged method into the room, as pictures once did."""

    def parts(self, draft: drafts.Draft) -> ItemParts:
        parts, room = super().parts(draft), self.room(draft.scene)
        instances = self._source.instances(draft.scene, draft.methods[0])
        view = parts.room_view.picture.copy()
        corner = next(one for one in room.corners if one.shown.point.shape[0] // 2 == len(view))
        for row in range(len(instances)):
            shade = [(37 * row) % 256, (91 * row) % 256, (153 * row) % 256]
            view[corner.shows(room.region(instances.points[instances.mask(row)]).is_member)] = shade
        return replace(parts, room_view=replace(parts.room_view, picture=view))


@pytest.mark.proof
def test_blindness_check_detects_a_drawn_map(source: RunSource) -> None:
    of_method = [draft for draft in drafts_of(source, "retrieval") if draft.methods[0] == "openmask3d"]
    assert min(n_astray(OwnMap(source), draft) for draft in of_method[:3]) > 1000


@pytest.mark.proof
def test_picture_is_independent_of_map_density_and_completeness(source: RunSource) -> None:
    whole = source.instances(SCENE, "openmask3d")
    row = int(np.argsort(whole.sizes)[len(whole) // 2])
    mask, random = whole.mask(row), np.random.default_rng(0)
    own = whole.points[mask]
    near = random.normal(0, 0.04, own.shape).astype(np.float32) + own  # as in a noisier map
    alone = Instances.of(own[random.permutation(len(own))], [np.ones(len(own), bool)], names=("x",), ids=[9])
    twice = np.concatenate([own, near, own])
    members = np.zeros((2, len(twice)), bool)
    members[0, : len(own)] = members[0, -len(own) :] = True
    members[1] = ~members[0]
    dense = Instances.of(twice, list(members), names=("y", "z"), ids=[700, 3])
    draft = next(one for one in drafts_of(source, "annotation") if one.methods[0] == "openmask3d")
    drawn = set()
    for a_map, k in ((whole, row), (alone, 0), (dense, 0)):
        shown: Any = SimpleNamespace(instances=lambda *_, a_map=a_map: a_map, frames=source.frames)
        drawn.add(Artist(shown).draw(replace(draft, rows=(k,))))
    assert len(drawn) == 1
