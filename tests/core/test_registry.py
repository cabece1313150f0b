"""Classes are checked when they are loaded: required members, and misspelt optional ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from su3d_bench.core import registry
from su3d_bench.core.errors import ConfigError

DATASET = """
class Mine:
    name = "mine"
    label_space = "replica"
    variants = ()
    Options = None
    def scenes(self): ...
    def files(self, scene): ...
    def digest(self, scene): ...
    def info(self, scene, stride): ...
    def frames(self, scene, stride): ...
    def ground_truth(self, scene, variant): ...
    def instance_mesh(self, scene): ...
"""
METHOD = """
class Mine:
    name = "mine"
    Config = None
    def start(self, scene): ...
    def update(self, frame, detections, timer): ...
    def finish(self): ...
"""
TEXT = {"dataset": DATASET, "method": METHOD}


def load_text(folder: Path, kind: str, text: str) -> object:
    (folder / "mine.py").write_text(text)
    return registry.load(kind, f"{folder}/mine.py:Mine")


@pytest.mark.parametrize("kind", ["dataset", "method"])
def test_every_built_in_class_passes_the_checks(kind: str) -> None:
    for name in registry.BUILT_IN[kind]:
        assert registry.load(kind, name).name == name


@pytest.mark.parametrize(
    ("kind", "line", "meant"),
    [
        ("dataset", "def qeries(self, scene): ...", "queries"),
        ("dataset", "render_frames = True", "renders_frames"),
        ("method", "presest = {}", "presets"),
        ("method", "def recieve_tools(self, tools): ...", "receive_tools"),
        ("method", "n_instance: int", "n_instances"),
    ],
)
def test_misspelt_ability_is_reported_with_the_right_name(tmp_path: Path, kind: str, line: str, meant: str) -> None:
    with pytest.raises(ConfigError, match=rf"mine.py:Mine': a {kind} has no '\w+'; did you mean '{meant}'\?"):
        load_text(tmp_path, kind, f"{TEXT[kind]}    {line}\n")


@pytest.mark.parametrize(
    ("kind", "member"),
    [
        ("dataset", "digest"),
        ("dataset", "Options"),
        ("method", "Config"),
        ("method", "name"),
    ],
)
def test_missing_member_is_reported(tmp_path: Path, kind: str, member: str) -> None:
    text = "\n".join(line for line in TEXT[kind].splitlines() if f" {member}" not in line)
    with pytest.raises(ConfigError, match=rf"'{member}' is missing; a {kind} has .*{member}"):
        load_text(tmp_path, kind, text)


@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        ("dataset", ["def tree(self): ...", "def object_boxes(self): ...", "image_domain = 'camera'", "surface = 1"]),
        ("method", ["points = ()", "instances = ()", "def reset(self): ...", "thresholds = 3", "_presest = {}"]),
        ("method", ["presets = {}", "presest = {}"]),
        ("method", ["closed = False", "def preset(self): ..."]),
    ],
)
def test_other_member_names_are_accepted(tmp_path: Path, kind: str, lines: list[str]) -> None:
    assert load_text(tmp_path, kind, TEXT[kind] + "".join(f"    {line}\n" for line in lines))
