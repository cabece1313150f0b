"""The embedded encoder as it is shipped, its tokenizer, and the tool that trains it."""

from __future__ import annotations

import doctest
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.core.types import UInt8Array
from su3d_bench.datasets.homes.catalogue import catalogue
from su3d_bench.perception.embedded import encoder as embedded_encoder
from su3d_bench.perception.embedded import lexicon
from su3d_bench.perception.embedded.encoder import IMAGE_FILE, IMAGE_SIZE, TEXT_FILE, EmbeddedEncoder, log_size, shrink
from su3d_bench.perception.embedded.lexicon import DIM, token_ids

FOLDER = Path(embedded_encoder.__file__).parent / "weights"
TEXTS = ("an image of a chair", "plant on table", "table on plant", "a green towel", "place to sit")


@pytest.fixture(scope="module")
def encoder() -> EmbeddedEncoder:
    return EmbeddedEncoder()


@pytest.fixture(scope="module")
def images() -> list[UInt8Array]:
    rng = np.random.default_rng(0)
    sizes = ((1, 1), (3, 200), (64, 64), (200, 3), (480, 640), (57, 91), (100, 40))
    return [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in sizes]


def test_features_are_float32_unit_rows_of_documented_shape(encoder: EmbeddedEncoder, images: list[UInt8Array]) -> None:
    for features, n in ((encoder.encode_images(images), len(images)), (encoder.encode_texts(TEXTS), len(TEXTS))):
        assert features.shape == (n, DIM)
        assert features.dtype == np.float32
        assert np.linalg.norm(features, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert encoder.encode_images([]).shape == (0, DIM)
    assert encoder.encode_texts([]).shape == (0, DIM)


def test_feature_does_not_depend_on_its_batch(encoder: EmbeddedEncoder, images: list[UInt8Array]) -> None:
    together = encoder.encode_images(images)
    for row, image in enumerate(images):
        assert np.array_equal(encoder.encode_images([image])[0], together[row])
    assert np.array_equal(encoder.encode_images(images[::-1])[::-1], together)
    texts = encoder.encode_texts(TEXTS)
    assert np.array_equal(np.concatenate([encoder.encode_texts([text]) for text in TEXTS]), texts)


def test_feature_depends_on_crop_size(encoder: EmbeddedEncoder) -> None:
    small = np.full((20, 20, 3), 130, np.uint8)
    large = np.full((400, 400, 3), 130, np.uint8)
    assert np.array_equal(shrink(small), shrink(large))
    features = encoder.encode_images([small, large])
    assert not np.array_equal(features[0], features[1])
    assert log_size(64, 256) == (0.0, 1.0)


def test_shrinking_axis_is_averaged_even_if_the_other_grows() -> None:
    stripes = np.zeros((8, 640, 3), np.uint8)
    stripes[:, ::2] = 200
    assert shrink(stripes).shape == (IMAGE_SIZE, IMAGE_SIZE, 3)
    assert shrink(stripes).std() == 0.0
    assert shrink(stripes)[0, 0, 0] == 100


def test_model_card_describes_the_shipped_files(encoder: EmbeddedEncoder) -> None:
    card = json.loads((FOLDER / "model_card.json").read_text())
    assert card["digest"] == encoder.digest
    for name in (IMAGE_FILE, TEXT_FILE):
        data = (FOLDER / name).read_bytes()
        assert card["files"][name] == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    assert sum(entry["bytes"] for entry in card["files"].values()) <= 8_000_000
    text = (FOLDER / "model_card.md").read_text()
    for figure in card["measured"]["figures"]:
        assert figure["n"] > 0
        assert f"| {figure['name']} | {100 * figure['value']:.1f} % |" in text
    assert card["largest_difference_from_torch"] < 1e-5


def test_training_saw_no_held_out_model_and_no_novel_class() -> None:
    training = json.loads((FOLDER / "model_card.json").read_text())["training"]
    classes = catalogue().classes
    models = {model.name: model for entry in classes.values() for model in entry.models}
    assert training["classes"]
    assert training["models"]
    assert not [name for name in training["classes"] if classes[name].is_novel]
    assert not [name for name in training["models"] if models[name].is_held_out]
    named = [line for line in (FOLDER / "vocabulary.txt").read_text().splitlines() if not line.startswith("#")]
    assert named == training["classes"]


def test_weights_only_use_standard_operators() -> None:
    import onnx

    for name in (IMAGE_FILE, TEXT_FILE):
        model = onnx.load(FOLDER / name)
        onnx.checker.check_model(model)
        assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 17)]


def test_examples_in_docstrings_run() -> None:
    assert doctest.testmod(lexicon).failed == 0


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("tv-screen", "tv screen"),
        ("Indoor-Plant", "indoor plants"),
        ("an image of a chair", "image of the chair"),
        ("computer's picture", "computers picture"),
        ("shelves", "shelf"),
    ],
)
def test_spellings_of_one_word_have_the_same_ids(one: str, other: str) -> None:
    ids = token_ids([one, other])
    assert np.array_equal(ids[0], ids[1])


@pytest.mark.parametrize(
    ("one", "other"), [("plant on table", "table on plant"), ("glass", "glas"), ("cup", "cups of tea"), ("pan", "pot")]
)
def test_different_texts_have_different_ids(one: str, other: str) -> None:
    ids = token_ids([one, other])
    assert not np.array_equal(ids[0], ids[1])


def test_words_missing_from_training_captions_are_listed() -> None:
    encoder = EmbeddedEncoder()
    captions = ["A couch on the wooden table", "bowl next to a lamp in scene", "something to type with", "tv-screens"]
    assert [encoder.unseen_words(text) for text in captions] == [()] * 4
    assert encoder.unseen_words('"Xqzzy", plant; xqzzy') == ("Xqzzy", "xqzzy")
    assert encoder.unseen_words("\u6905\u5b50") == ("\u6905\u5b50",)
    assert encoder.unseen_words("the") == ("the",)  # contains nothing that the encoder uses


@pytest.mark.slow
def test_training_runs_from_homes_to_model_card(tmp_path: Path) -> None:
    import train_encoder

    options = "--homes 1 --measured-homes 1 --frames-per-home 8 --minutes 2 --max-steps 2 --jobs 1"
    assert train_encoder.main(["--out", str(tmp_path), *options.split()]) == 0
    card = json.loads((tmp_path / "model_card.json").read_text())
    assert card["training"]["steps"] == 2
    assert card["digest"] == EmbeddedEncoder(tmp_path).digest
    assert card["largest_difference_from_torch"] < 1e-5
    assert "python tools/train_encoder.py" in (tmp_path / "model_card.md").read_text()
    assert EmbeddedEncoder(tmp_path).encode_texts(["a chair"]).shape == (1, 128)
