"""A complete rehearsal: rooms in the datasets' layouts, runs, reported and measured values, bundle and verification."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from registry_bundles import Files, edit_record, read_bundle, rewrite_bundle

from su3d_bench.cli.main import main

TABLES = ["V", "reasoning"]
ROOM = ["--rooms", "bedroom0", "--room-settings", "n_frames=80", "width=160", "height=120", "mesh_spacing_m=0.1"]
WORDS = ["reproduce", "opensu3d", "--tables", *TABLES, "--rehearse", *ROOM, "--jobs", "1", "--quiet"]


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a rehearsal, with the embedded profile."""
    out = tmp_path_factory.mktemp("rehearsal")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_CACHE", str(out / "cache"))
        assert main([*WORDS, "--out", str(out), "--dry-run"]) == 0
        assert main([*WORDS, "--out", str(out)]) == 0
        patch.setenv("SU3D_DATA", str(out / "data"))
        yield out


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
    assert main([*WORDS, "--out", str(rehearsed)]) == 0
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
