"""RAM++ exported by the code of a checkout, in a process of its own: what is written, what is refused."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_models import needs_models
from tiny_ram_plus import TAGS, THRESHOLDS, tiny_tensors, write_checkout

from su3d_bench.cli.main import main
from su3d_bench.core.errors import CheckFailed, ConfigError, DataError
from su3d_bench.perception.models.config import ModelsConfig, PaperConfig
from su3d_bench.perception.models.loading import _tagger
from su3d_bench.perception.models.masks.tagging import OnnxRamTagger
from su3d_bench.perception.models.onnx.isolated import NOTE, made_environment
from su3d_bench.perception.models.onnx.ram_plus import LARGEST_DIFFERENCE, compared, made_images

pytestmark = needs_models
RGB = np.random.default_rng(5).integers(0, 256, (60, 80, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout, weights, and the folder ``models/ram-plus-onnx`` that the command left."""
    import torch

    folder = tmp_path_factory.mktemp("ram")
    write_checkout(folder / "checkout")
    torch.save({"model": tiny_tensors(), "epoch": 4}, folder / "ram_plus_swin_large_14m.pth")
    assert main(words(folder)) == 0
    return folder


def words(folder: Path, *more: str) -> list[str]:
    asked = ["models", "export", "ram-plus", "--checkout", str(folder / "checkout"), "--python", sys.executable]
    weights = ["--weights", str(folder / "ram_plus_swin_large_14m.pth")]
    return [*asked, *weights, "--out", str(folder / "models" / "ram-plus-onnx"), *more]


def test_the_export_holds_the_network_its_tags_and_what_it_was_made_from(place: Path) -> None:
    folder = place / "models" / "ram-plus-onnx"
    assert {file.name for file in folder.iterdir()} == {"ram_plus.onnx", "ram_tag_list.txt", "manifest.json"}
    assert tuple((folder / "ram_tag_list.txt").read_text(encoding="utf-8").splitlines()) == TAGS
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["n_tags"] == len(TAGS) and set(manifest["files"]) == {"ram_plus.onnx", "ram_tag_list.txt"}
    assert set(manifest["source"]["files"]) == {"ram_plus_swin_large_14m.pth"}
    assert (
        "ram/models/ram_plus.py" in manifest["code"] and manifest["made_with"]["torch"] == manifest["source"]["torch"]
    )
    (parity,) = manifest["parity"]
    assert parity["n_values"] == 3 * len(TAGS) and parity["max_abs_difference"] <= LARGEST_DIFFERENCE


def test_the_tagger_names_what_is_above_each_tags_own_threshold(place: Path) -> None:
    models = ModelsConfig(folder=place / "models")
    tagger = _tagger(PaperConfig(tagger="ram-onnx"), models, None, "cpu")  # type: ignore[arg-type]
    assert isinstance(tagger, OnnxRamTagger)
    session = tagger._session()
    (logit,) = session.run(["logit"], {"image": made_images()[:1]})
    _, other = session.run(None, {"image": made_images()[1:2]})
    assert (logit != other).any(), "the image is looked at"
    tags = tagger.tags(RGB)
    assert "3D glasses" in tags and "lamp" not in tags, "thresholds of 0 and 1"
    assert main(["models", "check", "ram-plus", "--set", f"perception.models.folder={place / 'models'}"]) == 0


def test_an_export_whose_files_were_changed_is_not_run(place: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(place / "models" / "ram-plus-onnx", tmp_path / "ram-plus-onnx")
    (folder / "ram_tag_list.txt").write_text("\n".join(reversed(TAGS)))
    models = ModelsConfig(folder=tmp_path)
    with pytest.raises(DataError, match=r"ram_tag_list\.txt: is not the file that the manifest describes"):
        _tagger(PaperConfig(tagger="ram-onnx"), models, None, "cpu")  # type: ignore[arg-type]
    assert main(["models", "check", "ram-plus", "--set", f"perception.models.folder={tmp_path}"]) == 1
    (folder / "manifest.json").unlink()  # as others export it
    _tagger(PaperConfig(tagger="ram-onnx"), models, None, "cpu")  # type: ignore[arg-type]


class Session:
    """Answers as ONNX Runtime does for an exported RAM++, beside the truth by ``gap``."""

    def __init__(self, logit: np.ndarray[Any, Any], gap: float = 0.0, wrong_tag: int | None = None) -> None:
        self.rows = iter(logit.astype(np.float32))
        self.gap, self.wrong_tag = gap, wrong_tag

    def run(self, names: list[str], fed: dict[str, Any]) -> list[np.ndarray[Any, Any]]:
        row = next(self.rows) + np.float32(self.gap)
        tags = (1 / (1 + np.exp(-row)) > np.array(THRESHOLDS, np.float32)).astype(np.float32)
        if self.wrong_tag is not None:
            tags[self.wrong_tag] = 1 - tags[self.wrong_tag]
        return [tags[None], row[None]]


TAG = np.array([[False, True, True, False, True]])
LOGIT = np.array([[-1.4, 2.2, 0.0002, -0.8, 2.2]], np.float32)


@pytest.mark.parametrize(
    ("gap", "wrong_tag", "said"),
    [
        (2e-3, None, "differ between torch and ONNX Runtime by 2.00e-03; tolerance 1e-03"),
        (float("nan"), None, "by nan; tolerance"),
        (0.0, 1, "1 tags differ between torch and ONNX Runtime"),
    ],
)
def test_answers_beyond_the_tolerance_are_refused(gap: float, wrong_tag: int | None, said: str) -> None:
    session = Session(LOGIT, gap, wrong_tag)
    with pytest.raises(CheckFailed, match=said):
        compared(session, made_images()[:1], LOGIT, TAG, np.array(THRESHOLDS, np.float32))


def test_a_last_bit_may_decide_a_tag_within_the_tolerance_of_its_threshold() -> None:
    parity, n_undecided = compared(
        Session(LOGIT, 0.0, 2), made_images()[:1], LOGIT, TAG, np.array(THRESHOLDS, np.float32)
    )
    assert parity.max_abs_difference == 0.0 and n_undecided == 1


def script(path: Path, line: str) -> Path:
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)
    return path


def test_what_cannot_be_exported_is_one_line_and_leaves_nothing(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*changed: str) -> str:
        code = main([*words(place), *changed, "--out", str(tmp_path / "out")])
        err = capsys.readouterr().err
        assert code in (1, 2) and len(err.splitlines()) == 1
        assert not any((tmp_path / "out").glob("*")), "nothing half written is left"
        return err

    other = shutil.copytree(place / "checkout", tmp_path / "other")
    (other / "ram/data/ram_tag_list_threshold.txt").unlink()
    assert "has no ram/data/ram_tag_list_threshold.txt; expected a clone" in said("--checkout", str(other))
    assert "no-python: cannot be started (No such file or directory)" in said("--python", str(tmp_path / "no-python"))
    failing = script(tmp_path / "python", "echo 'ValueError: lacks 11 tensors' >&2; exit 1")
    assert "ram_plus_program.py failed: ValueError: lacks 11 tensors" in said("--python", str(failing))
    (tmp_path / "weights.pth").write_bytes(b"PK")
    assert "weights.pth: holds more than plain tensors" in said("--weights", str(tmp_path / "weights.pth"))
    assert "give --environment DIR, and pip installs torch==" in said("--environment", str(tmp_path / "environment"))


def test_flags_of_the_authors_code_belong_to_ram_plus_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main(["models", "export", "clip-vit-h-14", "--python", "python3", *out]) == 2
    assert "needs no code but ours; leave --checkout, --python and --environment out" in capsys.readouterr().err
    assert main(["models", "export", "ram-plus", *out]) == 2
    assert "git clone https://github.com/xinyu1205/recognize-anything and name" in capsys.readouterr().err


def test_an_environment_that_is_there_is_taken_and_another_left_alone(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").touch()
    with pytest.raises(ConfigError, match="this command did not make it; name another folder"):
        made_environment(tmp_path, ("torch==1",))
    (tmp_path / NOTE).write_text('{"packages": ["torch==1"]}')
    assert made_environment(tmp_path, ("torch==1",)) == tmp_path / "bin" / "python"
    with pytest.raises(ConfigError, match="is an environment of other versions"):
        made_environment(tmp_path, ("torch==2",))


def test_an_environment_that_pip_cannot_fill_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a python of which the environment's pip finds nothing."""
    pip = "#!/bin/sh\\necho 'ERROR: No matching distribution' >&2\\nexit 1\\n"
    making = f'mkdir -p "$3/bin"; printf "{pip}" > "$3/bin/python"; chmod +x "$3/bin/python"'
    monkeypatch.setattr(sys, "executable", str(script(tmp_path / "python", making)))
    with pytest.raises(CheckFailed, match="pip cannot install nothing==1: ERROR: No matching distribution"):
        made_environment(tmp_path / "environment", ("nothing==1",))
    assert [file.name for file in tmp_path.iterdir()] == ["python"]
