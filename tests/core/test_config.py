from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.config import (
    RunConfig,
    Setting,
    Settings,
    check_keys,
    flatten,
    nest,
    read_assignments,
    read_file,
    resolve,
    write_toml,
)
from su3d_bench.core.errors import ConfigError


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    depth: float = 1.0


class Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    top_m: int = 5
    ratios: tuple[float, ...] = (1.0,)
    folder: Path | None = None
    inner: Inner = Inner()


def file_settings(tmp_path: Path, text: str) -> Settings:
    path = tmp_path / "run.toml"
    path.write_text(text)
    return read_file(path)


def test_later_source_overrides_and_each_value_records_its_source(tmp_path: Path) -> None:
    settings = file_settings(tmp_path, "[method.opensu3d]\ntop_m = 7\nratios = [1, 2]\n")
    settings += read_assignments(["opensu3d.top_m=10"], ["opensu3d"], [])
    model = resolve(settings, ("method", "opensu3d"), Model)
    assert (model.top_m, model.ratios) == (10, (1.0, 2.0))
    assert settings.source(("method", "opensu3d", "top_m")) == "--set opensu3d.top_m"
    assert settings.source(("method", "opensu3d", "ratios")) == f"{tmp_path}/run.toml:3"
    assert settings.source(("method", "opensu3d", "folder")) == "default"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = 1\nmetod = 2\n", "run.toml:2: unknown key 'metod'; did you mean 'method'?"),
        (
            "[method]\nopensu3d = 2\n",
            "run.toml:2: 'method.opensu3d' is a section; write [method.opensu3d] and its keys",
        ),
        ("seed = 1\nseed\n", "run.toml:2: not valid TOML: expected '=' after a key in a key/value pair"),
    ],
)
def test_invalid_file_is_reported_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_keys(file_settings(tmp_path, text))
    assert str(error.value).startswith(f"{tmp_path}/{message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[method.x]\ntop_n = 3\n", "run.toml:2: unknown key 'top_n'; did you mean 'top_m'?"),
        ("[method.x.inner]\ndeph = 3\n", "run.toml:2: unknown key 'deph'; did you mean 'depth'?"),
        ("[method.x]\n\ntop_m = '3'\n", "run.toml:3: x.top_m = '3': input should be a valid integer"),
    ],
)
def test_invalid_value_is_reported_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        resolve(file_settings(tmp_path, text), ("method", "x"), Model)
    assert str(error.value).startswith(f"{tmp_path}/{message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("opensu3d.top_m", "--set opensu3d.top_m: expected KEY=VALUE, such as opensu3d.top_m=10"),
        ("opensu3.top_m=1", "--set opensu3.top_m=1: 'opensu3' is not a method or dataset of this run; "),
        ("seed=3", "--set seed=3: 'seed' has its own flag: --seed"),
        ("x.y=3", "--set x.y=3: 'x' is not a method or dataset of this run; known: opensu3d, rooms, perception"),
    ],
)
def test_invalid_assignment_is_explained(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        read_assignments([text], ["opensu3d", "opensu3d"], ["rooms"])
    assert str(error.value).startswith(message)


def test_assignment_also_accepts_the_key_form_of_files() -> None:
    texts = ["method.opensu3d.top_m=1", "dataset.rooms.noise=2", "opensu3d.k=3"]
    settings = read_assignments(texts, ["opensu3d"], ["rooms"])
    paths = [("method", "opensu3d", "top_m"), ("dataset", "rooms", "noise"), ("method", "opensu3d", "k")]
    assert [entry.path for entry in settings.entries] == paths
    with pytest.raises(ConfigError, match=r"'method' is not a method or dataset of this run"):
        read_assignments(["method.opensu3=1"], ["opensu3d"], ["rooms"])


def test_assignments_accept_toml_values_and_plain_text() -> None:
    settings = read_assignments(
        ["a.x=[1, 2.5]", "a.y=plain text", "a.z=true", "perception.q.r=-1e-3", 'rooms.s="12"'], ["a"], ["rooms"]
    )
    assert [(entry.path, entry.value) for entry in settings.entries] == [
        (("method", "a", "x"), [1, 2.5]),
        (("method", "a", "y"), "plain text"),
        (("method", "a", "z"), True),
        (("perception", "q", "r"), -1e-3),
        (("dataset", "rooms", "s"), "12"),
    ]


def test_run_values_out_of_range_are_rejected() -> None:
    settings = Settings((Setting(("stride",), -1, "--stride"),))
    with pytest.raises(ConfigError, match=r"^--stride: stride = -1: input should be greater than or equal to 0$"):
        resolve(settings, (), RunConfig)


def test_written_toml_reads_back_unchanged() -> None:
    table = {
        "seed": 3,
        "scenes": ["rooms/*", 'quote " and \\ back'],
        "is_on": True,
        "size": {"width m": 0.1, "big": 1e300, "none": []},
        "deep": {"er": {"x": -1, "text": "tab\tnew\nline ü"}},
        "limit": float("inf"),
    }
    text = write_toml([(path, value, "default") for path, value in flatten(table)])
    assert tomllib.loads(text) == table
    assert "seed = 3  # default" in text
    assert nest(flatten(table)) == table
