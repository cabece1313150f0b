"""Hostile names (terminal escapes, CI commands, markup, formulas) are escaped in everything that commands print and in
every text file that they write.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from su3d_bench.cli.main import main

# Escapes, returns, direction marks, C1 and invisible characters, commands of three CI systems, markup, a formula.
HOSTILE = (
    "=1+1\x1b[31mred\nFORGED passed\r\n::stop-commands::x\n  ::add-mask::y\n##[error]z ##vso[task]w ##teamcity[q]\u2028"
    "::error::v\x9b31m\u202egnp\u2066\u200b\ufeff\x85\x7f %0A::warning::u <script>alert(1)</script> [a](http://b) | c"
)
IN_A_PATH = HOSTILE.replace("/", "").replace("\x00", "")[:80]
SCENE, METHOD = "rooms/bathroom0", "opensu3d"
FEW = ["--set", "rooms.n_frames=8", "rooms.width=160", "rooms.height=120", "rooms.mesh_spacing_m=0.05"]
TEXTS = (".md", ".csv", ".html", ".tex", ".xml", ".txt", ".json", ".toml", ".svg")

# Arguments of commands that write text files, and of commands that print contents of untrusted files: a run with
# hostile names, a data root with hostile scenes, files with hostile texts. Other commands escape output the same way.
CASES: dict[str, list[list[str]]] = {
    "run": [["--scenes", "replica/*", "--stride", "1", "--limit", "1", "--jobs", "1", "--out", f"made{IN_A_PATH}"],
            ["--config", "hostile.toml"], ["--scenes", HOSTILE], ["--set", f"{HOSTILE}=1"]],
    "evaluate": [["predictions", "--ground-truth", "truth", "--out", f"out/made{IN_A_PATH}"],
                 ["--predictions", "a=predictions", "b=predictions", "--ground-truth", "truth", "--per-class",
                  "--protocols", "scannet-instance", "--out", "out/both"],
                 ["--predictions", f"{HOSTILE}=predictions", "b=predictions", "--ground-truth", "truth"]],
    "check": [["RUN", "--against", "reference.json", "--github", "--markdown", "out/c.md", "--junit", "out/c.xml"],
              ["RUN", "--against", "reference.json", "--json"], ["--build-from", "RUN", "--out", "out/reference.json"]],
    "compare": [["RUN:METHOD", "RUN:oracle", "--per-class"], ["RUN", HOSTILE]],
    "report attribution": [["RUN", "--method", "METHOD"]],
    "report tables": [
        *(["RUN", "--format", form, "--out", f"out/t.{form}"] for form in ("markdown", "latex", "csv", "html")),
        ["RUN", "--json"],
    ],
    "report timing": [["RUN", "--out", "out/timing"]],
    "report html": [["RUN", "--no-maps", "--out", "out/page.html", "--title", HOSTILE]],
    "report instances": [["RUN", "--out", "out/samples.csv"]],
    "report leaderboard": [["."], [".", "--format", "html", "--out", "out/board.html"]],
    "report bundle": [["RUN", "--out", "out/run.zip"],
                      ["RUN", "--out", f"out/{IN_A_PATH}.zip", "--trained-on", HOSTILE]],
    "report verify": [["out/t.latex"], ["hostile.tex"], [f"out/{IN_A_PATH}.zip"]],
    "dev registry add": [[f"out/{IN_A_PATH}.zip", "--registry", "out"], ["out/run.zip", "--bundle-name", HOSTILE]],
    "dev registry build": [["out", "--out", f"out/site{IN_A_PATH}", "--title", HOSTILE],
                           ["out", "--bundle-url", HOSTILE]],
    "runs list": [["."]],
    "runs show": [["RUN"], ["RUN", "--json"]],
    "sheets make": [["RUN", "--kinds", "retrieval", "--per-kind", "1", "--jobs", "1", "--out", "out/sheets"],
                    ["RUN", "--kinds", "annotation", "--per-kind", "1", "--jobs", "1", "--out", "out/marks"]],
    "sheets score": [["answers.csv", "--key", "out/marks-key"]],
    "sheets pictures": [["RUN", "--draw", "labels", "--out", "out/labels.svg"]],
    "query text": [["SCENE", "plant", "--run", "RUN", "--method", "METHOD"]],
    "query show": [["questions.toml"]],
    "query ask": [["SCENE", "What is the largest object?", "--run", "RUN", "--method", "METHOD"]],
    "runs refine": [["RUN", "--method", "METHOD"]],
    "datasets list": [["--json"]],
    "datasets check": [["replica/*", "--quick"], ["replica/*", "--quick", "--json"]],
    "datasets show": [["replica/*", "--out", "out/room.png"]],
    "methods new": [["hostile_method.py"], [HOSTILE]],
    "methods show": [["hostile.py:Loud"], ["hostile.py:Loud", "--json"]],
    "protocols show": [["rules.toml"], ["query-ap", "--list-texts", "--queries", "lines.txt"]],
    "protocols diff": [["rules.toml", "rooms-semantic"]],
    "protocols texts": [["--protocol", "rules.toml", "--encoder", "embedded", "--out", f"out/{IN_A_PATH}.npz"]],
    "runs export": [["RUN", "--to", "openlex3d", "--method", "METHOD", "--out", "out/exported"]],
}  # fmt: skip
# Commands that draw or call models, and those that need their files: only in the proofs.
SLOW = {
    "report attribution", "report timing", "report html", "report instances", "sheets make", "sheets score",
    "sheets pictures", "query text", "query ask", "datasets show",
}  # fmt: skip
METHOD_FILE = f'''
from pydantic import BaseModel

class Loud:
    """{HOSTILE.encode("unicode_escape").decode()}"""
    name = {HOSTILE!r}
    class Config(BaseModel):
        loudness: str = {HOSTILE!r}
'''


def poisoned_texts(run: Path) -> tuple[str, str]:
    """Poison the texts of records and the names in maps."""

    def poison(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: poison(item, name) for name, item in value.items()}
        if isinstance(value, list):
            message = [HOSTILE, f"{SCENE}: {HOSTILE}"] if key == "warnings" else []
            return [poison(item, key) for item in value] + message
        return HOSTILE if key in ("hardware", "caveat", "encoder", "profile", "confidences", "python") else value

    for name in ("run.json", "metrics.json"):
        (run / name).write_text(json.dumps(poison(json.loads((run / name).read_text()))))
    for file in run.glob("scenes/*/*/prediction.npz"):
        with np.load(file) as archive:
            arrays = dict(archive)
        arrays |= {name: np.full_like(array, HOSTILE, dtype=f"U{len(HOSTILE)}") for name, array in arrays.items()
                   if array.dtype.kind == "U" and array.ndim}  # fmt: skip
        np.savez(file, **arrays)
    return SCENE, METHOD


def poisoned_keys(run: Path) -> tuple[str, str]:
    """Poison the names of scene, method, protocols and metrics, in records and folders."""
    scene, method = SCENE + IN_A_PATH, METHOD + IN_A_PATH
    new = {SCENE: scene, METHOD: method, "rooms-semantic": f"rooms-semantic{HOSTILE}", "F-mIoU": f"F-mIoU{HOSTILE}"}

    def poison(value: Any) -> Any:
        if isinstance(value, dict):
            return {new.get(name, name): poison(item) for name, item in value.items()}
        if isinstance(value, list):
            return [poison(item) for item in value]
        return new.get(value, value) if isinstance(value, str) else value

    for name in ("run.json", "metrics.json"):
        (run / name).write_text(json.dumps(poison(json.loads((run / name).read_text()))))
    for folder in list(run.glob("scenes/*")):
        (folder / METHOD).rename(folder / method)
        folder.rename(folder.with_name(folder.name + IN_A_PATH))
    return scene, method


POISONS: dict[str, Callable[[Path], tuple[str, str]]] = {"texts": poisoned_texts, "keys": poisoned_keys}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, rooms_data: Path) -> Path:
    """An unmodified run, and a data root with a scene of a hostile name."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(rooms_data))
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        patch.chdir(folder)
        words = ["--scenes", SCENE, "--methods", METHOD, "oracle", *FEW, "--no-pictures", "--jobs", "1", "--quiet"]
        protocols = ["--protocols", "rooms-semantic", "rooms-instance"]
        assert main(["run", *words, *protocols, "--out", "run"]) == 0
        made = ["--layout", "replica", "--scenes", "bathroom0", "--jobs", "1", "--out", "data", "--quiet"]
        assert main(["datasets", "make", "rooms", *made, "--set", "n_frames=2", "mesh_spacing_m=0.05"]) == 0
        (folder / "data" / "Replica" / "bathroom0").rename(folder / "data" / "Replica" / IN_A_PATH)
        assert main(["check", "--build-from", "run", "--out", "reference.json"]) == 0
    return folder


@pytest.fixture
def place(request: pytest.FixtureRequest, whole: Path, tmp_path: Path) -> Iterator[dict[str, str]]:
    """A folder with a poisoned run and hostile files; the values of RUN, SCENE and METHOD."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        patch.setenv("SU3D_DATA", str(whole / "data"))
        patch.setenv("SU3D_CACHE", str(whole / "cache"))
        run = Path(f"run{IN_A_PATH}")
        shutil.copytree(whole / "run", run)
        scene, method = POISONS[request.param](run)
        write_files(whole)
        yield {"RUN": str(run), "SCENE": scene, "METHOD": method}


def write_files(whole: Path) -> None:
    """Write files with hostile texts, as an attacker might send them."""
    quoted = json.dumps(HOSTILE)
    reference = json.loads((whole / "reference.json").read_text())
    for result in reference["results"]:
        result["method"], result["protocol"] = f"{result['method']}{HOSTILE}", HOSTILE
    Path("reference.json").write_text(json.dumps(reference))
    Path("hostile.toml").write_text(f"scenes = [{quoted}]\n{quoted} = 1\n")
    Path("hostile.tex").write_text(f"1 % run={IN_A_PATH.split()[0]} method=a protocol=b\n{HOSTILE}")
    Path("hostile.py").write_text(METHOD_FILE)
    Path("rules.toml").write_text(
        f'extends = "rooms-semantic"\nname = {quoted}\nsummary = {quoted}\n# {HOSTILE[:12]}\n'
    )
    Path("questions.toml").write_text(f"[[query]]\nscene = {quoted}\ntext = {quoted}\nobjects = [1]\n")
    Path("lines.txt").write_text("a chair\n" + " ".join(HOSTILE.splitlines()) + "\n")  # one text per line
    Path("answers.csv").write_text(f'sheet_id,item_id,annotator,ask,answer\n"{HOSTILE}",1,a,b,c\n')
    for folder in ("predictions", "truth"):
        Path(folder).mkdir()
    Path("truth", f"{IN_A_PATH}.txt").write_text("3001\n3001\n")
    Path("predictions", f"{IN_A_PATH}.txt").write_text(f"{IN_A_PATH.split()[0]} 3 1.0\n")


def faults_of(text: str, *, is_commanding: bool = False) -> list[str]:
    """The parts of ``text`` that a terminal or a CI runner would interpret."""
    faults = [f"{c!r}" for c in sorted(set(text)) if not c.isprintable() and c != "\n"]
    lines = [line for line in text.split("\n") if not (is_commanding and re.match(r"::(error|notice) title=", line))]
    faults += [line for line in lines if line.lstrip().startswith("::") or re.search(r"##\w*\[", line)]
    return faults + [f"a line of its own: {line}" for line in lines if line.strip("*|- ").startswith("FORGED")]


def faults_of_file(path: Path) -> list[str]:
    text = path.read_bytes().decode("utf-8")
    faults = faults_of(text)
    if path.suffix in (".md", ".markdown", ".html", ".svg", ".xml") and re.search(r"<script>\s*alert", text):
        faults.append("a script")
    if path.suffix in (".md", ".markdown") and "[a](http" in text:
        faults.append("a link")
    if path.suffix == ".csv":
        cells = [cell for row in csv.reader(text.splitlines()) for cell in row]
        faults += [cell for cell in cells if cell.startswith(("=", "+", "@"))]
    return faults


@pytest.mark.parametrize(
    ("place", "verbs"),
    [
        ("texts", [verb for verb in CASES if verb not in SLOW]),
        pytest.param("texts", list(CASES), marks=pytest.mark.proof),
        pytest.param("keys", list(CASES), marks=pytest.mark.proof),
    ],
    indirect=["place"],
    ids=["texts in quick verbs", "texts", "keys"],
)
def test_control_characters_and_markup_are_escaped(
    place: dict[str, str], verbs: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    faults = []
    for verb, cases in ((verb, CASES[verb]) for verb in CASES if verb in verbs):
        for words in cases:
            filled = [re.sub("RUN|SCENE|METHOD", lambda match: place[match[0]], word) for word in words]
            code = main([*verb.split(), *filled])
            message = capsys.readouterr()
            where = f"{verb} {words}"[:120]
            found = [*faults_of(message.out, is_commanding="--github" in words), *faults_of(message.err)]
            faults += [f"{where}: printed {fault}" for fault in found]
            if code not in (0, 1, 2, 3):
                faults.append(f"{where}: ended with {code}: {message.err}")
    for file in (one for one in Path().rglob("*") if one.is_file() and one.suffix in (*TEXTS, ".markdown", ".latex")):
        if file.parts[0] == "out" or file.name == "log.txt" or file.parts[0].startswith("made"):
            faults += [f"{file}: {fault}" for fault in faults_of_file(file)]
    assert not faults, "\n".join(map(ascii, faults))
