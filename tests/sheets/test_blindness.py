"""Pictures of annotation sheets tell no method: held exactly, and put before a classifier, over all methods.

Every pair of the eight methods is held in every kind in which both have something to show. Two make features without
instances: they are asked for texts, and have neither labels and masks nor objects to reason about, which is held too.
Sheets of questions show the truth: they come out the same where no method has left a map.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blindness import (
    ALPHA,
    Drafts,
    Look,
    Looks,
    all_looks,
    asked_alike,
    differs,
    methods_in,
    p_of_telling,
    pairs_of,
    told_apart,
)
from PIL import Image

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, UInt8Array
from su3d_bench.reports.pictures.items import ItemParts, png_bytes
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.items import read_key
from su3d_bench.sheets.making.drafts import Draft
from su3d_bench.sheets.making.drawing import Artist
from su3d_bench.sheets.making.run_source import RunSource

WITH_INSTANCES = (
    "opensu3d", "conceptgraphs", "conceptgraphs-detector", "openmask3d", "openmask3d-segment3d", "sam3d",
)  # fmt: skip
FEATURES_ALONE = ("conceptfusion", "conceptfusion-sam")
SCENES = ("rooms/bathroom0", "rooms/office0")
KINDS = ("retrieval", "annotation", "reasoning")
PER_KIND = {"retrieval": 3, "annotation": 1, "reasoning": 1}
MOST = 12  # things a scene
N_PAIRS = {"retrieval": 28, "annotation": 15, "reasoning": 15}  # of methods: of eight, of six
PNGS = 10  # every so many pictures the files are compared too
RUN = (
    "--profile oracle --protocols rooms-instance --stride 25 --jobs 1 --no-pictures --quiet --set rooms.width=120 "
    "rooms.height=90 rooms.n_frames=200 rooms.mesh_spacing_m=0.03 "
    # In so short a walk most things are seen twice at most: of what ConceptGraphs asks for three times it keeps few.
    "conceptgraphs.obj_min_detections=1 conceptgraphs-detector.obj_min_detections=1"
)


@dataclass
class Seen:
    """What all methods show, of each kind, and how far any picture leaves the one in which no map has a part."""

    source: RunSource
    drafts: dict[str, Drafts] = field(default_factory=dict)
    looks: dict[str, Looks] = field(default_factory=dict)
    n_pictures: int = 0
    n_astray: list[tuple[str, str, int]] = field(default_factory=list)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run of all eight methods on two small rooms."""
    path = tmp_path_factory.mktemp("blind")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(path / "data"))
        patch.setenv("SU3D_CACHE", str(path / "cache"))
        words = ["run", "--scenes", *SCENES, "--methods", *WITH_INSTANCES, *FEATURES_ALONE, *RUN.split()]
        assert main([*words, "--out", str(path / "run")]) == 0
        yield path / "run"


@pytest.fixture(scope="module")
def seen(run: Path) -> Seen:
    source = RunSource(read_run(run))
    artist, all_seen = Artist(source), Seen(source)

    def check(draft: Draft, picture: UInt8Array, blank: UInt8Array, zone: BoolArray) -> None:
        astray = int((differs(picture, blank) & ~zone).sum())
        all_seen.n_pictures += 1
        if all_seen.n_pictures % PNGS == 0:
            files = [png_bytes(one, palette=artist.room(draft.scene).palette) for one in (picture, blank)]
            shown, plain = (np.asarray(Image.open(io.BytesIO(one))) for one in files)
            astray += int(((shown != plain) & ~zone).sum())
        if astray:
            all_seen.n_astray.append((draft.kind, draft.methods[0], astray))

    for kind in KINDS:
        all_seen.drafts[kind] = asked_alike(source, source.run.encoder("cpu"), kind, PER_KIND[kind], MOST)  # type: ignore[arg-type]
        all_seen.looks[kind] = all_looks(artist, all_seen.drafts[kind], check)
    return all_seen


def test_outside_of_the_answer_every_pixel_is_that_of_a_picture_without_a_map(seen: Seen) -> None:
    assert seen.n_pictures > 150
    assert seen.n_astray == []


def test_a_classifier_tells_no_two_methods_apart_outside_of_the_answer(seen: Seen) -> None:
    for kind, methods in ((kind, methods_in(seen.looks[kind])) for kind in KINDS):
        assert methods == sorted(WITH_INSTANCES if kind != "retrieval" else WITH_INSTANCES + FEATURES_ALONE)
        for one, other in combinations(methods, 2):
            assert len(pairs_of(seen.looks[kind], one, other)) >= 20, (kind, one, other)
    found = told_apart(seen.looks)
    assert {kind: sum(of == kind for of, *_ in found) for kind in KINDS} == N_PAIRS
    told = {name: p for name, p in found.items() if p is not None and p < ALPHA}
    assert told == {}


def _bordered(look: Look) -> Look:
    picture = look.picture.copy()
    picture[:1] = picture[-1:] = 60
    return replace(look, picture=picture)


def _shifted(look: Look) -> Look:
    return replace(look, picture=np.clip(look.picture.astype(int) + np.array([0, 0, 6]), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("plant", [_bordered, _shifted])
@pytest.mark.parametrize("kind", KINDS)
def test_the_classifier_finds_what_is_planted_into_the_pictures_of_one_method(
    seen: Seen, kind: str, plant: Any
) -> None:
    pairs = pairs_of(seen.looks[kind], "openmask3d", "sam3d")
    p = p_of_telling([(scene, one, plant(other)) for scene, one, other in pairs])
    assert p is not None and p * sum(N_PAIRS.values()) < ALPHA  # whatever Holm's correction makes of the others


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


def test_a_map_that_is_drawn_is_found(seen: Seen) -> None:
    artist = OwnMap(seen.source)
    shown = list(seen.drafts["retrieval"].items())[:3]
    drafts = {thing: {"openmask3d": of_method["openmask3d"]} for thing, of_method in shown}
    n_astray: list[int] = []

    def check(draft: Draft, picture: UInt8Array, blank: UInt8Array, zone: BoolArray) -> None:
        n_astray.append(int((differs(picture, blank) & ~zone).sum()))

    all_looks(artist, drafts, check)
    assert min(n_astray) > 1000


def test_an_instance_looks_the_same_however_dense_and_complete_its_map_is(seen: Seen) -> None:
    scene = SCENES[0]
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
    words = ["--kind", "questions", "--per-kind", "1", "--jobs", "1", "--scenes", SCENES[0], "--quiet"]
    made = []
    for folder in (run, bare):
        out = tmp_path / ("of-run" if folder == run else "of-bare")
        assert main(["sheets", "make", str(folder), *words, "--out", str(out)]) == 0
        made.append({str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()})
    assert made[0].keys() == made[1].keys() and len(made[0]) > 10
    different = [name for name in made[0] if made[0][name] != made[1][name]]
    assert different == []
    shown = b"".join(content for name, content in made[0].items() if name.endswith((".json", ".csv")))
    assert not [method for method in WITH_INSTANCES + FEATURES_ALONE if method.encode() in shown]


def test_methods_of_features_alone_are_left_out_and_said_so(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "sheets",
        "make",
        str(run),
        "--kind",
        "annotation",
        "--per-kind",
        "6",
        "--jobs",
        "1",
        "--scenes",
        SCENES[0],
    ]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    assert (
        f"annotation: left out {', '.join(FEATURES_ALONE)}, which has no instances to judge" in capsys.readouterr().err
    )
    key = read_key(tmp_path / "out-key" / "key.json")
    assert set(key.methods) == set(WITH_INSTANCES)
    assert {method for item in key.items for method in item.methods} == set(WITH_INSTANCES)  # they take turns
    times = [path.stat().st_mtime_ns for path in sorted((tmp_path / "out/pictures").iterdir())]
    assert times == sorted(times)  # written in the order of their numbers, which is drawn
    assert main([*words, "--out", str(tmp_path / "no"), "--methods", *FEATURES_ALONE]) == 2
    assert "no map has instances that people could judge" in capsys.readouterr().err
