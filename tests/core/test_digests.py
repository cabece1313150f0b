"""Keys of code: everything that can move a number counts, in whatever folder; what only shows numbers does not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from su3d_bench.core import digests


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A small package in place of ours."""
    for name in ("metrics/area.py", "metrics/rules/area.toml", "datasets/rooms/labels.json", "cli/run.py"):
        write(tmp_path / name, "x = 1\n")
    monkeypatch.setattr(digests, "PACKAGE_ROOT", tmp_path)
    yield tmp_path
    forget()


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def forget() -> None:
    digests.code_digest.cache_clear()
    digests.package_digest.cache_clear()


def key() -> str:
    forget()
    return digests.code_digest()


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("metrics/area.py", True),
        ("metrics/rules/area.toml", True),
        ("metrics/new/deep/median.py", True),
        ("datasets/rooms/labels.json", True),
        ("one.py", True),
        ("cli/run.py", False),
        ("reports/page.js", False),
        ("metrics/__pycache__/area.cpython-311.pyc", False),
        ("metrics/.notes", False),
        ("metrics/README.md", False),
    ],
)
def test_what_can_move_a_number_moves_the_key(package: Path, name: str, counts: bool) -> None:
    before = key()
    write(package / name, "x = 2\n")
    assert (key() != before) == counts


def test_a_renamed_file_moves_the_key(package: Path) -> None:
    before = key()
    (package / "metrics/area.py").rename(package / "metrics/size.py")
    assert key() != before


def test_a_part_has_a_key_of_its_own_and_nothing_has_none(package: Path) -> None:
    before = digests.package_digest("metrics")
    write(package / "datasets/rooms/labels.json", "[2]")
    forget()
    assert digests.package_digest("metrics") == before
    with pytest.raises(FileNotFoundError, match="holds no code"):
        digests.package_digest("metrics", "metrcs")
