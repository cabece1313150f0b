"""Keys of code: everything that can move a number counts, in whatever folder; what only explains does not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from su3d_bench.core import digests

SOURCE = '"""What it is."""\n\n\ndef double(x):\n    """Twice ``x``."""\n    return 2 * x  # why\n'
RULES = "# where it is from\nthreshold = 0.5\n[labels]\nnames = ['a', 'b']\n"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A small package in place of ours."""
    for name, text in {
        "metrics/area.py": SOURCE,
        "metrics/rules/area.toml": RULES,
        "datasets/rooms/dataset.py": SOURCE,
        "datasets/rooms/labels.json": "[1, 2]",
        "cli/run.py": SOURCE,
        "reports/page/page.py": SOURCE,
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(digests, "PACKAGE_ROOT", tmp_path)
    forget()
    yield tmp_path
    forget()


def forget() -> None:
    digests.code_digest.cache_clear()
    digests.package_digest.cache_clear()


def key() -> str:
    forget()
    return digests.code_digest()


@pytest.mark.parametrize("name", ["metrics/new/deep/median.py", "colour/hue.py", "datasets/mine/dataset.py", "one.py"])
def test_a_file_in_a_new_subfolder_changes_the_key(package: Path, name: str) -> None:
    before = key()
    (package / name).parent.mkdir(parents=True, exist_ok=True)
    (package / name).write_text("x = 1\n")
    assert key() != before


@pytest.mark.parametrize("name", ["metrics/area.py", "datasets/rooms/dataset.py"])
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# why", "# because"),
        ("    return", "    # a line of its own\n    return"),
        ("Twice ``x``.", "Double."),
        ('"""What it is."""\n', ""),
        ("2 * x", "(2 *\n            x)"),
    ],
)
def test_comments_docstrings_and_layout_of_python_leave_the_key(package: Path, name: str, old: str, new: str) -> None:
    before = key()
    (package / name).write_text(SOURCE.replace(old, new))
    assert key() == before


def test_comments_and_layout_of_toml_leave_the_key(package: Path) -> None:
    before = key()
    (package / "metrics/rules/area.toml").write_text("threshold = 0.50\nlabels.names = ['a',\n 'b'] # two\n")
    assert key() == before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("metrics/area.py", SOURCE.replace("2 * x", "3 * x")),
        ("metrics/area.py", SOURCE.replace("    return", "    'a text that is no docstring'\n    return")),
        ("metrics/area.py", "def double(x:\n"),
        ("metrics/rules/area.toml", RULES.replace("0.5", "0.25")),
        ("datasets/rooms/labels.json", "[1, 3]"),
    ],
)
def test_what_can_move_a_number_changes_the_key(package: Path, name: str, text: str) -> None:
    before = key()
    (package / name).write_text(text)
    assert key() != before


@pytest.mark.parametrize("name", ["metrics/area.py", "metrics/rules/area.toml", "datasets/rooms/labels.json"])
def test_a_file_that_goes_or_moves_changes_the_key(package: Path, name: str) -> None:
    before = key()
    text = (package / name).read_text()
    (package / name).unlink()
    gone = key()
    (package / f"{name.rpartition('/')[0]}/other{Path(name).suffix}").write_text(text)
    assert len({before, gone, key()}) == 3


@pytest.mark.parametrize("name", ["cli/run.py", "cli/templates/verb.py", "reports/page/page.py", "metrics/README.md"])
def test_what_only_shows_leaves_the_key(package: Path, name: str) -> None:
    before = key()
    (package / name).parent.mkdir(parents=True, exist_ok=True)
    (package / name).write_text("x = 2\n")
    assert key() == before


def test_a_part_is_keyed_alone_and_with_its_subfolders(package: Path) -> None:
    before = digests.package_digest("datasets/rooms"), digests.package_digest("metrics")
    (package / "datasets/rooms/objects").mkdir()
    (package / "datasets/rooms/objects/chair.py").write_text("legs = 4\n")
    forget()
    assert digests.package_digest("datasets/rooms") != before[0]
    assert digests.package_digest("metrics") == before[1]


@pytest.mark.parametrize("name", ["segmenters", "metrics/areas.py", "empty"])
def test_a_part_without_code_is_an_error(package: Path, name: str) -> None:
    (package / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="holds no code"):
        digests.package_digest("metrics", name)


@pytest.mark.parametrize("kept", ["", "{", "[1]", '{"metrics/area.py": 7}', '{"metrics/area.py": [[1, 2], 3]}'])
def test_damaged_kept_digests_are_made_anew(package: Path, kept: str) -> None:
    before = key()
    (place,) = package.glob("__pycache__/*.json")
    place.write_text(kept)
    assert key() == before
    place.unlink()
    place.parent.rmdir()
    place.parent.write_text("no folder can be made here")
    assert key() == before


def test_kept_digests_follow_a_file_of_the_same_size(package: Path) -> None:
    before = key()
    (package / "metrics/area.py").write_text(SOURCE.replace("2 * x", "7 * x"))
    assert key() != before


def test_every_file_of_the_package_is_counted_or_only_shown() -> None:
    root = digests.PACKAGE_ROOT
    walks = [(root, root), *((root / name, (root / name).resolve()) for name in ("datasets", "baselines", "reports"))]
    files = {
        (place / path.relative_to(folder)).relative_to(root).as_posix()
        for place, folder in walks
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    counted = {path.relative_to(root).as_posix() for path in digests._sources(root)}
    assert {name for name in files - counted if not name.endswith((".md", "py.typed"))} == set()
    assert counted <= files
    assert {name.split("/")[0] for name in counted} >= set(digests.ONLY_SHOWN)
