"""``evaluate --out``: external predictions as a run, with equal values in every command."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluated_text import scene, write_truth
from painted import Painted
from places import SCENES
from prediction_files import write_openmask3d, write_scannet_text

import su3d_bench
from su3d_bench import load_run
from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.runs.finished import read_run

PAINTED = f"{SCENES}/painted.py:Painted"
NAMES = ("chair", "sofa", "table")
IDS = [20, 76, 80]
MINE = "external predictions, read from files (openmask3d)"
THEIRS = "external predictions, read from files (scannet-text)"


@cache
def _features() -> Any:
    return EmbeddedEncoder().encode_texts(list(NAMES)).astype(np.float64)


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two methods' masks of three scenes: OpenMask3D's with features, and ScanNet's text with classes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    dataset = Painted(tmp_path, Painted.Options())
    generator = np.random.default_rng(0)
    for share, name in zip((0.02, 0.1, 0.3), "abc", strict=True):
        truth = dataset.ground_truth(name, "mesh-vertices")
        masks = [np.flatnonzero(truth.instance == k) for k in (1, 2, 3)]
        rough = [mask[generator.random(len(mask)) > share] for mask in masks]
        write_openmask3d(Path("predA"), scene(rough, IDS, name=name, n=len(truth.points)), _features())
        labels = IDS if name == "a" else [20, 20, 80]
        text = scene([mask[::2] for mask in masks], labels, [0.9, 0.5, 0.7], name=name, n=len(truth.points))
        write_scannet_text(Path("predB"), text)


BOTH = ["evaluate", "--predictions", "mine=predA", "theirs=predB", "--dataset", PAINTED, "--scenes", "[abc]"]
PROTOCOLS = ["--protocols", "rooms-instance", "rooms-semantic"]
RUN = "runs/both"


def both(*more: str) -> int:
    return main([*BOTH, *PROTOCOLS, "--out", RUN, *more])


def files_of(folder: str) -> dict[str, str]:
    """The digests of all files except the run's cache."""
    files = (file for file in sorted(Path(folder).rglob("*")) if file.is_file() and ".cache" not in file.parts)
    return {str(file): digest_file(file) for file in files}


def answered(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> str:
    capsys.readouterr()
    assert main(list(words)) == code, capsys.readouterr().err
    answer = capsys.readouterr()
    return answer.out if code == 0 else answer.err


def test_predictions_in_two_formats_have_equal_values_in_every_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert both("--json", "numbers.json") == 0
    printed = capsys.readouterr()
    assert f"- mine: {MINE}" in printed.out and f"- theirs: {THEIRS}" in printed.out
    assert f"next: su3d-bench compare {RUN}:mine {RUN}:theirs\n" in printed.err
    documents = json.loads(Path("numbers.json").read_text())["methods"]
    run = read_run(Path(RUN))
    for (method, protocol), result in run.results.items():
        known = documents[method]["protocols"][protocol]
        assert result.result is not None
        numbers = {name.lower().replace("-", ""): result.result.metrics[name] for name in result.headline}
        assert numbers == {name: known["metrics"][name] for name in numbers}  # to the last bit
        assert [result.result.per_scene[f"painted/{name}"][result.headline[0]] for name in "abc"] == [
            known["per_scene"][name][next(iter(known["metrics"]))] for name in "abc"
        ]
    frame = load_run(RUN).metrics.set_index(["method", "protocol", "metric"])["value"]
    ap = {method: float(frame[method, "rooms-instance", "AP"]) for method in run.methods}
    assert 0 < ap["theirs"] < ap["mine"] < 1
    before = files_of(RUN)

    compared = json.loads(answered(capsys, "compare", f"{RUN}:mine", f"{RUN}:theirs", "--json"))
    of_ap = compared["protocols"][0]["metrics"]["AP"]
    assert (of_ap["left"], of_ap["right"]) == (ap["mine"], ap["theirs"])
    assert [f"{RUN}:mine: {MINE}", f"{RUN}:theirs: {THEIRS}"] == compared["remarks"]
    for method, line in (("mine", MINE), ("theirs", THEIRS)):
        explained = json.loads(answered(capsys, "report", "attribution", RUN, "--method", method, "--json"))
        assert explained["protocols"][0]["values"]["AP"] == ap[method]
        assert f"{method}: {line}" in explained["remarks"]
    latex = answered(capsys, "report", "tables", RUN, "--format", "latex", "--ceiling", "--intervals")
    assert f"value={ap['mine']!r}" in latex and "external predictions" in latex
    assert "scenes are unreliable (here: 3)" in latex and "docs/" not in latex
    Path("paper.tex").write_text(latex)
    assert " 0 differ" in answered(capsys, "report", "verify", "paper.tex")
    answered(capsys, "report", "html", RUN, "--out", "page.html", "--no-errors")
    assert MINE in Path("page.html").read_text() and '"reason":null' in Path("page.html").read_text().replace(" ", "")
    board = json.loads(answered(capsys, "report", "leaderboard", "runs", "--json"))
    entries = {entry["method"]: entry for entry in board["boards"][0]}
    assert {method: entry["values"][0] for method, entry in entries.items()} == ap
    assert {entry["profile"] for entry in entries.values()} == {"made elsewhere"} and not board["refused"]
    answered(capsys, "check", "--build-from", RUN, "--out", "reference.json")
    assert answered(capsys, "check", RUN, "--against", "reference.json").startswith("passed")
    assert "imported predictions have no timings" in answered(capsys, "report", "timing", RUN, code=2)
    words = ("sheets", "make", RUN, "--kinds", "annotation", "--methods", "mine", "--jobs", "1", "--out", "sheets")
    answered(capsys, *words, "--scenes", "painted/a", "--per-kind", "1")
    assert Path("sheets").is_dir()
    ranking = json.loads(
        answered(
            capsys, "query", "text", "painted/a", "sofa", "--run", RUN, "--method", "mine", "--out", "q.png", "--json"
        )
    )
    assert ranking["ranking"][0]["id"] == 1
    planned = json.loads(answered(capsys, "report", "power", RUN, "--protocols", "rooms-instance", "--json"))
    assert planned["remarks"] == [f"mine: {MINE}", f"theirs: {THEIRS}"]
    answered(capsys, "runs", "export", RUN, "--method", "mine", "--to", "openlex3d", "--out", "clouds")
    assert files_of(RUN) == before
    again = ["evaluate", f"{RUN}/scenes/painted.a/mine", "--dataset", PAINTED, *PROTOCOLS[:2], "--json", "again.json"]
    assert main([*again, "--quiet"]) == 0
    found = json.loads(Path("again.json").read_text())["protocols"]["rooms-instance"]["metrics"]["ap"]
    assert found == documents["mine"]["protocols"]["rooms-instance"]["per_scene"]["a"]["ap"]
    of_run = su3d_bench.evaluate(RUN, dataset=PAINTED, protocols=PROTOCOLS[1:]).metrics
    assert sorted(set(of_run["method"])) == ["mine", "theirs"]
    assert main(["evaluate", RUN, "--dataset", PAINTED, *PROTOCOLS, "--json", "every.json", "--quiet"]) == 0
    every = json.loads(Path("every.json").read_text())["methods"]
    assert {name: one["protocols"] for name, one in every.items()} == {
        name: one["protocols"] for name, one in documents.items()
    }


def test_same_evaluation_keeps_the_folder_and_another_one_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert both() == 0
    before = files_of(RUN)
    capsys.readouterr()
    assert both() == 0
    assert f"run folder: {RUN} (unchanged: has this evaluation already)" in capsys.readouterr().err
    others = (
        ([*BOTH, "--protocols", "rooms-instance", "--out", RUN], "protocols"),
        (["evaluate", "predA", "--name", "mine", *BOTH[4:], *PROTOCOLS, "--out", RUN], "methods"),
        ([*BOTH[:-1], "a", *PROTOCOLS, "--out", RUN], "scenes"),
    )
    for words, what in others:
        assert main(words) == 2
        line = f"su3d-bench: {RUN}: contains a different evaluation (other {what}); choose another --out"
        assert capsys.readouterr().err.startswith(line)
    mask = next(Path("predB").glob("masks/a_0.txt"))
    mask.write_text(mask.read_text().replace("1", "0", 1))
    assert both() == 2
    assert "contains a different evaluation (other predictions)" in capsys.readouterr().err
    assert files_of(RUN) == before
    assert not [name for name in Path("runs").iterdir() if name.name != "both"]  # no remains of refused ones


def test_folder_with_other_content_is_refused_before_scoring(capsys: pytest.CaptureFixture[str]) -> None:
    Path("notes").mkdir()
    Path("notes/paper.txt").write_text("mine")
    assert main([*BOTH, *PROTOCOLS, "--out", "notes"]) == 2
    assert "notes: contains 'paper.txt' and is not a run folder" in capsys.readouterr().err
    assert both() == 0
    record = json.loads(Path(RUN, "run.json").read_text())
    del record["predictions"]
    Path(RUN, "run.json").write_text(json.dumps(record))
    capsys.readouterr()
    assert both() == 2
    assert f"{RUN}: contains a run that is not an evaluation of external predictions" in capsys.readouterr().err


@pytest.fixture
def _texts() -> None:
    """Text ground truth with a chair and a table, and predictions of it."""
    for name, n in (("scene0001_00", 2), ("scene0001_01", 1), ("scene0002_00", 2)):
        write_truth(Path("gt"), name)
        masks = [np.arange(150), np.arange(220, 400)][:n]
        write_scannet_text(Path("pred"), scene(masks, [5, 7][:n], [0.9, 0.8][:n], name=name))


TEXTS = ["evaluate", "pred", "--ground-truth", "gt", "--protocols", "scannet-instance", "--out", "runs/mine"]


@pytest.mark.usefixtures("_texts")
def test_run_from_text_ground_truth_has_attribution_and_states_gaps(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([*TEXTS, "--json", "numbers.json"]) == 0
    known = json.loads(Path("numbers.json").read_text())["protocols"]["scannet-instance"]["metrics"]
    run = read_run(Path("runs/mine"))
    numbers = run.results["mine", "scannet-instance"].result
    assert numbers is not None and numbers.metrics["AP"] == known["ap"] and numbers.coverage == {}
    assert run.scenes == ("scannet/scene0001_00", "scannet/scene0001_01", "scannet/scene0002_00")
    explained = json.loads(answered(capsys, "report", "attribution", "runs/mine", "--json"))
    assert explained["protocols"][0]["values"]["AP"] == known["ap"]
    assert explained["protocols"][0]["causes"]["missed"]["n"] == 1
    query = answered(
        capsys, "query", "text", "scannet/scene0001_00", "chair", "--run", "runs/mine", "--method", "mine", code=2
    )
    assert "uses the points of ground-truth files, which have no coordinates" in query
    sheets = answered(capsys, "sheets", "make", "runs/mine", "--kinds", "annotation", "--out", "sheets", code=2)
    assert sheets.count("\n") == 1 and "uses the points of ground-truth files" in sheets
    answered(capsys, "runs", "export", "runs/mine", "--to", "scannet", "--out", "exported")
    assert main([*TEXTS[:1], "exported", *TEXTS[2:-2], "--json", "again.json", "--quiet"]) == 0
    again = json.loads(Path("again.json").read_text())["protocols"]["scannet-instance"]["metrics"]
    assert again == known
    Path("gt/scene0001_00.txt").write_text("0\n" * 600)
    assert "is not the one of runs/mine" in answered(capsys, "report", "attribution", "runs/mine", code=2)


def test_text_feature_file_names_features_and_is_needed_for_attribution(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = [entry.name for entry in load_protocol("rooms-instance").classes]
    features = EmbeddedEncoder().encode_texts(names)
    np.savez("texts.npz", names=np.array(names), features=features, encoder=np.array("theirs/v1"))
    words = ["evaluate", "predA", "--dataset", PAINTED, "--scenes", "[abc]", "--protocols", "rooms-instance"]
    assert main([*words, "--text-features", "texts.npz", "--out", "runs/mine"]) == 0
    result = read_run(Path("runs/mine")).results["mine", "rooms-instance"]
    assert result.encoder == "theirs/v1" and result.result is not None
    explained = json.loads(answered(capsys, "report", "attribution", "runs/mine", "--json"))
    assert explained["protocols"][0]["values"]["AP"] == result.result.metrics["AP"]
    reply = answered(capsys, "query", "text", "painted/a", "sofa", "--run", "runs/mine", "--method", "mine", code=2)
    assert "made by encoder theirs/v1" in reply and "only texts encoded by it can be compared with them" in reply
    np.savez("texts.npz", names=np.array(names[::-1]), features=features)
    assert "texts.npz: is not the text features file used to score runs/mine" in answered(
        capsys, "report", "attribution", "runs/mine", code=2
    )


NUMBERS_ALONE = "contains numbers without the counts of scenes that are needed here; evaluate again with --out"
PREDICTIONS = (
    "pred: contains predictions (scannet-text) and no run.json; create a run from them with: su3d-bench evaluate pred"
)
NO_RUNS = {
    "compare numbers.json runs/mine": f"numbers.json: {NUMBERS_ALONE}",
    "compare runs/mine both.json:mine": f"both.json: {NUMBERS_ALONE}",
    "compare nowhere runs/mine": "nowhere: no such folder",
    "report attribution pred": PREDICTIONS,
    "report leaderboard pred": "pred: contains no runs; create one with su3d-bench run, or with evaluate --out",
}


@pytest.mark.usefixtures("_texts")
def test_other_than_a_run_is_refused_with_instructions(capsys: pytest.CaptureFixture[str]) -> None:
    main([*TEXTS, "--json", "numbers.json", "--quiet"])
    numbers = json.loads(Path("numbers.json").read_text())
    Path("both.json").write_text(json.dumps({"schema": 1, "methods": {"mine": numbers}}))
    for words, line in NO_RUNS.items():
        error = answered(capsys, *words.split(), code=2)
        assert error.startswith(f"su3d-bench: {line}") and error.count("\n") == 1
