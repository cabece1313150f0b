"""Time to create the page of a run: two small rooms, one method."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from su3d_bench.analysis.page.contents import Contents, PageOptions, page_contents
from su3d_bench.cli.main import main

GROUP = "page of two small rooms"
SMALL = ("rooms.n_frames=40", "rooms.width=160", "rooms.height=120", "rooms.mesh_spacing_m=0.05")
WISHES = PageOptions(jobs=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("page")
    words = ["run", "--scenes", "rooms/bathroom0", "rooms/office0", "--methods", "oracle", "--no-pictures", "--quiet"]
    words += ["--protocols", "rooms-semantic", "rooms-instance", "--jobs", "1", "--set", *SMALL]
    with pytest.MonkeyPatch.context() as patch:
        (folder / "data").mkdir()
        patch.setenv("SU3D_DATA", str(folder / "data"))
        assert main([*words, "--out", str(folder / "run")]) == 0
        yield folder / "run"


def contents(run: Path) -> Contents:
    return page_contents([run], WISHES)


@pytest.mark.benchmark(group=GROUP)
def test_page(benchmark: Any, run: Path) -> None:
    expected = contents(run)
    assert benchmark.pedantic(contents, (run,), rounds=3, iterations=1) == expected
