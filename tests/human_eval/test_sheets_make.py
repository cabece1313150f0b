"""Creating sheets: order, splits, files and their checks, items, and the command."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from painted import WordEncoder
from painted_runs import see_painted
from PIL import Image
from synthetic_sheets import HOSTILE, METHODS, made

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.human_eval import sources as run_source
from su3d_bench.human_eval.drafts import annotation_drafts, reasoning_drafts, retrieval_drafts, without_ids
from su3d_bench.human_eval.items import Sheet, read_key, read_sheet, write_record
from su3d_bench.human_eval.sets import write_sheets
from su3d_bench.human_eval.sources import RunSource
from su3d_bench.metrics.questions.score import RefinedNames
from su3d_bench.questions.model import new_question
from su3d_bench.questions.scene_map import MapObject, SceneMap
from su3d_bench.questions.solver import built_in
from su3d_bench.runs.finished import read_run

TEXTS = tuple(f"thing {k}" for k in range(12))
JFIF = ("jfif", "jfif_version", "jfif_unit", "jfif_density")  # no date, no program


def test_annotator_files_reveal_no_method_scene_or_ground_truth(tmp_path: Path) -> None:
    files = write_sheets(made("retrieval", TEXTS), tmp_path / "out", tmp_path / "key")
    secret = ("scheme1", "scheme4", "secret", "opensu3d", "question-", "relative", "automatic")
    shown = [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".html", ".csv", ".json")]
    assert len(shown) == 3 and set(files) >= {path for path in shown if path.name != "sheet.json"}
    for path in shown:
        assert not [word for word in secret if word in path.read_text()], path
    assert "opensu3d@scheme4" in (tmp_path / "key" / "key.json").read_text()
    assert not [path for path in (tmp_path / "out").rglob("*") if any(word in str(path) for word in secret[:-1])]
    assert {tuple(Image.open(path).info) for path in (tmp_path / "out").rglob("*.jpg")} == {JFIF}


def test_key_inside_the_sheets_folder_fails(tmp_path: Path) -> None:
    for key in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(ConfigError, match="choose a separate folder"):
            write_sheets(made("retrieval", TEXTS), tmp_path / "out", key)


def test_sheets_are_deterministic(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_sheets(made("annotation", HOSTILE, annotators=2), tmp_path / name, tmp_path / f"{name}-key")
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == len(HOSTILE) + 1 + 2 * 2
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


def test_sheet_and_key_round_trip(tmp_path: Path) -> None:
    both = made("reasoning", HOSTILE, annotators=3)
    assert read_sheet(write_record(tmp_path / "sheet.json", both.sheet)) == both.sheet
    assert read_key(write_record(tmp_path / "key.json", both.key)) == both.key


def test_methods_with_same_object_share_an_item(painted_source: RunSource) -> None:
    asked = [new_question("painted/a", "instance", text, (k,), "test") for k, text in ((1, "chair"), (2, "sofa"))]
    drafts = retrieval_drafts(painted_source, "painted/a", asked, WordEncoder())
    assert [(one.text, one.methods, one.automatic["retrieval"]) for one in drafts] == [
        ("chair", METHODS[:2], "right"),
        ("chair", METHODS[2:], "wrong"),
        ("sofa", METHODS, "right"),
    ]
    assert all(len(one.methods) == len(one.instance_ids) for one in drafts)


def test_labels_are_in_random_order_and_equal_labels_merged(
    painted_source: RunSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    same = annotation_drafts(painted_source, "painted/a", 50, np.random.default_rng(0))
    assert {one.asks for one in same} == {("label 1", "merging")}
    assert {one.represents["label 1"] for one in same} <= {("n", "n'"), ("n",)}
    judged = [one for one in same if one.automatic]
    assert judged and all(one.automatic["label 1"] == "right" for one in judged)
    lamps = lambda job, found: RefinedNames(("<b>lamp</b>",) * len(found), "test")  # noqa: E731
    monkeypatch.setattr(run_source, "refined_names", lamps)
    two = annotation_drafts(painted_source, "painted/a", 50, np.random.default_rng(1))
    assert {one.asks for one in two} == {("label 1", "label 2", "merging")}
    assert {one.represents["label 1"] for one in two} == {("n",), ("n'",)}
    for one in two:
        if one.automatic:
            assert {one.represents[ask]: one.automatic[ask] for ask in ("label 1", "label 2")} == {
                ("n",): "right", ("n'",): "wrong"}  # fmt: skip


def test_answers_shared_by_maps_are_judged_once(painted_source: RunSource) -> None:
    question = new_question("painted/a", "reasoning", "How many chairs are there?", None, "test")
    drafts = reasoning_drafts(painted_source, "painted/a", [question], 1, built_in(WordEncoder()))
    assert [one.methods for one in drafts] == [METHODS[:2], METHODS[2:]]
    assert drafts[0].text.startswith("How many chairs are there?\nAnswer: ")
    assert not any("#" in one.text + "".join((*one.title, *one.names)) for one in drafts)
    assert all(one.automatic == {} for one in drafts)


@pytest.mark.parametrize(
    ("text", "result"),
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
def test_answers_contain_no_map_ids(text: str, result: str) -> None:
    box = np.array([[0, 0, 0], [1, 1, 1.0]])
    named = {60: "lamp", 102761000071: "lamp", 26: "sofa", 5: ""}
    scene = SceneMap(tuple(MapObject(number, name, "", box[0], box) for number, name in named.items()))
    found, names = without_ids(text, scene, [26])
    assert found == result and names[26] == "sofa"


def test_sheets_are_created_from_the_command_line(
    painted_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(painted_folder)
    monkeypatch.setenv("SU3D_DATA", str(painted_folder / "data"))
    see_painted(monkeypatch)
    words = ["sheets", "make", "run", "--kinds", "retrieval", "--out", "out"]
    assert main([*words, "--questions", "queries.csv", "--annotators", "2", "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)["sets"]
    sheet: Sheet = read_sheet(painted_folder / "out" / "sheet.json")
    key = read_key(painted_folder / "out-key" / "key.json")
    assert result["sheet_id"] == sheet.id == key.sheet_id
    made_as = read_run(painted_folder / "run")
    assert (key.profile, key.encoder, key.limit) == (made_as.record.profile, made_as.record.encoder, made_as.limit)
    assert key.profile and set(key.changed) == {one for one in key.methods if made_as.changed(one)} and not key.remarks
    assert result["n_items"] == len(sheet.items) == len(key.items) >= 4
    assert {kind for one in key.items for kind in [one.question_kind]} == {
        "instance", "property", "relative", "affordance"}  # fmt: skip
    assert all((painted_folder / "out" / "pictures" / item.pictures[0]).is_file() for item in sheet.items)
    assert main(["sheets", "make", "run", "--kinds", "annotation", "--out", "labels", "--quiet"]) == 0
    for wrong, line in (
        (words, "painted/a: no ground truth to generate questions from"),
        ([*words, "--questions", "paper"], "no question about a scene of this run"),
        ([*words, "--methods", "colector"], "has no method 'colector'; did you mean 'collector'?"),
        (
            ["sheets", "make", "run", "--kinds", "annotation", "--questions", "paper", "--out", "o"],
            "not valid for annotation",
        ),
    ):
        assert main(wrong) == 2
        assert line in capsys.readouterr().err


def test_folder_with_another_set_or_answers_is_not_overwritten(tmp_path: Path) -> None:
    out, key = tmp_path / "out", tmp_path / "key"

    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    write_sheets(made("retrieval", TEXTS), out, key)
    before = files()
    write_sheets(made("retrieval", TEXTS), out, key)
    assert files() == before
    for folders in ((out, key), (out, tmp_path / "other"), (tmp_path / "other", key)):
        with pytest.raises(ConfigError, match=r"contains the sheets retrieval-\w+; choose another folder"):
            write_sheets(made("retrieval", TEXTS[:2]), *folders)
    table = out / "annotator-1/sheet.csv"
    table.write_text(table.read_text().replace(",,", ",right,", 1))
    answered = files()
    with pytest.raises(ConfigError, match=r"sheet\.csv contains answers or another set; choose another folder"):
        write_sheets(made("retrieval", TEXTS), out, key)
    assert files() == answered
