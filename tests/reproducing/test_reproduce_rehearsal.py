"""A rehearsal, whole: rooms in the datasets' layouts, the runs, printed beside measured, the archive and its check."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import StoreError
from su3d_bench.reproducing.bundle import unpack

TABLES = ["V", "reasoning"]
ROOM = ["--rooms", "bedroom0", "--room-settings", "n_frames=80", "width=160", "height=120", "mesh_spacing_m=0.1"]
WORDS = ["reproduce", "opensu3d", "--table", *TABLES, "--rehearse", *ROOM, "--jobs", "1", "--quiet"]
JOB = "runs/replica/scenes/replica.bedroom0/opensu3d"


@dataclass(frozen=True)
class Rehearsed:
    """What a rehearsal left, the hours that the preflight gave it, and the processor's seconds that it took."""

    out: Path
    estimated_s: float
    took_s: float

    @property
    def bundle(self) -> Path:
        return self.out / "bundle.zip"


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rehearsed]:
    out = tmp_path_factory.mktemp("rehearsal")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_CACHE", str(out / "cache"))
        assert main([*WORDS, "--out", str(out), "--probe", "--dry-run", f"--json={out / 'preflight.json'}"]) == 0
        start = time.process_time()
        assert main([*WORDS, "--out", str(out)]) == 0
        took_s = time.process_time() - start
        patch.setenv("SU3D_DATA", str(out / "data"))
        known = json.loads((out / "preflight.json").read_text())
        yield Rehearsed(out, known["hours"] * 3600, took_s)


def test_every_printed_cell_stands_beside_a_measured_one_with_what_differs(rehearsed: Rehearsed) -> None:
    cells = json.loads((rehearsed.out / "compared.json").read_text())["cells"]
    assert len(cells) == 8 + 2
    assert all(cell["measured"] is not None and cell["protocol"].startswith(cell["dataset"]) for cell in cells)
    assert all(cell["difference"] == cell["measured"] - float(cell["reported"]) for cell in cells)
    for said in ("judges: ", "scenes: 1 room made by the program"):
        assert all(any(cause.startswith(said) for cause in cell["causes"]) for cell in cells)
    text = (rehearsed.out / "tables.md").read_text()
    assert all(f"**{name}**" in text for name in TABLES)


def test_the_estimate_of_a_rehearsal_is_within_a_factor_of_two_of_what_it_took(rehearsed: Rehearsed) -> None:
    assert 0.5 <= rehearsed.estimated_s / rehearsed.took_s <= 2.0


def test_the_same_command_takes_the_run_up_and_packs_the_same_bytes(rehearsed: Rehearsed) -> None:
    before = rehearsed.bundle.read_bytes()
    metrics = (rehearsed.out / "runs/replica/metrics.json").stat().st_mtime_ns
    assert main([*WORDS, "--out", str(rehearsed.out)]) == 0
    assert rehearsed.bundle.read_bytes() == before
    assert (rehearsed.out / "runs/replica/metrics.json").stat().st_mtime_ns == metrics


def test_another_process_in_another_folder_scores_the_bundle_to_the_same_bits(
    rehearsed: Rehearsed, tmp_path: Path
) -> None:
    shutil.copy(rehearsed.bundle, tmp_path / "b.zip")
    words = [sys.executable, "-m", "su3d_bench", "report", "verify", "b.zip", "--json"]
    done = subprocess.run(words, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (found,) = json.loads(done.stdout)["bundles"]
    assert found["is_to_the_bit"] and found["faults"] == []
    assert (found["n_scores"], found["n_cells"]) == (2 * 2, 10)


Files = dict[str, bytes]


def name_other_rules(files: Files) -> None:
    record = json.loads(files["runs/replica/run.json"])
    record["protocols"][0]["digest"] = "0" * 64
    files["runs/replica/run.json"] = json.dumps(record).encode()


def raise_a_number(files: Files) -> None:
    record = json.loads(files["runs/replica/metrics.json"])
    result = next(one for one in record["results"] if one["result"] is not None)
    result["result"]["metrics"][result["headline"][0]] = 0.987
    files["runs/replica/metrics.json"] = json.dumps(record).encode()


def raise_a_cell(files: Files) -> None:
    record = json.loads(files["compared.json"])
    record["cells"][0]["measured"] = 98.7
    files["compared.json"] = json.dumps(record).encode()


def bring_code(files: Files) -> None:
    text = files["runs/replica/run.toml"].decode().replace("scenes = [", 'scenes = ["evil.py:Data/a", ', 1)
    files["runs/replica/run.toml"] = text.encode()


# A flipped label is refused in the tests of the registry: in a random network's map it moves no count.
@pytest.mark.parametrize(
    ("tamper", "says"),
    [
        (name_other_rules, "are not those that scored it"),
        (raise_a_number, "metrics.json does not follow from the counts"),
        (raise_a_cell, "measured is 98.7, the runs give"),
        (bring_code, "names somebody's own 'evil.py:Data/a', which a bundle does not bring"),
    ],
)
def test_a_tampered_bundle_is_refused_with_its_reason_though_all_its_digests_are_right(
    rehearsed: Rehearsed,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    tamper: Callable[[Files], None],
    says: str,
) -> None:
    files, manifest = _read(rehearsed.bundle)
    tamper(files)
    _write(tmp_path / "t.zip", files, manifest)
    assert main(["report", "verify", str(tmp_path / "t.zip")]) == 1
    assert says in capsys.readouterr().out


def _read(bundle: Path) -> tuple[Files, dict[str, object]]:
    with zipfile.ZipFile(bundle) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return files, json.loads(files.pop("manifest.json"))


def _write(place: Path, files: Files, manifest: dict[str, object]) -> None:
    entries = {name: {"n_bytes": len(content), "sha256": digest_bytes(content)} for name, content in files.items()}
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("manifest.json", json.dumps({**manifest, "files": entries}))
        for name, content in files.items():
            archive.writestr(name, content)


def test_a_file_that_is_not_the_manifests_is_refused_before_anything_is_scored(
    rehearsed: Rehearsed, tmp_path: Path
) -> None:
    files, manifest = _read(rehearsed.bundle)
    files["tables.md"] = files["tables.md"].replace(b"a", b"b", 1)
    with zipfile.ZipFile(tmp_path / "t.zip", "w") as archive:
        archive.writestr("manifest.json", json.dumps(manifest))
        for name, content in files.items():
            archive.writestr(name, content)
    with pytest.raises(StoreError, match=r"tables.md is not the file of its manifest \(other SHA-256\)"):
        unpack(tmp_path / "t.zip", tmp_path / "into")
