"""The tool that trains the embedded encoder, from rooms to the model card."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from su3d_bench.perception.embedded.encoder import EmbeddedEncoder


@pytest.mark.slow
def test_training_runs_from_rooms_to_model_card(tmp_path: Path) -> None:
    for package in ("torch", "onnx"):
        pytest.importorskip(package, reason="the models extra is not installed")
    import train_encoder

    options = "--rooms 1 --held-out-rooms 1 --frames-per-room 1 --minutes 2 --max-steps 2 --jobs 1"
    assert train_encoder.main(["--out", str(tmp_path), *options.split()]) == 0
    card = json.loads((tmp_path / "model_card.json").read_text())
    assert card["training"]["steps"] == 2
    assert card["digest"] == EmbeddedEncoder(tmp_path).digest
    assert card["largest_difference_from_torch"] < 1e-5
    assert "python tools/train_encoder.py" in (tmp_path / "model_card.md").read_text()
    assert EmbeddedEncoder(tmp_path).encode_texts(["a chair"]).shape == (1, 128)
