"""A sample of questions to look at: its draw, its sheets and pages, and what the verdicts add up to."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import Painted
from PIL import Image
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, DataError, StoreError
from su3d_bench.questions.audit import AuditedQuestion, audited_questions, of_kinds, sample
from su3d_bench.questions.model import MADE_KINDS, Question, new_question
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap
from su3d_bench.reports.pictures.items import png_bytes
from su3d_bench.reports.pictures.tiles import Line, Mark, Photo, Tile, contact_sheet, picture_strip
from su3d_bench.sheets.audit import BLUE, GREEN, ORANGE, make_audit
from su3d_bench.sheets.judging.audit_scores import COLUMNS, audit_table, read_verdicts

PAINTED = f"{SCENES}/painted.py:Painted"
HOSTILE = '<script>alert("x")</script>\x1b[2J'


def thing(one: int, name: str, low: tuple[float, float, float], size: tuple[float, float, float]) -> MapObject:
    box = np.array([low, np.add(low, size)], np.float64)
    return MapObject(one, name, "", box.mean(axis=0), box)


# Two tables, a vase on each and one on the floor far away, a coffee table with a lamp, a desk with a cup.
ROOM = SceneMap(
    (
        thing(1, "table", (0.0, 0.0, 0.0), (1.0, 1.0, 0.7)),
        thing(2, "table", (6.0, 0.0, 0.0), (1.0, 1.0, 0.7)),
        thing(3, "vase", (0.4, 0.4, 0.7), (0.2, 0.2, 0.3)),
        thing(4, "vase", (9.0, 9.0, 0.0), (0.2, 0.2, 0.3)),
        thing(5, "coffee table", (3.0, 3.0, 0.0), (1.0, 0.5, 0.4)),
        thing(6, "lamp", (3.2, 3.2, 0.4), (0.2, 0.2, 0.4)),
        thing(7, "desk", (9.0, 0.0, 0.0), (1.0, 0.5, 0.7)),
        thing(8, "cup", (9.4, 0.2, 0.7), (0.1, 0.1, 0.1)),
    )
)


def audited(monkeypatch: pytest.MonkeyPatch, *questions: Question) -> list[AuditedQuestion]:
    """The hand-made questions on ROOM, and those that templates make of it, as they are looked at."""
    monkeypatch.setattr("su3d_bench.questions.audit.scene_objects", lambda *_: ROOM)
    monkeypatch.setattr("su3d_bench.questions.audit.fullest_truth", lambda *_: None)
    monkeypatch.setattr("su3d_bench.questions.audit.questions_of", lambda *_: questions)
    return list(audited_questions(Painted(Path(), Painted.Options()), "a"))


def ids(things: Sequence[MapObject]) -> list[int]:
    return [one.id for one in things]


def plain(scene: str, kind: str, k: int) -> AuditedQuestion:
    return AuditedQuestion(scene, kind, f"{kind} {k}", "nothing", (), (), (), ROOM)


def test_a_relation_is_held_against_that_of_the_name_to_which_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    one = audited(monkeypatch, new_question("painted/a", "relative", "vase on a table", (3,), "generated"))[0]
    assert (ids(one.right), ids(one.held), ids(one.others)) == ([3], [1], [4])
    assert one.answer == "vase #3"


def test_between_is_held_against_both_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "vase between the lamp and the coffee table"
    one = audited(monkeypatch, new_question("painted/a", "relative", text, (4,), "generated"))[0]
    assert (ids(one.right), ids(one.held), ids(one.others)) == ([4], [5, 6], [3])


def test_an_answer_that_is_no_object_of_the_scene_is_still_said(monkeypatch: pytest.MonkeyPatch) -> None:
    one = audited(monkeypatch, new_question("painted/a", "instance", "floor", (3, 99), "own truth"))[0]
    assert one.answer == "vase #3, object #99"
    assert ids(one.right) == [3]


def test_answers_of_templates_are_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    every = audited(monkeypatch)
    said = {one.text: one for one in every}
    assert said["How many vases are there?"].answer == "2: vase #3, vase #4"
    far = said["What is the distance between the centres of the coffee table and the lamp?"]
    assert far.answer == "0.45 m: coffee table #5, lamp #6"
    assert ids(far.others) == []  # a coffee table mentions no table
    no = said["Is there a cup on the coffee table?"]
    assert (no.answer, ids(no.right), ids(no.held), ids(no.others)) == ("no", [], [5], [8])
    yes = said["Is there a lamp on the coffee table?"]
    assert (yes.answer, ids(yes.right), ids(yes.held)) == ("yes: lamp #6", [6], [5])


def test_the_draw_is_even_over_kinds_and_scenes_and_the_same_for_a_seed() -> None:
    every = [
        plain(f"painted/{s}", kind, k) for s in "abcd" for kind in ("count", "instance", "what on") for k in range(9)
    ]
    every += [plain("painted/a", "rare", 0)]
    drawn = sample(every, 37, 0)
    assert Counter(one.kind for one in drawn) == {"count": 12, "instance": 12, "what on": 12, "rare": 1}
    of_both = Counter((one.scene, one.kind) for one in drawn)
    assert {n for (_, kind), n in of_both.items() if kind != "rare"} == {3}
    texts = [(one.scene, one.text) for one in drawn]
    assert texts == [(one.scene, one.text) for one in sample(every, 37, 0)]
    assert texts != [(one.scene, one.text) for one in sample(every, 37, 1)]
    assert len(sample(every, 10_000, 0)) == len(every)


def test_kinds_are_named_one_by_one_or_all_queries_and_all_templates() -> None:
    every = [plain("painted/a", kind, 0) for kind in ("instance", "property by name", "count")]
    assert [one.kind for one in of_kinds(every, ["retrieval"])] == ["instance", "property by name"]
    assert [one.kind for one in of_kinds(every, ["reasoning", "instance"])] == ["instance", "count"]
    assert of_kinds(every, []) == every
    with pytest.raises(ConfigError, match=r"no questions of kind 'cuont'; did you mean 'count'\?"):
        of_kinds(every, ["cuont"])


def test_outlines_have_the_colours_of_what_they_mean() -> None:
    grey = np.full((60, 80, 3), 128, np.uint8)
    boxes = {
        GREEN: (slice(20, 30), slice(10, 20)),
        BLUE: (slice(20, 30), slice(35, 45)),
        ORANGE: (slice(20, 30), slice(60, 70)),
    }
    marks: list[Mark] = []
    for shade, (rows, columns) in boxes.items():
        mask = np.zeros((60, 80), bool)
        mask[rows, columns] = True
        marks.append(Mark(f"#{len(marks)}", mask, shade))
    strip = picture_strip(Tile("", "", (), (Photo(grey, tuple(marks)),)), (400, 240))
    at = {shade: np.argwhere((strip == shade).all(axis=-1)).mean(axis=0) for shade in boxes}
    assert at[GREEN][1] < at[BLUE][1] < at[ORANGE][1] < 320


def test_colours_can_be_judged_though_there_are_many() -> None:
    shades = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    picture = np.kron(shades, np.ones((12, 12, 1), np.uint8))
    off = []
    for is_true in (True, False):
        with Image.open(io.BytesIO(png_bytes(picture, is_true=is_true))) as image:
            blocks = np.asarray(image.convert("RGB"), float).reshape(40, 12, 40, 12, 3).mean(axis=(1, 3))
        off.append(float(np.abs(blocks - shades).mean()))
    assert off[0] < 5 < 10 < off[1]


def test_a_sheet_takes_any_text_and_no_photograph() -> None:
    tile = Tile("1", "x" * 5000 + HOSTILE, (Line("word " * 500),), ())
    assert contact_sheet([tile] * 3).shape[1] == 1600


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An audit of two painted scenes."""
    out = tmp_path_factory.mktemp("audit") / "audit"
    words = [
        "query",
        "audit",
        "--scenes",
        f"{PAINTED}/a",
        f"{PAINTED}/b",
        "--n",
        "14",
        "--out",
        str(out),
        "--quiet",
    ]
    assert main(words) == 0
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def judged(folder: Path, path: Path, verdicts: Sequence[str]) -> Path:
    rows = rows_of(folder / "audit.csv")
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(row | {"verdict": said} for row, said in zip(rows, verdicts, strict=True))
    return path


def test_the_verb_leaves_sheets_a_page_and_a_table_to_fill_in(folder: Path) -> None:
    rows = rows_of(folder / "audit.csv")
    assert tuple(rows[0]) == COLUMNS
    assert [row["number"] for row in rows] == [str(k) for k in range(1, 15)]
    assert {row["verdict"] for row in rows} == {""}
    assert Counter(row["scene"] for row in rows) == {"painted/a": 7, "painted/b": 7}
    assert {row["kind"] for row in rows} & {*MADE_KINDS} and {row["kind"] for row in rows} - {*MADE_KINDS}
    assert sorted(path.name for path in folder.glob("*.png")) == ["sheet-01.png", "sheet-02.png"]
    with Image.open(folder / "sheet-01.png") as sheet:
        assert sheet.width == 1600 and 1700 < sheet.height < 2400
    page = (folder / "index.html").read_text(encoding="utf-8")
    pictures = re.findall(r'src="([^"]*)"', page)
    assert len(pictures) == 14 and all((folder / name).is_file() for name in pictures)
    assert "<script" not in page and all(row["answer"] in page for row in rows)


def test_what_answers_is_outlined_in_green_where_the_frame_shows_it(folder: Path) -> None:
    row = next(row for row in rows_of(folder / "audit.csv") if row["answer"] == "chair #1")
    with Image.open(folder / "pictures" / f"{int(row['number']):03d}.png") as image:
        picture = np.asarray(image.convert("RGB")).astype(int)[:, :540]
    is_green = np.abs(picture - GREEN).sum(axis=-1) < 60
    is_red = np.abs(picture - (200, 30, 30)).sum(axis=-1) < 60
    end = np.flatnonzero(is_red.any(axis=0)).max() + 40  # the chair is the leftmost of three boxes
    assert is_green[:, :end].sum() > 0.9 * is_green.sum() > 100


def test_verdicts_are_not_written_over(folder: Path, tmp_path: Path) -> None:
    judged(folder, tmp_path / "audit.csv", ["right", *[""] * 13])
    with pytest.raises(StoreError, match="holds verdicts; choose another --out"):
        make_audit([plain("painted/a", "count", 0)], lambda _: (None, ""), tmp_path)


def test_a_second_audit_leaves_nothing_of_the_first(tmp_path: Path) -> None:
    words = ["query", "audit", "--scenes", f"{PAINTED}/a", "--out", str(tmp_path), "--quiet", "--per-page", "2"]
    assert main([*words, "--n", "4"]) == 0
    assert main([*words, "--n", "1", "--kinds", "instance"]) == 0
    assert sorted(path.name for path in tmp_path.rglob("*.png")) == ["001.png", "sheet-01.png"]


def test_an_audit_leaves_other_pictures_alone(tmp_path: Path) -> None:
    theirs = [tmp_path / name for name in ("sheet-07.png", "pictures/20260101.png", "pictures/031.png")]
    theirs[1].parent.mkdir()
    for path in theirs:
        path.write_bytes(b"theirs")
    words = ["query", "audit", "--scenes", f"{PAINTED}/a", "--out", str(tmp_path), "--quiet", "--n", "2"]
    for _ in range(2):
        assert main(words) == 0
    assert all(path.read_bytes() == b"theirs" for path in theirs)


def test_hostile_texts_are_escaped_on_the_page_and_read_back(tmp_path: Path) -> None:
    one = replace(plain("painted/a", "count", 0), text=HOSTILE, answer='=HYPERLINK("x")')
    dataset = Painted(Path(), Painted.Options())
    make_audit([one], lambda _: (dataset, "a"), tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<script" not in page and "\x1b" not in page
    assert rows_of(tmp_path / "audit.csv")[0]["answer"].startswith("'=")
    assert read_verdicts(tmp_path / "audit.csv")[0].answer == '=HYPERLINK("x")'


def test_verdicts_add_up_by_kind_and_the_wrong_ones_are_listed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = judged(folder, tmp_path / "audit.csv", ["right"] * 10 + ["Arguable", "wrong ", "", ""])
    assert main(["query", "audit", "--score", str(file)]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"\| all +\| 12 +\| 83\.3 \[.*\] +\| 91\.7 \[.*\] +\| 1 +\|", shown)
    assert "2 of 14 questions are not judged yet" in shown
    wrong = rows_of(file)[11]
    assert f"wrong: 12 {wrong['scene']}, {wrong['kind']}: {wrong['text']} -> {wrong['answer']}" in shown
    assert shown.count("- wrong: ") == 1 and shown.count("- arguable: ") == 1
    assert main(["query", "audit", "--score", str(file), "--format", "latex"]) == 0
    assert "tabular" in capsys.readouterr().out
    assert main(["query", "audit", "--score", str(file), "--json"]) == 0
    counts: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert (counts["n"], counts["n_judged"], [one["number"] for one in counts["wrong"]]) == (14, 12, ["12"])
    assert sum(count["right"] for count in counts["kinds"].values()) == 10


def test_a_table_that_a_spreadsheet_saved_with_semicolons_is_read(folder: Path, tmp_path: Path) -> None:
    rows = rows_of(judged(folder, tmp_path / "audit.csv", ["right"] * 14))
    lines = [";".join(COLUMNS), *(";".join(f'"{cell}"' for cell in row.values()) for row in rows)]
    (tmp_path / "saved.csv").write_text("\r\n".join(lines), encoding="utf-8-sig")
    assert audit_table(read_verdicts(tmp_path / "saved.csv")) == audit_table(read_verdicts(tmp_path / "audit.csv"))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (f"{','.join(COLUMNS)}\n1,a,count,x,0,rigth,\n", "row 2: unknown verdict 'rigth'; did you mean 'right'?"),
        (
            f"{','.join(COLUMNS)}\n1,a,count,x,0,5,\n",
            "unknown verdict '5'; write nothing, or one of right, arguable, wrong",
        ),
        ("number,scene,kind,text,answer,remark\n1,a,count,x,0,\n", "lacks the column verdict"),
        (f"{','.join(COLUMNS)}\n", "holds no question"),
        ("", "lacks the column number"),
    ],
)
def test_a_table_that_does_not_fit_is_one_line(text: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "audit.csv").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=re.escape(line)):
        read_verdicts(tmp_path / "audit.csv")


def test_nothing_judged_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "audit", "--score", str(folder / "audit.csv")]) == 2
    assert "none of 14 questions is judged; write right, arguable, wrong into 'verdict'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--out", "x"], "needs --scenes and --out DIR, or --score"),
        (["--scenes", f"{PAINTED}/a"], "needs --scenes and --out DIR, or --score"),
        (["--scenes", f"{PAINTED}/a", "--out", "x", "--n", "0"], "--n is 0; expected 1 or more"),
        (["--scenes", f"{PAINTED}/a", "--out", "x", "--per-page", "0"], "--per-page is 0; expected 1 or more"),
        (["--scenes", f"{PAINTED}/a", "--out", "x", "--seed", "-1"], "--seed is -1; expected 0 or more"),
        (["--scenes", f"{PAINTED}/a", "--out", "x", "--kinds", "cuont"], "did you mean 'count'?"),
        (["--score", "none.csv"], "none.csv"),
    ],
)
def test_wrong_requests_are_one_line(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "audit", *words, "--quiet"]) == 2
    error = capsys.readouterr().err
    assert line in error and len(error.splitlines()) == 1


def test_scenes_of_which_nothing_can_be_asked_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("su3d_bench.questions.audit.audited_questions", lambda *_, **__: iter(()))
    assert main(["query", "audit", "--scenes", f"{PAINTED}/a", "--out", str(tmp_path), "--quiet"]) == 2
    assert "nothing can be asked of these scenes" in capsys.readouterr().err
