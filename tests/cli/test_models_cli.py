"""The commands ``su3d-bench models`` with available, missing and invalid models."""

from __future__ import annotations

import json
import shutil
import socket
from pathlib import Path

import pytest
from tiny_models import CLIP_DIM, write_tiny_clip

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ModelMissing, PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.evaluation.texts import encoder_for
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.perception.models.catalogue import MODELS
from su3d_bench.perception.models.config import ModelsConfig
from su3d_bench.perception.models.loading import load_encoder
from su3d_bench.runs.finished import encoder_of
from su3d_bench.store.run_folder import RunFolder

HEAVY = ("torch", "transformers", "onnxruntime", "open3d", "sklearn", "pandas", "matplotlib", "numba")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No models are available, and every network connection is an error."""
    monkeypatch.setenv("SU3D_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)

    def refuse(*_: object) -> None:
        raise AssertionError("a models command accessed the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    return tmp_path


@pytest.fixture(scope="module")
def tiny_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_clip(tmp_path_factory.mktemp("tiny") / "clip-vit-b-32")


@pytest.fixture
def found(home: Path, tiny_clip: Path) -> Path:
    """The tiny encoder in the folder of ``clip-vit-b-32``."""
    return Path(shutil.copytree(tiny_clip, home / "models" / "clip-vit-b-32"))


def test_list_shows_every_model_with_size_licence_and_state(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["models", "list"]) == 0
    out, err = capsys.readouterr()
    lines = {line.split()[0]: line for line in out.splitlines()}
    assert set(lines) == set(MODELS)
    assert lines["clip-vit-h-14"].split()[1:] == ["encoder", "3.9", "GB", "MIT", "missing", "(profile", "paper)"]
    assert f"{len(MODELS)} missing; su3d-bench models check clip-vit-h-14 shows what to download" in err


def test_check_prints_the_digests_of_a_complete_model(found: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", "check"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0] == f"clip-vit-b-32 (transformers): {found}: OK"
    assert main(["models", "check", "clip-vit-b-32", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["problems"] == []
    assert set(row["sha256"]) >= {"model.safetensors", "config.json", "preprocessor_config.json"}
    assert all(f"{digest}  {name}" in out for name, digest in row["sha256"].items())


def test_check_reports_faults_with_exit_code_1(found: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (found / "config.json").write_text('{"model_type": "bert"}')
    assert main(["models", "check", "clip-vit-b-32"]) == 1
    assert "config.json: model_type is 'bert'" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["models", "check"], "no models found"),
        (["models", "check", "clip-h"], "unknown model 'clip-h'"),
        (["models", "list", "--set", "perception.models.folder"], "expected KEY=VALUE"),
    ],
)
def test_invalid_request_is_a_one_line_error(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert line in err
    assert len(err.splitlines()) == 1


def test_invalid_device_is_an_early_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--scenes", "rooms/living0", "--device", "gpu", "--dry-run"]) == 2
    assert "--device: models.device = 'gpu': expected cpu, cuda or cuda:N" in capsys.readouterr().err


def _finished_run(folder: Path, made_by: str | None, made_with: str) -> RunFolder:
    folder.mkdir(exist_ok=True)
    (folder / "run.json").write_text(json.dumps({"encoder": made_by, "encoder_digest": made_with}))
    (folder / "run.toml").write_text('[perception.models]\nencoder = "clip-vit-b-32"\nprecision = "bfloat16"\n')
    return RunFolder(folder)


def test_query_uses_the_encoder_of_the_run(found: Path, home: Path) -> None:
    made = load_encoder(ModelsConfig(encoder="clip-vit-b-32", precision="bfloat16"))
    encoder = encoder_of(_finished_run(home / "run", made.name, made.digest))
    # texts are encoded in float32, whatever precision the images used
    assert encoder.digest == load_encoder(ModelsConfig(encoder="clip-vit-b-32")).digest != made.digest
    assert encoder.encode_texts(["chair"]).shape == (1, CLIP_DIM)


def test_a_query_over_features_of_other_weights_is_an_error(found: Path, home: Path) -> None:
    with pytest.raises(PredictionError, match=r"made by encoder ViT-B-32/openai \(000000000000\), not by ViT-B-32/op"):
        encoder_of(_finished_run(home / "run", "ViT-B-32/openai", "0" * 64))
    with pytest.raises(PredictionError, match="not by su3d-embedded"):
        encoder_of(_finished_run(home / "run", "su3d-embedded", "0" * 64))
    with pytest.raises(ModelMissing, match="model 'clip-vit-l-14': not found"):
        encoder_of(_finished_run(home / "run", "ViT-L-14/openai", "0" * 64))


def test_evaluation_names_features_with_the_protocol_encoder_if_available(tiny_clip: Path, home: Path) -> None:
    rules = load_protocol("replica-conceptgraphs-ex6")
    assert "which is not available" in str(encoder_for(rules, CLIP_DIM, None, is_own=False))
    shutil.copytree(tiny_clip, home / "models" / "clip-vit-h-14")
    encoder = encoder_for(rules, CLIP_DIM, None, is_own=False)
    assert isinstance(encoder, Encoder)
    assert encoder.name == rules.encoder
    assert "the features have 25 dimensions" in str(encoder_for(rules, 25, None, is_own=False))
