"""A sample of questions for auditing: how it is drawn, its sheets and pages, and the totals of the verdicts."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bedroom_map import placed
from painted import Painted
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.human_eval.audit import COLUMNS, make_audit, read_verdicts
from su3d_bench.questions.audit import AuditedQuestion, audited_questions, sample
from su3d_bench.questions.model import GENERATED_KINDS, Question, new_question
from su3d_bench.questions.scene_map import MapObject, SceneMap

PAINTED = f"{SCENES}/painted.py:Painted"
HOSTILE = '<script>alert("x")</script>\x1b[2J'


# Two tables, a vase on each and one on the floor far away, a coffee table with a lamp, a desk with a cup.
ROOM = SceneMap(
    (
        placed(1, "table", (0.0, 0.0, 0.0), (1.0, 1.0, 0.7)),
        placed(2, "table", (6.0, 0.0, 0.0), (1.0, 1.0, 0.7)),
        placed(3, "vase", (0.4, 0.4, 0.7), (0.2, 0.2, 0.3)),
        placed(4, "vase", (9.0, 9.0, 0.0), (0.2, 0.2, 0.3)),
        placed(5, "coffee table", (3.0, 3.0, 0.0), (1.0, 0.5, 0.4)),
        placed(6, "lamp", (3.2, 3.2, 0.4), (0.2, 0.2, 0.4)),
        placed(7, "desk", (9.0, 0.0, 0.0), (1.0, 0.5, 0.7)),
        placed(8, "cup", (9.4, 0.2, 0.7), (0.1, 0.1, 0.1)),
    )
)


def audited(monkeypatch: pytest.MonkeyPatch, *questions: Question) -> list[AuditedQuestion]:
    """The hand-written questions on ROOM and those generated from templates, as audited."""
    monkeypatch.setattr("su3d_bench.questions.audit.scene_objects", lambda *_: ROOM)
    monkeypatch.setattr("su3d_bench.questions.audit.fullest_truth", lambda *_: None)
    monkeypatch.setattr("su3d_bench.questions.audit.questions_of", lambda *_: questions)
    return list(audited_questions(Painted(Path(), Painted.Options()), "a"))


def ids(things: Sequence[MapObject]) -> list[int]:
    return [one.id for one in things]


def plain(scene: str, kind: str, k: int) -> AuditedQuestion:
    return AuditedQuestion(scene, kind, f"{kind} {k}", "nothing", (), (), (), ROOM)


def test_relation_reference_is_the_related_object_of_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    one = audited(monkeypatch, new_question("painted/a", "relative", "vase on a table", (3,), "generated"))[0]
    assert (ids(one.right), ids(one.references), ids(one.others)) == ([3], [1], [4])
    assert one.answer == "vase #3"


def test_answers_of_templates_are_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    every = audited(monkeypatch)
    as_value = {one.text: one for one in every}
    assert as_value["How many vases are there?"].answer == "2: vase #3, vase #4"
    far = as_value["What is the distance between the centres of the coffee table and the lamp?"]
    assert far.answer == "0.45 m: coffee table #5, lamp #6"
    assert ids(far.others) == []  # a coffee table mentions no table
    no = as_value["Is there a cup on the coffee table?"]
    assert (no.answer, ids(no.right), ids(no.references), ids(no.others)) == ("no", [], [5], [8])
    yes = as_value["Is there a lamp on the coffee table?"]
    assert (yes.answer, ids(yes.right), ids(yes.references)) == ("yes: lamp #6", [6], [5])


def test_sampling_is_balanced_and_deterministic() -> None:
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An audit of two painted scenes."""
    out = tmp_path_factory.mktemp("audit") / "audit"
    assert (
        main(["query", "audit", "--scenes", f"{PAINTED}/a", f"{PAINTED}/b", "--n-questions", "14", "--out", str(out)])
        == 0
    )
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def judged(folder: Path, path: Path, verdicts: Sequence[str]) -> Path:
    rows = rows_of(folder / "audit.csv")
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(row | {"verdict": as_value} for row, as_value in zip(rows, verdicts, strict=True))
    return path


def test_audit_command_writes_pictures_page_and_table(folder: Path) -> None:
    rows = rows_of(folder / "audit.csv")
    assert tuple(rows[0]) == COLUMNS
    assert [row["number"] for row in rows] == [str(k) for k in range(1, 15)]
    assert {row["verdict"] for row in rows} == {""}
    assert Counter(row["scene"] for row in rows) == {"painted/a": 7, "painted/b": 7}
    assert {row["kind"] for row in rows} & {*GENERATED_KINDS} and {row["kind"] for row in rows} - {*GENERATED_KINDS}
    page = (folder / "index.html").read_text(encoding="utf-8")
    pictures = re.findall(r'src="([^"]*)"', page)
    assert len(pictures) == 14 and all((folder / name).is_file() for name in pictures)
    assert "<script" not in page and all(row["answer"] in page for row in rows)


def test_hostile_texts_are_escaped_on_the_page_and_read_back(tmp_path: Path) -> None:
    one = replace(plain("painted/a", "count", 0), text=HOSTILE, answer='=HYPERLINK("x")')
    dataset = Painted(Path(), Painted.Options())
    make_audit([one], lambda _: dataset, tmp_path)
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


def test_unknown_verdict_error_names_the_row(tmp_path: Path) -> None:
    (tmp_path / "audit.csv").write_text(f"{','.join(COLUMNS)}\n1,a,count,x,0,rigth,\n", encoding="utf-8")
    with pytest.raises(DataError, match="row 2: unknown verdict"):
        read_verdicts(tmp_path / "audit.csv")
