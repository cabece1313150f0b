"""Exported models: file checks and providers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from tiny_models import write_tagger

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.masks.grounded_sam import (
    RAM_FORMAT,
    RAM_MODEL,
    RAM_TAG_LIST,
    exported_files,
    wrong_tagger,
)
from su3d_bench.perception.models.onnx import open_session


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An exported tagger with its manifest."""
    made = write_tagger(tmp_path / "ram-plus-onnx", ("chair", "table"))
    files = {name: digest_file(made / name) for name in (RAM_MODEL, RAM_TAG_LIST)}
    (made / "manifest.json").write_text(json.dumps({"format": RAM_FORMAT, "name": "ram-plus", "files": files}))
    return made


def test_changed_or_missing_file_of_an_export_is_reported(folder: Path) -> None:
    files = locate("ram-plus", ("onnx",), folder=folder.parent)
    assert wrong_tagger(files) == []
    changed = folder / RAM_MODEL
    changed.write_bytes(changed.read_bytes() + b"\0")
    assert wrong_tagger(files) == [f"{changed}: does not match the manifest; export it again"]
    changed.unlink()
    assert wrong_tagger(files) == [f"{changed}: is missing; export it again"]


@pytest.mark.parametrize(
    ("key", "value", "printed"),
    [
        ("format", "x", "format is 'x'"),
        ("files", {"../x.onnx": "0"}, "files must be names inside the folder"),
        ("files", {"ram_plus.onnx": 5}, "files: ram_plus.onnx is 5: Input should be a valid string"),
    ],
)
def test_invalid_manifest_gives_one_line_error(folder: Path, key: str, value: Any, printed: str) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(DataError, match=printed):
        exported_files(path)


def test_missing_provider_and_damaged_file_give_one_line_errors(folder: Path, tmp_path: Path) -> None:
    import onnxruntime

    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        with pytest.raises(ModelMissing, match="provider 'cuda': not available in this onnxruntime \\(cpu"):
            open_session(folder / RAM_MODEL, "cuda")
    with pytest.raises(ModelMissing, match="file not found"):
        open_session(tmp_path / "x.onnx")
    (tmp_path / "x.onnx").write_bytes(b"no protobuf")
    with pytest.raises(DataError, match=r"x\.onnx: ONNX Runtime cannot load it"):
        open_session(tmp_path / "x.onnx")
