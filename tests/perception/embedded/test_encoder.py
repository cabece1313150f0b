"""The embedded encoder as it is shipped."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.core.types import UInt8Array
from su3d_bench.perception.embedded import encoder as embedded_encoder
from su3d_bench.perception.embedded.encoder import (
    DIM,
    IMAGE_FILE,
    IMAGE_SIZE,
    TEXT_FILE,
    EmbeddedEncoder,
    log_size,
    shrink,
)

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


def test_features_are_unit_float32_of_the_documented_shape(encoder: EmbeddedEncoder, images: list[UInt8Array]) -> None:
    for features, n in ((encoder.encode_images(images), len(images)), (encoder.encode_texts(TEXTS), len(TEXTS))):
        assert features.shape == (n, DIM)
        assert features.dtype == np.float32
        assert np.linalg.norm(features, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert encoder.encode_images([]).shape == (0, DIM)
    assert encoder.encode_texts([]).shape == (0, DIM)


def test_a_feature_does_not_depend_on_its_batch(encoder: EmbeddedEncoder, images: list[UInt8Array]) -> None:
    together = encoder.encode_images(images)
    for row, image in enumerate(images):
        assert np.array_equal(encoder.encode_images([image])[0], together[row])
    assert np.array_equal(encoder.encode_images(images[::-1])[::-1], together)
    texts = encoder.encode_texts(TEXTS)
    assert np.array_equal(np.concatenate([encoder.encode_texts([text]) for text in TEXTS]), texts)


def test_apparent_size_is_kept(encoder: EmbeddedEncoder) -> None:
    small = np.full((20, 20, 3), 130, np.uint8)
    large = np.full((400, 400, 3), 130, np.uint8)
    assert np.array_equal(shrink(small), shrink(large))
    features = encoder.encode_images([small, large])
    assert not np.array_equal(features[0], features[1])
    assert log_size(64, 256) == (0.0, 1.0)


def test_shrinking_averages_an_axis_even_where_the_other_grows() -> None:
    stripes = np.zeros((8, 640, 3), np.uint8)
    stripes[:, ::2] = 200
    assert shrink(stripes).shape == (IMAGE_SIZE, IMAGE_SIZE, 3)
    assert shrink(stripes).std() == 0.0
    assert shrink(stripes)[0, 0, 0] == 100


def test_order_of_words_and_hyphens_reach_the_features(encoder: EmbeddedEncoder) -> None:
    forward, back = encoder.encode_texts(["plant on table", "table on plant"])
    assert float(forward @ back) < 0.9
    one, other = encoder.encode_texts(["a tv-screen in a scene", "the TV screen in a scene"])
    assert np.array_equal(one, other)


def test_missing_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(ModelMissing, match=rf"there is no .*{IMAGE_FILE}; reinstall the package"):
        EmbeddedEncoder(tmp_path).encode_images([np.zeros((4, 4, 3), np.uint8)])
    with pytest.raises(ModelMissing, match=TEXT_FILE):
        EmbeddedEncoder(tmp_path).encode_texts(["chair"])


def test_a_wrong_image_is_an_error(encoder: EmbeddedEncoder) -> None:
    with pytest.raises(DataError, match=r"image 0: \(4, 4\) uint8; expected"):
        encoder.encode_images([np.zeros((4, 4), np.uint8)])
    with pytest.raises(DataError, match="not empty"):
        encoder.encode_images([np.zeros((0, 4, 3), np.uint8)])


def test_model_card_describes_the_shipped_files(encoder: EmbeddedEncoder) -> None:
    card = json.loads((FOLDER / "model_card.json").read_text())
    assert card["digest"] == encoder.digest
    for name in (IMAGE_FILE, TEXT_FILE):
        data = (FOLDER / name).read_bytes()
        assert card["files"][name] == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    assert sum(entry["bytes"] for entry in card["files"].values()) <= 6_000_000
    text = (FOLDER / "model_card.md").read_text()
    for figure in card["held_out"]["figures"]:
        assert figure["n"] > 0
        assert f"| {figure['name']} | {100 * figure['value']:.1f} % |" in text
    assert card["largest_difference_from_torch"] < 1e-5


def test_weights_need_nothing_but_standard_operators() -> None:
    onnx = pytest.importorskip("onnx", reason="onnx of the models extra is not installed")
    for name in (IMAGE_FILE, TEXT_FILE):
        model = onnx.load(FOLDER / name)
        onnx.checker.check_model(model)
        assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 17)]


def test_the_encoder_leaves_no_file_behind_not_even_for_its_makers(tmp_path: Path) -> None:
    """ONNX Runtime tells its makers of every session, and for that keeps files in $TMPDIR and the user's cache."""
    code = (
        "from su3d_bench.perception.embedded.encoder import EmbeddedEncoder\n"
        "print(EmbeddedEncoder().encode_texts(['chair']).shape)"
    )
    here = {"HOME": str(tmp_path), "TMPDIR": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment = here | {"PATH": os.environ["PATH"], "PYTHONDONTWRITEBYTECODE": "1"}  # no CI: it is silent there
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "(1, 128)\n"
    assert list(tmp_path.rglob("*")) == []
