"""Training of the embedded encoder, and its accuracy on a room that it never saw."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from su3d_bench.core.errors import ModelMissing
from su3d_bench.perception.embedded.captions import fill
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.perception.embedded.training import train as training
from su3d_bench.perception.embedded.training.crops import (
    FIRST_HELD_OUT_NUMBER,
    FIRST_TRAINING_NUMBER,
    CropSet,
    make_crops,
    read_crops,
    room_names,
)

CLASSES = tuple(
    json.loads((ROOT / "su3d_bench/perception/embedded/weights/model_card.json").read_text())["training"]["classes"]
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("crops")


@pytest.fixture(scope="module")
def held_out(folder: Path) -> CropSet:
    return make_crops([f"living{FIRST_HELD_OUT_NUMBER + 500}"], frames_per_room=6, seed=3, folder=folder, jobs=1)


def test_training_and_held_out_rooms_are_no_benchmark_rooms() -> None:
    trained, held = room_names(13, FIRST_TRAINING_NUMBER), room_names(13, FIRST_HELD_OUT_NUMBER)
    assert len(set(trained) | set(held)) == 26
    numbers = [int(name.lstrip("abcdefghijklmnopqrstuvwxyz")) for name in trained + held]
    assert min(numbers) >= 10000


def test_crops_come_back_as_they_were_made(folder: Path, held_out: CropSet) -> None:
    again = read_crops([f"living{FIRST_HELD_OUT_NUMBER + 500}"], folder)
    assert again.truths == held_out.truths
    assert np.array_equal(again.pixels, held_out.pixels)
    assert {0.0, 1.0, 2.0, 4.0} <= set(held_out.ratios.tolist())
    wide = [truth for truth, ratio in zip(held_out.truths, held_out.ratios, strict=True) if ratio >= 2.0]
    assert any(truth.neighbours for truth in wide)


def test_shipped_encoder_names_objects_of_an_unseen_room(held_out: CropSet) -> None:
    encoder = EmbeddedEncoder()
    rows = [
        row
        for row, truth in enumerate(held_out.truths)
        if truth.class_name and held_out.is_exact[row] and 0 < held_out.ratios[row] <= 1.2
    ]
    features = encoder.encode_shrunk(held_out.pixels[rows], held_out.log_sizes[rows])
    texts = encoder.encode_texts([fill("an image of {a}", name) for name in CLASSES])
    named = [CLASSES[index] for index in (features @ texts.T).argmax(axis=1)]
    right = [held_out.truths[row].class_name == name for row, name in zip(rows, named, strict=True)]
    assert len(rows) >= 40
    assert np.mean(right) >= 0.6


@pytest.mark.slow
def test_training_runs_from_rooms_to_model_card(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="torch of the models extra is not installed")
    pytest.importorskip("onnx", reason="onnx of the models extra is not installed")
    options = "--rooms 2 --held-out-rooms 1 --frames-per-room 2 --minutes 2 --max-steps 3 --jobs 1"
    assert training.main(["--out", str(tmp_path), *options.split()]) == 0
    card = json.loads((tmp_path / "model_card.json").read_text())
    assert card["training"]["steps"] == 3
    assert card["digest"] == EmbeddedEncoder(tmp_path).digest
    assert card["largest_difference_from_torch"] < 1e-5
    assert EmbeddedEncoder(tmp_path).encode_texts(["a chair"]).shape == (1, 128)


def test_training_without_torch_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    order = training.Order(tmp_path, tmp_path, 1, 1, 1, 1.0, 0, 1, None, None)
    with pytest.raises(ModelMissing, match=r"pip install 'su3d-bench\[models\]'"):
        training.run(order)
