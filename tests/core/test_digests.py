"""Code digests: they cover every file that can change a number, in any folder, and no file that only shows numbers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from su3d_bench.core import digests


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A small package in place of su3d_bench."""
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
def test_code_digest_changes_with_files_that_can_change_a_number(package: Path, name: str, counts: bool) -> None:
    before = key()
    write(package / name, "x = 2\n")
    assert (key() != before) == counts


def test_renamed_file_changes_the_code_digest(package: Path) -> None:
    before = key()
    (package / "metrics/area.py").rename(package / "metrics/size.py")
    assert key() != before


def test_package_digest_depends_on_its_part_and_missing_part_is_an_error(package: Path) -> None:
    before = digests.package_digest("metrics")
    write(package / "datasets/rooms/labels.json", "[2]")
    forget()
    assert digests.package_digest("metrics") == before
    with pytest.raises(FileNotFoundError, match="contains no code to digest"):
        digests.package_digest("metrics", "metrcs")
