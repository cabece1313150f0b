from __future__ import annotations

import csv
import io
import json
import zipfile
from collections import Counter
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_sheets import HOSTILE, METHODS, RUN, drafts_of, made
from painted import WordEncoder, colour_perception
from PIL import Image

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Frame
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.truths import RefinedNames
from su3d_bench.questions.files.files import figure_texts
from su3d_bench.questions.model import new_question
from su3d_bench.questions.reasoning.answers import Answer
from su3d_bench.questions.reasoning.asking import built_in
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap
from su3d_bench.reports.pictures.colours import SCALES, scale_stops, similarity_colours
from su3d_bench.reports.pictures.items import (
    ItemParts,
    Panel,
    best_view,
    compose,
    mask_in_frame,
    png_bytes,
    seen_in,
    title_lines,
    zoomed,
)
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.executors.local import run_processes
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.items import (
    ANSWER_COLUMNS,
    Sheet,
    item_check,
    read_key,
    read_sheet,
    write_key,
    write_sheet,
)
from su3d_bench.sheets.making import run_source
from su3d_bench.sheets.making.blinding import without_ids
from su3d_bench.sheets.making.drafts import _in_turn, annotation_drafts, reasoning_drafts, retrieval_drafts, told
from su3d_bench.sheets.making.drawing import Artist, SceneDrafts, _lost, draw_all, draw_scene
from su3d_bench.sheets.making.run_source import RunSource
from su3d_bench.sheets.making.sets import table_csv, write_sheets

TEXTS = tuple(f"thing {k}" for k in range(12))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run in ``run`` and a file of queries."""
    path = tmp_path_factory.mktemp("sheets")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setenv("SU3D_DATA", str(path / "data"))
        patch.chdir(path)
        assert main(RUN) == 0
    rows = [("painted/a", "chair", "1", "instance"), ("painted/a", "a green sofa", "2", "property")]
    rows += [("painted/a", "=HYPERLINK(0)", "", "relative"), ("painted/a", "<script>x</script>", "3", "affordance")]
    text = io.StringIO(newline="")
    csv.writer(text).writerows([("scene", "text", "objects", "kind"), *rows])
    (path / "queries.csv").write_text(text.getvalue())
    return path


@pytest.fixture
def source(folder: Path, monkeypatch: pytest.MonkeyPatch) -> RunSource:
    """The run, judged by rules of the built-in rooms, whose label space the painted scenes have."""
    monkeypatch.setenv("SU3D_DATA", str(folder / "data"))
    monkeypatch.setattr(RunSource, "rules", lambda self, scene, kind: load_protocol(f"rooms-{kind}"))
    return RunSource(read_run(folder / "run"))


def test_what_annotators_get_names_no_method_no_scene_and_no_truth(tmp_path: Path) -> None:
    files = write_sheets(made("retrieval", TEXTS), tmp_path / "out", tmp_path / "key")
    secret = ("scheme1", "scheme4", "secret", "opensu3d", "question-", "relative", "automatic")
    shown = [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".html", ".csv", ".json")]
    assert len(shown) == 3 and set(files) >= {path for path in shown if path.name != "sheet.json"}
    for path in shown:
        assert not [word for word in secret if word in path.read_text()], path
    assert "opensu3d@scheme4" in (tmp_path / "key" / "key.json").read_text()
    with zipfile.ZipFile(tmp_path / "out" / "annotator-1" / "sheet.xlsx") as book:
        for name in book.namelist():
            assert not [word for word in secret if word.encode() in book.read(name) or word in name], name
    assert not [path for path in (tmp_path / "out").rglob("*") if any(word in str(path) for word in secret[:-1])]
    assert {tuple(Image.open(path).info) for path in (tmp_path / "out").rglob("*.png")} == {()}


def test_the_key_may_not_lie_among_the_sheets(tmp_path: Path) -> None:
    for key in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(ConfigError, match="keep the key apart"):
            write_sheets(made("retrieval", TEXTS), tmp_path / "out", key)


def test_the_order_is_drawn_from_the_seed_alone() -> None:
    first, again, other = (made("retrieval", TEXTS, seed=seed) for seed in (3, 3, 4))
    assert (first.sheet, first.key, first.pictures) == (again.sheet, again.key, again.pictures)
    orders = [[item.text for item in one.sheet.items] for one in (first, other)]
    assert orders[0] != orders[1] and orders[0] != sorted(orders[0])
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(TEXTS)
    assert first.sheet.id != other.sheet.id


def test_the_same_sheets_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_sheets(made("annotation", HOSTILE, annotators=2), tmp_path / name, tmp_path / f"{name}-key")
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == len(HOSTILE) + 1 + 2 * 3
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path


@pytest.mark.parametrize(
    ("annotators", "overlap", "n_each", "n_shared"),
    [(1, 0.5, 12, 12), (2, 0.5, 9, 6), (3, 0.0, 4, 0), (3, 1.0, 12, 12)],
)
def test_sheets_are_split_evenly_with_the_chosen_overlap(
    annotators: int, overlap: float, n_each: int, n_shared: int
) -> None:
    sheet = made("retrieval", TEXTS, annotators=annotators, overlap=overlap).sheet
    times = Counter(item for share in sheet.annotators for item in share.item_ids)
    assert [len(share.item_ids) for share in sheet.annotators] == [n_each] * annotators
    assert set(times) == {item.id for item in sheet.items}
    assert sum(n == annotators for n in times.values()) == n_shared or annotators == 1


@pytest.mark.parametrize(
    "values", [{"annotators": 0}, {"annotators": 101}, {"overlap": 1.5}, {"overlap": float("nan")}]
)
def test_impossible_splits_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        made("retrieval", TEXTS, **values)
    with pytest.raises(ConfigError, match="nothing to judge"):
        made("retrieval", ())


def test_sheet_and_key_come_back_from_their_files(tmp_path: Path) -> None:
    both = made("reasoning", HOSTILE, annotators=3)
    assert read_sheet(write_sheet(tmp_path, both.sheet)) == both.sheet
    assert read_key(write_key(tmp_path, both.key)) == both.key


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"items": [{"text": "other"}]}, "was changed"),
        ({"schema_version": 2}, "has schema 2"),
        ({"extra": 1}, "extra is not as"),
        ({"seed": "0"}, "seed is not as"),
        ({"kind": "other"}, "kind is not as"),
    ],
)
def test_a_changed_sheet_is_refused(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    write_sheet(tmp_path, made("retrieval", TEXTS).sheet)
    value = json.loads((tmp_path / "sheet.json").read_text())
    for key, one in change.items():
        if key == "items":
            value["items"][0] |= one[0]
        else:
            value[key] = one
    (tmp_path / "sheet.json").write_text(json.dumps(value))
    with pytest.raises(DataError, match=told):
        read_sheet(tmp_path / "sheet.json")


def test_files_that_are_no_json_are_refused(tmp_path: Path) -> None:
    for content in (b"", b"[" * 100_000, b"\xff\xfe", b"{}"):
        (tmp_path / "key.json").write_bytes(content)
        with pytest.raises(DataError, match=r"is not as|is no file that"):
            read_key(tmp_path / "key.json")
    with pytest.raises(DataError, match="cannot be read"):
        read_key(tmp_path / "none.json")


def test_a_check_moves_with_all_that_is_seen() -> None:
    seen: list[Any] = ["set", "item-0001", "chair", ["retrieval"], ["digest"]]
    others = [[*seen[:k], "x" if k < 3 else ["x"], *seen[k + 1 :]] for k in range(5)]
    assert len({item_check(*one) for one in (seen, *others)}) == 6


def test_a_table_holds_hostile_text_as_text() -> None:
    sheet = made("retrieval", HOSTILE).sheet
    rows = list(csv.DictReader(io.StringIO(table_csv(sheet, sheet.annotators[0]))))
    assert tuple(rows[0])[:6] == ANSWER_COLUMNS and len(rows) == len(HOSTILE)
    assert not [cell for row in rows for cell in row.values() if cell.startswith(("=", "@", "+", "-"))]
    assert any(row["text"].startswith("'=HYPERLINK") for row in rows)
    assert all(len(row["text"]) <= 1001 and "\x1b" not in row["text"] and "\u202e" not in row["text"] for row in rows)


def test_schemes_that_find_the_same_object_are_asked_about_once(source: RunSource) -> None:
    asked = [new_question("painted/a", "instance", text, (k,), "test") for k, text in ((1, "chair"), (2, "sofa"))]
    drafts = retrieval_drafts(source, "painted/a", asked, WordEncoder())
    assert [(one.text, one.methods, one.automatic["retrieval"]) for one in drafts] == [
        ("chair", METHODS[:2], "right"),
        ("chair", METHODS[2:], "wrong"),
        ("sofa", METHODS, "right"),
    ]
    assert all(len(one.methods) == len(one.instance_ids) for one in drafts)


def test_labels_are_asked_in_drawn_order_and_equal_ones_once(
    source: RunSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    same = annotation_drafts(source, "painted/a", 50, np.random.default_rng(0))
    assert {one.asks for one in same} == {("label 1", "merging")}
    assert {one.stands_for["label 1"] for one in same} <= {("n", "n'"), ("n",)}
    judged = [one for one in same if one.automatic]
    assert judged and all(one.automatic["label 1"] == "right" for one in judged)
    names = {"refined_names": lambda job, found: RefinedNames(("<b>lamp</b>",) * len(found), "test")}
    for name, value in names.items():
        monkeypatch.setattr(run_source, name, value)
    two = annotation_drafts(source, "painted/a", 50, np.random.default_rng(1))
    assert {one.asks for one in two} == {("label 1", "label 2", "merging")}
    assert {one.stands_for["label 1"] for one in two} == {("n",), ("n'",)}
    for one in two:
        if one.automatic:
            assert {one.stands_for[ask]: one.automatic[ask] for ask in ("label 1", "label 2")} == {
                ("n",): "right", ("n'",): "wrong"}  # fmt: skip


def test_what_labels_n_prime_leave_out_is_asked_about_under_label_n_alone(
    source: RunSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_first(job: object, found: Instances) -> RefinedNames:
        return RefinedNames(("lamp",) * len(found), "test", ("'wall' is background", *[""] * (len(found) - 1)))

    n = len(source.scene_map("painted/a", METHODS[0]))
    monkeypatch.setattr(run_source, "refined_names", without_first)
    drafts = [one for one in annotation_drafts(source, "painted/a", 50, np.random.default_rng(0)) if 0 in one.rows]
    assert {one.asks for one in drafts} == {("label 1", "merging")}
    assert {one.stands_for["label 1"] for one in drafts} == {("n",)}
    assert len(source.scene_map("painted/a", METHODS[0])) == n - 1


def test_answers_that_maps_share_are_judged_once(source: RunSource) -> None:
    question = new_question("painted/a", "reasoning", "How many chairs are there?", None, "test")
    drafts = reasoning_drafts(source, "painted/a", [question], 1, built_in(WordEncoder()))
    assert [one.methods for one in drafts] == [METHODS[:2], METHODS[2:]]
    assert drafts[0].text.startswith("How many chairs are there?\nAnswer: ")
    assert not any("#" in one.text + "".join((*one.title, *one.names)) for one in drafts)
    assert all(one.automatic == {} for one in drafts)


@pytest.mark.parametrize("kind", ["retrieval", "annotation", "reasoning", "questions"])
def test_the_picture_of_an_item_is_small_and_shows_the_object(source: RunSource, kind: Any) -> None:
    draft = replace(drafts_of(kind, ["sofa"])[0], scene="painted/a", methods=("collector",), rows=(1,), names=())
    if kind in ("reasoning", "questions"):
        draft = replace(draft, names=("chair", "sofa", "", ""), others=(0,))
    content = Artist(source).draw(draft)
    picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
    assert len(content) < 150_000 and picture.shape[1] == 960
    is_outline = (np.abs(picture - [255, 64, 200]).sum(axis=2) < 60).mean()
    assert is_outline > 0.001
    assert content == Artist(source).draw(draft)


@dataclass(frozen=True)
class Shown:
    """One map under any name, in the frames of a run."""

    source: RunSource
    a_map: Instances
    opener: Any = None

    def instances(self, scene: str, method: str) -> Instances:
        return self.a_map

    def frames(self, scene: str) -> tuple[Frame, ...]:
        return self.source.frames(scene)


@pytest.mark.parametrize("kind", ["retrieval", "annotation", "reasoning"])
def test_a_picture_shows_nothing_of_a_map_but_what_is_judged(source: RunSource, kind: Any) -> None:
    whole = source.instances("painted/a", "collector")
    masks = [whole.mask(row) for row in range(len(whole))]
    in_parts = [masks[1], *(part for mask in (masks[0], *masks[2:]) for part in np.array_split(mask, 7))]
    ids = [400 + 3 * k for k in range(len(in_parts))]
    other = Instances.of(whole.points, in_parts, names=tuple(f"other {k}" for k in ids), ids=ids)
    draft = replace(drafts_of(kind, ["sofa"])[0], scene="painted/a", methods=("collector",), names=())
    one = Artist(Shown(source, whole)).draw(replace(draft, rows=(1,)))
    assert one == Artist(Shown(source, other)).draw(replace(draft, rows=(0,)))


def test_frames_are_the_same_whatever_the_method(source: RunSource) -> None:
    assert "method" not in signature(source.frames).parameters


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("lamp #60 is closest to sofa #26: 1.03 m; lamp #102761000071 2.77 m",
         "lamp A is closest to sofa: 1.03 m; lamp B 2.77 m"),
        ("2: lamp #60, sofa #26", "2: lamp, sofa"),
        ("Take object 60, the lamp (ID: 60) (not #26, nor #7).",
         "Take lamp, the lamp (not sofa, nor something unknown)."),
        ("26 of them, 60 cm apart", "26 of them, 60 cm apart"),
        ("object #5", "object"),
    ],
)  # fmt: skip
def test_answers_name_things_without_the_ids_of_a_map(text: str, told: str) -> None:
    box = np.array([[0, 0, 0], [1, 1, 1.0]])
    named = {60: "lamp", 102761000071: "lamp", 26: "sofa", 5: ""}
    scene = SceneMap(tuple(MapObject(number, name, "", box[0], box) for number, name in named.items()))
    found, names = without_ids(text, scene, [26])
    assert found == told and names[26] == "sofa"


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_titles_make_a_picture_of_the_usual_size(text: str) -> None:
    grey = Panel("panel", np.full((30, 40, 3), 120, np.uint8), np.zeros((30, 40), bool))
    picture = compose(ItemParts((text, text), None, grey, grey))
    assert picture.shape[1] == 960 and 700 < picture.shape[0] < 1000


def test_a_question_of_two_lines_stands_above_its_answer_and_what_is_too_long_ends_in_dots() -> None:
    question = "Which pile of books is closest to the tissue paper, measured between centres?"
    whole = title_lines((question, "Answer: book A is closest: 0.70 m between centres; " + "book B 1.71 m; " * 3))
    assert [is_first for _, is_first in whole] == [True, True, False, False]
    assert " ".join(text for text, is_first in whole if is_first) == question
    cut = title_lines(("Is it?", "yes " * 200))
    assert len(cut) == 4 and cut[-1][0].endswith("...") and all(len(text) <= 88 for text, _ in cut)


def test_an_arrow_is_spoken_of_where_one_is_drawn(source: RunSource) -> None:
    draft = replace(drafts_of("reasoning", ["sofa"])[0], scene="painted/a", methods=("collector",), rows=(1,), names=())
    for one, is_drawn in ((draft, True), (replace(draft, names=("chair", "sofa", "", "")), False)):
        place = Artist(source).parts(one).place
        assert (place.ring is not None and place.eye is not None) == is_drawn == ("arrow" in place.title)


def frame_of(depth_m: np.ndarray, x_m: float = 0.0) -> Frame:
    pose = np.eye(4)
    pose[0, 3] = x_m
    camera = np.array([[20.0, 0, 20], [0, 20.0, 15], [0, 0, 1]])
    return Frame(0, 0.0, np.zeros((30, 40, 3), np.uint8), depth_m, pose, camera)


def test_the_best_view_shows_the_object_and_hides_it_behind_nothing() -> None:
    wall, near = np.full((30, 40), 2.0, np.float32), np.full((30, 40), 0.5, np.float32)
    points = np.array([[x, y, 2.0] for x in np.linspace(-0.2, 0.2, 9) for y in np.linspace(-0.2, 0.2, 9)], np.float32)
    frames = [frame_of(near), frame_of(wall, x_m=2.1), frame_of(wall)]
    view = best_view(frames, points)
    assert view is not None and (view.frame, view.seen) == (2, 1.0)
    assert best_view(frames[:1], points) is None and best_view(frames, points[:0]) is None
    assert not seen_in(frames[0], points.astype(np.float64))[2].any()


def test_a_mask_in_a_frame_holds_what_lies_nearest_to_the_instance() -> None:
    from scipy.spatial import KDTree

    wall = frame_of(np.full((30, 40), 2.0, np.float32))
    grid = np.array([[x, y, 2.0] for x in np.arange(-2, 2, 0.04) for y in np.arange(-1.5, 1.5, 0.04)])
    is_left = grid[:, 0] < -0.02
    bounds = np.stack([grid[is_left].min(axis=0), grid[is_left].max(axis=0)])
    mask = mask_in_frame(wall, KDTree(grid), is_left, bounds)
    assert mask.shape == (15, 20)
    assert mask[:, :9].all() and not mask[:, 11:].any()


def test_a_zoom_is_around_the_object_and_within_the_picture() -> None:
    mask = np.zeros((300, 400), bool)
    mask[280:298, 5:20] = True
    part = zoomed(Panel("", np.zeros((300, 400, 3), np.uint8), mask))
    assert part.mask is not None and part.mask.sum() == mask.sum()
    assert part.picture.shape[0] == 72


def test_heat_scales_end_where_they_say() -> None:
    assert [scale_stops(one).shape for one in SCALES] == [(256, 3)] * 2
    lightness = scale_stops("cividis").astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > -1).all()  # read by lightness alone
    assert similarity_colours(np.array([1.0, 1.0])).tolist() == [similarity_colours(np.array([1.0]))[0].tolist()] * 2
    assert similarity_colours(np.zeros(0)).shape == (0, 3)


def test_a_picture_of_many_colours_becomes_a_small_png() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3)).astype(np.uint8)
    assert Image.open(io.BytesIO(png_bytes(noise))).mode == "P"


def test_sheets_are_made_from_the_command_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SU3D_DATA", str(folder / "data"))
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device="cpu": colour_perception().encoder)
    words = ["sheets", "make", "run", "--kind", "retrieval", "--out", "out"]
    assert main([*words, "--questions", "queries.csv", "--annotators", "2", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["sets"]
    sheet: Sheet = read_sheet(folder / "out" / "sheet.json")
    key = read_key(folder / "out-key" / "key.json")
    assert told["sheet_id"] == sheet.id == key.sheet_id
    made_as = read_run(folder / "run")
    assert (key.profile, key.encoder, key.limit) == (made_as.record.profile, made_as.record.encoder, made_as.limit)
    assert key.profile and set(key.changed) == {one for one in key.methods if made_as.changed(one)} and not key.remarks
    assert told["n_items"] == len(sheet.items) == len(key.items) >= 4
    assert {kind for one in key.items for kind in [one.question_kind]} == {
        "instance", "property", "relative", "affordance"}  # fmt: skip
    assert all((folder / "out" / "pictures" / item.pictures[0]).is_file() for item in sheet.items)
    assert main(["sheets", "make", "run", "--kind", "annotation", "--out", "labels", "--quiet"]) == 0
    for wrong, line in (
        (words, "painted/a: has no ground truth that questions could be made from"),
        ([*words, "--questions", "paper"], "asks nothing of a scene of this run"),
        ([*words, "--methods", "colector"], "has no method 'colector'; did you mean 'collector'?"),
        ([*words, "--scenes", "painted/x"], "has no scene 'painted/x'"),
        ([*words, "--per-kind", "0"], "at least 1 item"),
        ([*words, "--seed", "-1"], "--seed -1"),
        (["sheets", "make", "run", "--kind", "annotation", "--questions", "paper", "--out", "o"], "leave it out"),
    ):
        assert main(wrong) == 2
        assert line in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["pdf", "png", "svg"])
def test_a_figure_has_its_words_as_text(
    folder: Path, suffix: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SU3D_DATA", str(folder / "data"))
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device="cpu": colour_perception().encoder)
    words = ["sheets", "pictures", "run", "--methods", "collector", "--photo", "--colours", "cividis"]
    wanted = [*words, "--queries", "<b>sofa</b> $x_1$", "--out", f"heat.{suffix}"]
    assert main(wanted) == 0
    content = (folder / f"heat.{suffix}").read_bytes()
    assert content.startswith({"pdf": b"%PDF", "png": b"\x89PNG", "svg": b"<?xml"}[suffix])
    if suffix == "svg":
        assert b"&lt;b&gt;sofa&lt;/b&gt; $x_1$" in content
        assert main(wanted) == 0 and (folder / "heat.svg").read_bytes() == content
        assert main([*words, "--what", "labels", "--out", "labels.svg"]) == 0
        assert "collector: label n'" in (folder / "labels.svg").read_text()
        question = "How many chairs are there?"
        assert main([*words, "--what", "reasoning", "--queries", question, "--out", "answer.svg"]) == 0
        assert question in (folder / "answer.svg").read_text()
        assert main([*words, "--figure", "schemes", "--out", "schemes.svg"]) == 0
        assert all(text in (folder / "schemes.svg").read_text() for text in figure_texts("schemes"))
        assert main([*words, "--what", "labels", "--figure", "schemes", "--out", "x.svg"]) == 2
        assert main([*words, "--what", "labels", "--queries", "a", "--out", "x.svg"]) == 2
        assert main([*words, "--out", "x.svg"]) == 2
        assert main([*words, "--queries", "a", "--out", "x.gif"]) == 2
        assert "unknown form" in capsys.readouterr().err


def test_a_folder_of_another_set_and_one_with_answers_are_refused_and_stay(tmp_path: Path) -> None:
    out, key = tmp_path / "out", tmp_path / "key"

    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    write_sheets(made("retrieval", TEXTS), out, key)
    before = files()
    write_sheets(made("retrieval", TEXTS), out, key)
    assert files() == before
    for folders in ((out, key), (out, tmp_path / "other"), (tmp_path / "other", key)):
        with pytest.raises(ConfigError, match=r"holds the sheets retrieval-\w+; name another folder"):
            write_sheets(made("retrieval", TEXTS[:2]), *folders)
    table = out / "annotator-1/sheet.csv"
    table.write_text(table.read_text().replace(",,", ",right,", 1))
    answered = files()
    with pytest.raises(ConfigError, match=r"sheet\.csv holds answers, or another set; name another folder"):
        write_sheets(made("retrieval", TEXTS), out, key)
    assert files() == answered


def test_pictures_of_somebody_else_stay(tmp_path: Path) -> None:
    theirs = tmp_path / "out/pictures/item-9999.png"
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"theirs")
    write_sheets(made("retrieval", TEXTS), tmp_path / "out", tmp_path / "key")
    assert theirs.read_bytes() == b"theirs"


def test_scenes_drawn_in_processes_give_the_pictures_in_order(source: RunSource, folder: Path) -> None:
    drafts = [
        replace(one, scene="painted/a", methods=("collector",), rows=(k,))
        for k, one in enumerate(drafts_of("retrieval", TEXTS[:3]))
    ]
    told: list[tuple[int, int]] = []
    drawn = draw_all(source, drafts, 1, lambda *counts: told.append(counts))
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert drawn == [Artist(source).draw(one) for one in drafts]
    unit = SceneDrafts(source.opener, {0: drafts[0]})
    (in_process,) = run_processes(draw_scene, [unit], lambda event: None, jobs=2, lost=_lost)
    assert in_process == {0: drawn[0]}
    with pytest.raises(DataError, match="try --jobs 1"):
        _lost(unit, "died")


def test_an_answer_hints_at_no_other_word_of_the_map() -> None:
    text = "no: the map has no 'cabinet under tissue paper'; did you mean 'paperback'?"
    assert told(Answer(text)) == "no: the map has no 'cabinet under tissue paper'"


def test_methods_take_turns_in_sheets_of_labels_however_many_instances_each_has() -> None:
    drafts = [replace(one, methods=("many",)) for one in drafts_of("annotation", TEXTS)]
    drafts[3], drafts[5] = replace(drafts[3], methods=("few",)), replace(drafts[5], methods=("many", "few"))
    order = np.random.default_rng(0).permutation(len(drafts)).tolist()
    kept = _in_turn(drafts, ("few", "many"), order)
    assert sorted(kept) == sorted(order) and {3, 5} <= set(kept[:4])
    assert _in_turn(drafts_of("annotation", TEXTS), ("opensu3d@scheme1",), order) == order
