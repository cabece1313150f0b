"""Encoders of random weights: preparation to the bit, features equal to the libraries' own, nothing taken on trust."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_encoders import DIM, IMAGE_SIZE, N_TOKENS, noise_images, write_tiny_clip, write_tiny_siglip

from su3d_bench.errors import ConfigError, DataError, ModelMissing
from su3d_bench.perception.cache import FrameCache
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.devices import Batches, device_for, first_batch, precision_for
from su3d_bench.perception.models.encoder import EncoderSpec, FoundationEncoder, unit_rows
from su3d_bench.perception.models.image_transform import CLIP_MEAN, CLIP_STD, ImageTransform, read_transform
from su3d_bench.perception.models.loading import load_encoder
from su3d_bench.perception.models.text_tokens import canonical_text
from su3d_bench.perception.models.weights import read_weights
from su3d_bench.types import Encoder, Float32Array, Int64Array

needs_models = pytest.mark.skipif(
    find_spec("torch") is None or find_spec("transformers") is None,
    reason="torch and transformers are not installed: pip install 'su3d-bench[models]'",
)
TEXTS = ("chair", "a red cup on the table", "chair", "zebra")
RAW = EncoderSpec(3, 4, 10, "clip", None, ImageTransform(4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("models")
    write_tiny_clip(root / "clip-vit-h-14")
    write_tiny_siglip(root / "siglip-base-224")
    return root


def config(folder: Path, encoder: str = "clip-vit-h-14", **settings: Any) -> ModelsConfig:
    return ModelsConfig(encoder=encoder, folder=folder, **settings)


# ---- preparation of images


def test_the_window_of_the_centre_crop_is_rounded_as_each_library_does() -> None:
    # 7 wide after the resize, 4 kept: a surplus of 3. torchvision: round(1.5) = 2; transformers: 3 // 2 = 1.
    columns = np.arange(7, dtype=np.uint8) * 10
    image = np.tile(columns[None, :, None], (4, 1, 3))
    plain = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
    original = ImageTransform(4, **plain).pixels([image])  # type: ignore[arg-type]
    other = ImageTransform(4, convention="transformers", **plain).pixels([image])  # type: ignore[arg-type]
    assert np.array_equal(np.rint(original[0, 0, 0] * 255), [20, 30, 40, 50])
    assert np.array_equal(np.rint(other[0, 0, 0] * 255), [10, 20, 30, 40])


def test_pixels_are_divided_by_255_then_normalised_in_float32() -> None:
    image = np.full((4, 4, 3), 200, np.uint8)
    expected = (np.float32(200) / np.float32(255) - np.float32(CLIP_MEAN[1])) / np.float32(CLIP_STD[1])
    pixels = ImageTransform(4).pixels([image])
    assert pixels.dtype == np.float32
    assert (pixels[0, 1] == expected).all()


def test_squash_stretches_both_sides_and_crops_nothing() -> None:
    image = np.zeros((8, 32, 3), np.uint8)
    image[:, :16] = 255
    pixels = ImageTransform(8, "squash", (0.5,) * 3, (0.5,) * 3).pixels([image])
    assert (pixels[0, 0, :, :3] == 1).all()
    assert (pixels[0, 0, :, 5:] == -1).all()


@needs_models
def test_clip_images_are_prepared_as_transformers_prepares_them_to_the_bit() -> None:
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    side = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    theirs = CLIPImageProcessorPil(size={"shortest_edge": IMAGE_SIZE}, crop_size=side)
    ours = ImageTransform(IMAGE_SIZE, convention="transformers")
    random = np.random.default_rng(5)
    for _ in range(40):
        image = random.integers(0, 256, (*random.integers(1, 90, 2), 3), dtype=np.uint8)
        answer = theirs(images=[image], return_tensors="np", input_data_format="channels_last")["pixel_values"]
        assert np.array_equal(ours.pixels([image]), answer), image.shape


@needs_models
def test_siglip_images_are_prepared_as_transformers_prepares_them_to_the_bit() -> None:
    from transformers.models.siglip.image_processing_pil_siglip import SiglipImageProcessorPil

    theirs = SiglipImageProcessorPil(size={"height": IMAGE_SIZE, "width": IMAGE_SIZE})
    ours = ImageTransform(IMAGE_SIZE, "squash", (0.5,) * 3, (0.5,) * 3, convention="transformers")
    for image in noise_images(5):
        answer = theirs(images=[image], return_tensors="np", input_data_format="channels_last")["pixel_values"]
        assert np.array_equal(ours.pixels([image]), answer), image.shape


def test_dividing_by_255_and_multiplying_by_its_inverse_give_the_same_float32() -> None:
    values = np.arange(256, dtype=np.uint8)
    multiplied = (values.astype(np.float64) * (1 / 255)).astype(np.float32)
    assert np.array_equal(values.astype(np.float32) / np.float32(255), multiplied)


def test_the_two_conventions_agree_where_the_windows_do() -> None:
    images = [image for image in noise_images(5) if image.shape[0] == image.shape[1]]
    other = ImageTransform(IMAGE_SIZE, convention="transformers")
    assert np.array_equal(ImageTransform(IMAGE_SIZE).pixels(images), other.pixels(images))


def test_a_processor_file_of_either_age_gives_the_transform(tmp_path: Path) -> None:
    path = tmp_path / "preprocessor_config.json"
    usual = {"image_mean": [0.1, 0.2, 0.3], "image_std": [1, 2, 3], "resample": 3}
    path.write_text(json.dumps(usual | {"size": 224, "crop_size": 224, "do_center_crop": True}))
    expected = ImageTransform(224, "shortest", (0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    assert read_transform(path, "original") == expected
    crop = {"height": 224, "width": 224}
    path.write_text(json.dumps(usual | {"size": {"shortest_edge": 224}, "crop_size": crop, "do_center_crop": True}))
    assert read_transform(path, "original") == expected
    path.write_text(json.dumps(usual | {"size": crop, "image_processor_type": "SiglipImageProcessor"}))
    assert read_transform(path, "original").fit == "squash"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"do_normalize": False}, "do_normalize is False"),
        ({"rescale_factor": 1}, "rescale_factor is 1"),
        ({"size": {"longest_edge": 9}}, "expected a shortest edge"),
        ({"crop_size": 100}, "expected a shortest edge"),
        ({"size": 10**9, "crop_size": 10**9}, "expected a shortest edge"),
        ({"image_std": [0, 1, 1]}, "above 0"),
        ({"image_mean": ["a", 1, 1]}, "expected three numbers"),
        ({"resample": "cubic"}, "0 to 5"),
    ],
)
def test_a_processor_file_that_asks_for_another_recipe_is_refused(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    path = tmp_path / "preprocessor_config.json"
    usual = {"size": 32, "crop_size": 32, "image_mean": [0, 0, 0], "image_std": [1, 1, 1], "do_center_crop": True}
    path.write_text(json.dumps(usual | change))
    with pytest.raises(DataError, match=said):
        read_transform(path, "original")


# ---- texts


def test_siglip_texts_lose_capitals_and_punctuation() -> None:
    assert canonical_text(" A  TV-screen, in the scene. ") == "a tvscreen in the scene"


@needs_models
def test_long_texts_are_cut_and_keep_their_end(folder: Path) -> None:
    from su3d_bench.perception.models.text_tokens import read_tokeniser

    words = json.loads((folder / "clip-vit-h-14" / "vocab.json").read_text())
    tokens = read_tokeniser(folder / "clip-vit-h-14", "clip", N_TOKENS, None, len(words))(["chair", "chair " * 50])
    end = words["<|endoftext|>"]
    assert tokens.shape == (2, N_TOKENS)
    assert tokens[0, :3].tolist() == [words["<|startoftext|>"], words["chair</w>"], end]
    assert tokens[1, -1] == end
    assert (tokens[1, 1:-1] == words["chair</w>"]).all()


@needs_models
def test_a_tokenizer_of_another_model_is_refused(folder: Path) -> None:
    from su3d_bench.perception.models.text_tokens import read_tokeniser

    with pytest.raises(DataError, match="the text tower knows 20 words"):
        read_tokeniser(folder / "clip-vit-h-14", "clip", N_TOKENS, None, 20)(["chair"])


# ---- features


@needs_models
@pytest.mark.parametrize("name", ["clip-vit-h-14", "siglip-base-224"])
def test_features_are_those_of_transformers_own_model_and_processor(folder: Path, name: str) -> None:
    import torch
    from transformers import AutoModel

    encoder = load_encoder(config(folder, name, transform="transformers"))
    assert isinstance(encoder, Encoder)
    model: Any = AutoModel.from_pretrained(str(folder / name), local_files_only=True).eval()
    spec = encoder._spec  # type: ignore[attr-defined]
    tokens = encoder._tokeniser(TEXTS)  # type: ignore[attr-defined]
    with torch.inference_mode():
        images = [
            model.get_image_features(pixel_values=torch.from_numpy(spec.transform.pixels([image]))).pooler_output
            for image in noise_images(5)
        ]
        texts = [model.get_text_features(input_ids=torch.from_numpy(row[None])).pooler_output for row in tokens]
    assert np.array_equal(encoder.encode_images(noise_images(5)), _unit(torch.cat(images).numpy()))
    assert np.array_equal(encoder.encode_texts(TEXTS), _unit(torch.cat(texts).numpy()))


def _unit(rows: Float32Array) -> Float32Array:
    return np.asarray(rows / np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True), np.float32)


@needs_models
@pytest.mark.parametrize("name", ["clip-vit-h-14", "siglip-base-224"])
def test_a_feature_does_not_depend_on_the_rest_of_its_batch(folder: Path, name: str) -> None:
    encoder = load_encoder(config(folder, name))
    images = noise_images(5)
    together = encoder.encode_images(images)
    assert together.dtype == np.float32
    assert np.allclose(np.linalg.norm(together, axis=1), 1, atol=1e-6)
    assert np.array_equal(together[3:4], encoder.encode_images(images[3:4]))
    batched = load_encoder(config(folder, name, batch=4)).encode_images(images)
    assert np.abs(batched - together).max() < 1e-5
    assert encoder.encode_images([]).shape == (0, encoder.dim)
    assert encoder.encode_texts([]).shape == (0, encoder.dim)


@needs_models
def test_half_precision_on_the_cpu_only_where_it_is_asked_for(folder: Path) -> None:
    full = load_encoder(config(folder))
    half = load_encoder(config(folder, precision="bfloat16"))
    difference = np.abs(full.encode_images(noise_images(3)) - half.encode_images(noise_images(3))).max()
    assert 0 < difference < 0.1
    assert half.digest != full.digest


@needs_models
def test_the_older_form_of_weights_gives_the_same_features(folder: Path, tmp_path: Path) -> None:
    write_tiny_clip(tmp_path / "clip-vit-h-14", weights="pytorch_model.bin")
    older, newer = load_encoder(config(tmp_path)), load_encoder(config(folder))
    assert np.array_equal(older.encode_images(noise_images(2)), newer.encode_images(noise_images(2)))


@needs_models
def test_the_digest_moves_with_all_that_moves_a_feature(folder: Path, tmp_path: Path) -> None:
    digest = load_encoder(config(folder)).digest
    assert load_encoder(config(folder, batch=4)).digest == digest
    assert load_encoder(config(folder, transform="transformers")).digest != digest
    changed = {
        "merges.txt": lambda content: content + b"x y</w>\n",
        "model.safetensors": lambda content: content[:-1] + b"\x01",
        "preprocessor_config.json": lambda content: content.replace(b"0.48145466", b"0.5"),
    }
    for name, change in changed.items():
        path = Path(shutil.copytree(folder / "clip-vit-h-14", tmp_path / name / "clip-vit-h-14")) / name
        content: bytes = path.read_bytes()
        path.write_bytes(change(content))
        assert load_encoder(config(tmp_path / name)).digest != digest, name


@needs_models
def test_an_encoder_knows_its_own_digest_of_another_device(folder: Path, tmp_path: Path) -> None:
    here = load_encoder(config(folder))
    other = load_encoder(config(folder, precision="bfloat16"))
    assert isinstance(here, FoundationEncoder)
    assert here.is_same_space(other.digest)
    write_tiny_clip(tmp_path / "clip-vit-h-14", seed=1)
    assert not here.is_same_space(load_encoder(config(tmp_path)).digest)
    assert not here.is_same_space(load_encoder(config(folder, transform="transformers")).digest)


@needs_models
def test_the_towers_are_read_once_however_many_encoders_are_made(folder: Path) -> None:
    first, second = load_encoder(config(folder)), load_encoder(config(folder))
    first.encode_images(noise_images(1))
    second.encode_images(noise_images(1))
    assert first._towers is second._towers  # type: ignore[attr-defined]


class _CountingTowers:
    """Towers that count; features are sums of what they are given."""

    def __init__(self, batch: int = 2) -> None:
        self.batch = batch
        self.n_texts = 0

    def image_features(self, pixels: Float32Array) -> Float32Array:
        return np.stack([pixels.sum((1, 2, 3)), pixels[:, 0].sum((1, 2)), np.ones(len(pixels))], 1).astype(np.float32)

    def text_features(self, tokens: Int64Array) -> Float32Array:
        self.n_texts += len(tokens)
        return np.stack([tokens.sum(1), tokens[:, 0], np.ones(len(tokens))], 1).astype(np.float32)


def _counting(towers: _CountingTowers, cache: FrameCache | None = None) -> FoundationEncoder:
    def tokenise(texts: Any) -> Int64Array:
        return np.array([[len(text), ord(text[0]), 0, 0] for text in texts], np.int64)

    return FoundationEncoder("counting", RAW, lambda: towers, lambda: tokenise, lambda: {"files": "1"}, cache)


def test_a_text_is_encoded_once_and_remembered_on_disk(tmp_path: Path) -> None:
    towers = _CountingTowers()
    encoder = _counting(towers, FrameCache(tmp_path))
    first = encoder.encode_texts(["a", "b", "a", "c"])
    assert towers.n_texts == 3
    assert np.array_equal(first[0], first[2])
    encoder.encode_texts(["c", "d"])
    assert towers.n_texts == 4
    later = _CountingTowers()
    assert np.array_equal(_counting(later, FrameCache(tmp_path)).encode_texts(["a", "b", "a", "c"]), first)
    assert later.n_texts == 0


def test_a_feature_without_a_direction_is_an_error() -> None:
    with pytest.raises(DataError, match="1 features are zero or not finite"):
        unit_rows(np.array([[1, 0], [0, 0]], np.float32), "x")
    with pytest.raises(DataError, match="not finite"):
        unit_rows(np.array([[np.nan, 0]], np.float32), "x")


# ---- devices and batches


@needs_models
def test_batches_are_halved_when_the_memory_runs_out() -> None:
    import torch

    seen: list[int] = []

    def work(batch: Any) -> Float32Array:
        seen.append(len(batch))
        if len(batch) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return np.asarray(batch, np.float32)

    batches = Batches(8)
    assert np.concatenate(batches.run(range(7), work)).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert seen == [7, 3, 3, 1]
    assert batches.size == 3


@needs_models
def test_an_image_that_does_not_fit_alone_is_an_error_in_one_line() -> None:
    import torch

    def work(batch: Any) -> Float32Array:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.raises(ConfigError, match="no memory for a batch of 1"):
        Batches(4).run(range(3), work)


def test_an_error_of_the_network_is_not_taken_for_want_of_memory() -> None:
    def work(batch: Any) -> Float32Array:
        raise RuntimeError("shapes do not fit")

    with pytest.raises(RuntimeError, match="shapes"):
        Batches(4).run(range(3), work)


def test_jobs_take_the_gpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0) if device == "cuda:0" else (6, 1))
    assert [device_for("cuda", k) for k in range(5)] == ["cuda:0", "cuda:1", "cuda:2", "cuda:0", "cuda:1"]
    assert device_for("cuda:1", 7) == "cuda:1"
    with pytest.raises(ConfigError, match="there are 3 GPUs here"):
        device_for("cuda:3", 0)
    assert precision_for("auto", "cuda:0") == "float16"
    assert precision_for("auto", "cuda:1") == "float32"
    assert precision_for("bfloat16", "cuda:1") == "bfloat16"


def test_the_first_batch_follows_from_the_memory_that_the_weights_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    total = type("Properties", (), {"total_memory": 10_000})
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: total)
    # (10,000 - 2,000) / 2 = 4,000 for images of 300 each: 13, of which the power of two is 8
    assert first_batch("cuda:0", 300, 2_000) == 8
    assert first_batch("cuda:0", 1, 2_000) == 256
    assert first_batch("cuda:0", 10**9, 2_000) == 1
    assert first_batch("cpu", 300, 2_000) == 1


def test_the_cpu_takes_float32_and_a_gpu_that_is_not_here_is_one_line() -> None:
    assert device_for("cpu", 3) == "cpu"
    assert precision_for("auto", "cpu") == "float32"
    torch = pytest.importorskip("torch", reason="torch is not installed")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(ConfigError, match="torch sees no GPU here"):
        device_for("cuda", 0)


# ---- what can be wrong


class _Payload:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, ("raise SystemExit('the payload ran')",)


@needs_models
@pytest.mark.parametrize("name", ["pytorch_model.bin", "weights.pt", "weights.pth"])
def test_a_weights_file_that_holds_code_is_refused(tmp_path: Path, name: str) -> None:
    import torch

    for form in (pickle.dumps({"a": _Payload()}), None):
        if form is None:
            torch.save({"a": _Payload()}, tmp_path / name)
        else:
            (tmp_path / name).write_bytes(form)
        with pytest.raises(DataError, match=r"holds more than plain tensors|not readable as torch weights"):
            read_weights(tmp_path / name)


@needs_models
def test_an_encoder_folder_with_a_payload_is_refused_before_it_is_loaded(folder: Path, tmp_path: Path) -> None:
    import torch

    target = tmp_path / "clip-vit-h-14"
    shutil.copytree(folder / "clip-vit-h-14", target)
    (target / "model.safetensors").unlink()
    torch.save({"a": _Payload()}, target / "pytorch_model.bin")
    with pytest.raises(DataError, match="can run code"):
        load_encoder(config(tmp_path)).encode_images(noise_images(1))


@needs_models
def test_weights_of_another_model_are_an_error_and_never_random(folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "clip-vit-h-14"
    shutil.copytree(folder / "clip-vit-h-14", target)
    shutil.copy(folder / "siglip-base-224" / "model.safetensors", target / "model.safetensors")
    with pytest.raises(DataError, match=r"model\.safetensors: (lacks \d+ tensors|cannot be loaded)"):
        load_encoder(config(tmp_path)).encode_images(noise_images(1))


@needs_models
def test_damaged_weights_are_one_line(folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "clip-vit-h-14"
    shutil.copytree(folder / "clip-vit-h-14", target)
    weights = target / "model.safetensors"
    for content in (b"", b"\xff" * 64, weights.read_bytes()[:2000]):
        weights.write_bytes(content)
        with pytest.raises(DataError, match=r"model\.safetensors: cannot be loaded"):
            load_encoder(config(tmp_path)).encode_images(noise_images(1))


@needs_models
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"model_type": "bert"}, "an encoder is 'clip' or 'siglip'"),
        ({"projection_dim": 10**9}, "projection_dim is 1000000000"),
        ({"vision_config": {"num_hidden_layers": 10**6}}, "num_hidden_layers is 1000000"),
        ({"vision_config": [1]}, "vision_config is no table"),
        ({"vision_config": {"image_size": 64}}, "the image tower takes 64 px"),
    ],
)
def test_a_configuration_without_sense_is_refused_before_anything_is_made(
    folder: Path, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    target = tmp_path / "clip-vit-h-14"
    shutil.copytree(folder / "clip-vit-h-14", target)
    content = json.loads((target / "config.json").read_text())
    (target / "config.json").write_text(json.dumps(content | change))
    with pytest.raises(DataError, match=said):
        load_encoder(config(tmp_path))


@needs_models
def test_a_damaged_tokenizer_is_one_line(folder: Path, tmp_path: Path) -> None:
    for name, file in (("clip-vit-h-14", "vocab.json"), ("siglip-base-224", "tokenizer.json")):
        target = tmp_path / name
        shutil.copytree(folder / name, target)
        (target / file).write_text("{}")
        with pytest.raises(DataError, match="tokenizer"):
            load_encoder(config(tmp_path, name)).encode_texts(["chair"])


def test_a_setting_that_would_do_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the embedded encoder has its own"):
        load_encoder(ModelsConfig(runtime="onnx"))
    with pytest.raises(ConfigError, match="runs on the CPU alone"):
        load_encoder(ModelsConfig(device="cuda"))
    assert load_encoder(ModelsConfig(encoder="embedded", device="cuda"), default="clip-vit-h-14").dim == 128
    with pytest.raises(ValueError, match="provider belongs to runtime"):
        ModelsConfig(provider="cpu")
    with pytest.raises(ValueError, match="does not run on device"):
        ModelsConfig(runtime="onnx", provider="cuda")
    with pytest.raises(ValueError, match="exported encoders are float32"):
        ModelsConfig(runtime="onnx", precision="float16")


@needs_models
def test_without_transformers_one_line_names_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ModelMissing, match=r"needs the package 'transformers': pip install 'su3d-bench\[models\]'"):
        load_encoder(config(folder))


@needs_models
def test_without_open_clip_one_line_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "clip-vit-h-14").mkdir()
    (tmp_path / "clip-vit-h-14" / "open_clip_model.safetensors").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "open_clip", None)
    with pytest.raises(ModelMissing, match="needs the package 'open_clip': pip install open_clip_torch"):
        load_encoder(config(tmp_path, runtime="open_clip"))


@needs_models
def test_the_space_of_the_tiny_encoder_is_known_without_its_weights(folder: Path) -> None:
    assert load_encoder(config(folder)).dim == DIM
