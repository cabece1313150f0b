"""A recipe on generated rooms in the layouts of its datasets: runs, measured values, bundle and its verification."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from chat_server import Answered, Body, ChatServer
from registry_bundles import Files, edit_record, read_bundle, rewrite_bundle
from written_scenes import made_in_layout

from su3d_bench.cli.main import main

TABLES = ["V", "reasoning"]
ROOM = ["n_frames=80", "width=160", "height=120", "mesh_spacing_m=0.1"]
WORDS = ["reproduce", "opensu3d", "--tables", *TABLES, "--profile", "embedded", "--encoder", "embedded", "--jobs", "1"]
ROOMS = ["rooms/bedroom0", "--protocols", "rooms-reasoning"]
COMMANDS = [WORDS, ["run", *ROOMS], ["ablate", *ROOMS, "--vary", "top_m=1,2"]]


def words_for(out: Path) -> list[str]:
    """The command on the room, whose files are generated unless they exist."""
    scenes = [made_in_layout(layout, out / "data", *ROOM) for layout in ("replica", "scannet")]
    return [*WORDS, "--quiet", "--refiner", "model", "--data", str(out / "data"), "--scenes", *scenes]


def last_name(body: Body) -> Answered:
    """The reply of a language model to a list of names."""
    assert body["messages"][0]["content"].startswith("assign a single name to the object")
    return Answered(f"Object: {json.loads(body['messages'][1]['content'])[-1]}.")


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a recipe's results on one room, with labels n' by a local language model."""
    out = tmp_path_factory.mktemp("rehearsal")
    words = words_for(out)
    with pytest.MonkeyPatch.context() as patch, ChatServer() as server:
        server.answer = last_name
        patch.setenv("OPENAI_BASE_URL", server.url)
        patch.setenv("SU3D_CACHE", str(out / "cache"))
        assert main([*words, "--out", str(out), "--dry-run"]) == 0
        assert server.n_asked == 0
        assert main([*words, "--out", str(out)]) == 0
        assert server.n_asked > 0
        patch.setenv("SU3D_DATA", str(out / "data"))
        patch.setenv("OPENAI_BASE_URL", "http://127.0.0.1:9/v1")  # nothing is asked again
        yield out


def test_labels_by_the_language_model_reach_the_table_and_the_differences(rehearsed: Path) -> None:
    text = (rehearsed / "tables.md").read_text()
    assert "refined label (n' by the model gpt-6-luna)" in text
    record = json.loads((rehearsed / "compared.json").read_text())
    here = {one["name"]: one["here"] for one in record["deviations"]}
    assert here["label n'"] == "the model gpt-6-luna of the refiner, names of 5 views"
    assert here["reasoning"] == "the built-in solver" and here["masks"] == "those of the profile 'embedded'"
    assert here["scenes"] == "procedurally generated scenes"
    assert here["border"].startswith("3 px in images 160 px wide")
    assert "**Differences from the paper**" in text
    for path in rehearsed.glob("runs/*/scenes/*/opensu3d/refined_names.json"):
        names = json.loads(path.read_text())["names"]
        assert {one["source"] for one in names} <= {"model", "label"}
        assert all(one["refined"] == one["candidates"][-1].lower() for one in names if one["source"] == "model")


@pytest.mark.parametrize("words", [["--refiner", "model"], ["--question-solver", "llm"]])
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_language_model_without_a_key_is_an_error_before_anything_is_written(
    command: list[str],
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("OPENAI_API_KEY", "OPENAI_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    assert main([*command, *words, "--out", str(tmp_path / "out")]) == 2
    assert "$OPENAI_API_KEY is not set" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_every_printed_cell_has_a_measured_value_and_causes_of_the_difference(rehearsed: Path) -> None:
    cells = json.loads((rehearsed / "compared.json").read_text())["cells"]
    assert len(cells) == 8 + 2
    assert all(cell["measured"] is not None and cell["protocol"].startswith(cell["dataset"]) for cell in cells)
    assert all(cell["difference"] == cell["measured"] - float(cell["reported"]) for cell in cells)
    for printed in (
        "judges: ",
        "scenes: 1 procedurally generated room, not ",
        "proposals: masks of the profile 'embedded' instead of ",
    ):
        assert all(any(cause.startswith(printed) for cause in cell["causes"]) for cell in cells)
    text = (rehearsed / "tables.md").read_text()
    assert all(f"**{name}**" in text for name in TABLES)


def test_repeated_command_resumes_the_run_and_writes_an_identical_bundle(rehearsed: Path) -> None:
    before = (rehearsed / "bundle.zip").read_bytes()
    metrics = (rehearsed / "runs/replica/metrics.json").stat().st_mtime_ns
    assert main([*words_for(rehearsed), "--out", str(rehearsed)]) == 0
    assert (rehearsed / "bundle.zip").read_bytes() == before
    assert (rehearsed / "runs/replica/metrics.json").stat().st_mtime_ns == metrics


def test_bundle_verifies_to_the_last_bit_in_another_folder(
    rehearsed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(rehearsed / "bundle.zip", tmp_path / "b.zip")
    monkeypatch.chdir(tmp_path)
    assert main(["report", "verify", "b.zip", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["bundles"]
    assert found["is_to_the_bit"] and found["faults"] == []
    assert (found["n_scores"], found["n_cells"]) == (2 * 2, 10)


def raise_a_cell(files: Files) -> None:
    record = json.loads(files["compared.json"])
    record["cells"][0]["measured"] = 98.7
    files["compared.json"] = json.dumps(record).encode()


# Flipped labels are tested with the registry: in a random network's map they change no count.
@pytest.mark.parametrize(
    ("tamper", "says"),
    [
        (raise_a_cell, "measured is 98.7, the runs give"),
        (
            lambda files: edit_record(files, "runs/replica/run.toml", "scenes = [", 'scenes = ["evil.py:Data/a", '),
            "uses the user-defined 'evil.py:Data/a', which a bundle cannot contain",
        ),
    ],
)
def test_tampered_bundle_with_correct_digests_is_rejected_with_a_reason(
    rehearsed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], tamper: Callable[[Files], None], says: str
) -> None:
    files, manifest = read_bundle(rehearsed / "bundle.zip")
    tamper(files)
    rewrite_bundle(tmp_path / "t.zip", files, manifest)
    assert main(["report", "verify", str(tmp_path / "t.zip")]) == 1
    assert says in capsys.readouterr().out
