"""Fixtures of sheet tests: a finished run of a painted scene, and the source of sheets from it."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from painted_runs import COLLECTOR, painted_run

if TYPE_CHECKING:
    from su3d_bench.human_eval.sources import RunSource


@pytest.fixture(scope="session")
def painted_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run in ``run`` and a query file."""
    path = tmp_path_factory.mktemp("sheets")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(path / "data"))
        patch.chdir(path)
        methods = (COLLECTOR, f"{COLLECTOR}@noise_m=0.0", f"{COLLECTOR}@drop=1")
        painted_run(Path("run"), "--protocols", "rooms-instance", "--quiet", methods=methods, scenes="a")
    rows = [("painted/a", "chair", "1", "instance"), ("painted/a", "a green sofa", "2", "property")]
    rows += [("painted/a", "=HYPERLINK(0)", "", "relative"), ("painted/a", "<script>x</script>", "3", "affordance")]
    text = io.StringIO(newline="")
    csv.writer(text).writerows([("scene", "text", "objects", "kind"), *rows])
    (path / "queries.csv").write_text(text.getvalue())
    return path


@pytest.fixture
def painted_source(painted_folder: Path, monkeypatch: pytest.MonkeyPatch) -> RunSource:
    """The run, judged by the rules of the built-in rooms, whose label space the painted scenes use."""
    from su3d_bench.human_eval.sources import RunSource
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.runs.finished import read_run

    monkeypatch.setenv("SU3D_DATA", str(painted_folder / "data"))
    monkeypatch.setattr(RunSource, "rules", lambda self, scene, kind: load_protocol(f"rooms-{kind}"))
    return RunSource(read_run(painted_folder / "run"))
