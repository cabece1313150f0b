"""Where models are searched, in which order, and the error for a missing one."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, ModelMissing
from su3d_bench.perception.models import files as model_files
from su3d_bench.perception.models.catalogue import MODELS, PROFILE_MODELS
from su3d_bench.perception.models.files import file_sha256, locate

CLIP_FILES = ("model.safetensors", "config.json", "preprocessor_config.json", "tokenizer.json")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """All searched places are below the test's own folder."""
    monkeypatch.setenv("SU3D_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    return tmp_path


def fill(folder: Path, names: tuple[str, ...] = CLIP_FILES) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text(name)
    return folder


def snapshot(root: Path, repository: str, revision: str, *, is_main: bool) -> Path:
    folder = root / f"models--{repository.replace('/', '--')}"
    if is_main:
        (folder / "refs").mkdir(parents=True, exist_ok=True)
        (folder / "refs" / "main").write_text(revision + "\n")
    return fill(folder / "snapshots" / revision)


def test_every_entry_is_complete() -> None:
    assert {entry.kind for entry in MODELS.values()} == {"encoder", "segmenter", "detector", "tagger"}
    for name, entry in MODELS.items():
        assert entry.name == name
        assert entry.licence in {"MIT", "Apache-2.0"}
        assert len({form.form for form in entry.forms}) == len(entry.forms)
        assert all(len(digest) == 64 for form in entry.forms for digest in form.sha256.values())
        # float32: four bytes per parameter, as in the published files
        published = entry.forms[-1 if name == "ram-plus" else 0].size_mb  # RAM++'s file has more than is used
        assert abs(entry.memory_mb(4) - published) / published < 0.05, name
    assert {name for names in PROFILE_MODELS.values() for name in names} <= set(MODELS)


def test_models_are_found_by_short_or_repository_name(home: Path) -> None:
    for place in ("clip-vit-h-14", "laion/CLIP-ViT-H-14-laion2B-s32B-b79K", "CLIP-ViT-H-14-laion2B-s32B-b79K"):
        folder = fill(home / "models" / place)
        found = locate("clip-vit-h-14")
        assert (found.folder, found.form.form, found.weights.name) == (folder, "transformers", "model.safetensors")
        for name in CLIP_FILES:
            (folder / name).unlink()


def test_hugging_face_cache_is_searched_last_at_main_revision(home: Path) -> None:
    repository = "openai/clip-vit-base-patch32"
    main = snapshot(home / "hf" / "hub", repository, "aa11", is_main=True)
    snapshot(home / "hf" / "hub", repository, "bb22", is_main=False)
    assert locate("clip-vit-b-32").folder == main
    ours = snapshot(home / "models", repository, "cc33", is_main=True)
    assert locate("clip-vit-b-32").folder == ours
    nearest = fill(home / "models" / "clip-vit-b-32")
    assert locate("clip-vit-b-32").folder == nearest


def test_revision_outside_the_cache_is_not_followed(home: Path) -> None:
    outside = fill(home / "outside")
    folder = home / "hf" / "hub" / "models--openai--clip-vit-base-patch32"
    (folder / "refs").mkdir(parents=True)
    (folder / "snapshots").mkdir()
    (folder / "refs" / "main").write_text(os.path.relpath(outside, folder / "snapshots"))
    with pytest.raises(ModelMissing):
        locate("clip-vit-b-32")


def test_safetensors_are_preferred_and_vocab_files_are_alternatives(home: Path) -> None:
    folder = home / "models" / "clip-vit-b-32"
    fill(folder, ("pytorch_model.bin", "config.json", "preprocessor_config.json", "vocab.json", "merges.txt"))
    assert locate("clip-vit-b-32").weights.name == "pytorch_model.bin"
    fill(folder, ("model.safetensors",))
    assert locate("clip-vit-b-32").weights.name == "model.safetensors"
    (folder / "merges.txt").unlink()
    with pytest.raises(ModelMissing):
        locate("clip-vit-b-32")


def test_configured_path_is_the_only_one_used(home: Path) -> None:
    fill(home / "models" / "clip-vit-b-32")
    mine = fill(home / "mine")
    assert locate("clip-vit-b-32", path=mine).folder == mine
    assert locate("clip-vit-b-32", path=mine / "model.safetensors").folder == mine
    (mine / "config.json").unlink()
    with pytest.raises(
        ModelMissing, match=r"mine lacks config\.json; run: su3d-bench models fetch clip-vit-b-32 \(0\.6 GB\)"
    ):
        locate("clip-vit-b-32", path=mine)
    with pytest.raises(ModelMissing, match=r"missing .*absent; correct the path, or run: su3d-bench models fetch"):
        locate("clip-vit-b-32", path=home / "absent")
    with pytest.raises(ConfigError, match=r"is not a supported file; use a folder with model\.safetensors"):
        locate("clip-vit-b-32", path=fill(home / "other", ("x.bin",)) / "x.bin")
    renamed = fill(home / "other", ("my_sam.pth",)) / "my_sam.pth"
    assert locate("sam-vit-h", path=renamed).weights == renamed


def test_missing_model_error_names_the_download_command(home: Path) -> None:
    with pytest.raises(ModelMissing) as caught:
        locate("clip-vit-h-14")
    assert str(caught.value) == (
        f"model 'clip-vit-h-14': not found below {home / 'models'}; run: su3d-bench models fetch clip-vit-h-14 (3.9 GB)"
    )
    with pytest.raises(ModelMissing, match=r"run: python tools/export_onnx\.py ram-plus --checkout DIR"):
        locate("ram-plus", ("onnx",))


def test_large_file_digest_is_recomputed_only_after_changes(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = home / "weights.safetensors"
    path.write_bytes(bytes(2**20 + 1))
    n_read: list[Path] = []

    def counted(path: Path) -> str:
        n_read.append(path)
        return digest_file(path)

    monkeypatch.setattr(model_files, "digest_file", counted)
    first = file_sha256(path)
    assert (file_sha256(path), len(n_read)) == (first, 1)
    path.write_bytes(bytes(2**20 + 2))
    assert file_sha256(path) == hashlib.sha256(bytes(2**20 + 2)).hexdigest()
    assert len(n_read) == 2
    for note in model_files.digest_cache().iterdir():
        note.write_text("{")  # a damaged note counts as absent
    file_sha256(path)
    assert len(n_read) == 3
