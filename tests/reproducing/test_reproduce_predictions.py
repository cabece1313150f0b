"""Predictions of a method that is not implemented here, in its original file format, fill its row of the table."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from prediction_files import write_hovsg
from written_scenes import made_in_layout

from su3d_bench.cli.main import main
from su3d_bench.core.config import Settings
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.runs.job import build_dataset, part_of

ROOM = ["n_frames=20", "width=160", "height=120", "mesh_spacing_m=0.1"]
WORDS = [
    "reproduce",
    "hovsg",
    "--profile",
    "embedded",
    "--encoder",
    "embedded",
    "--jobs",
    "1",
    "--limit",
    "1",
    "--quiet",
]


def test_maps_of_hovsg_fill_its_row_and_an_unknown_scene_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    out, maps, data = tmp_path / "out", tmp_path / "maps", tmp_path / "data"
    words = [*WORDS, "--data", str(data), "--scenes", made_in_layout("replica", data, *ROOM), "--out", str(out)]
    maps.mkdir()
    named = ["--predictions", f"HOV-SG={maps}", "--text-features", f"HOV-SG={tmp_path / 'texts.npz'}"]
    np.savez(tmp_path / "texts.npz", names=np.array(["chair"]), features=np.eye(1, 3))
    assert main([*words, *named]) == 2
    assert "maps: " in capsys.readouterr().err and not (out / "runs/replica").exists(), "before any run"

    rules = load_protocol("replica-hovsg")
    dataset = build_dataset(part_of("dataset", "replica", Settings()), data)
    truth = dataset.ground_truth("bedroom0", rules.ground_truth)
    ids = [one.id for one in rules.classes if (truth.semantic == one.id).any()]
    clouds = {k: truth.points[truth.semantic == one] for k, one in enumerate(ids)}
    texts = list(dict.fromkeys(text for one in rules.classes for text in rules.texts_of(one.name)))
    features = np.eye(len(texts), 1024, dtype=np.float32)
    np.savez(tmp_path / "texts.npz", names=np.array(texts), features=features, encoder=np.array("made"))
    names = {one.id: one.name for one in rules.classes}
    rows = np.stack([features[texts.index(rules.texts_of(names[one])[0])] for one in ids])
    for scene in ("bedroom0", "bedroom1"):
        (maps / scene).mkdir()
        write_hovsg(maps / scene, clouds, rows)

    assert main([*words, *named]) == 2
    assert "no ground truth for the predicted scene 'bedroom1'" in capsys.readouterr().err
    (maps / "bedroom1").rename(tmp_path / "elsewhere")
    assert main([*words, *named]) == 0
    cells = json.loads((out / "compared.json").read_text())["cells"]
    own = [cell for cell in cells if cell["method"] == "HOV-SG"]
    assert own and all(cell["measured"] is not None and cell["measured"] > 90 for cell in own), (
        "the ground truth itself"
    )
    assert (out / "bundle.zip").is_file()
