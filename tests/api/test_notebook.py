"""The notebook of the documentation, carried out from its first cell to its last by a kernel."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from places import ROOT

NOTEBOOK = ROOT / "docs" / "python.ipynb"


def test_the_notebook_is_kept_without_answers() -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) > 8
    assert [cell["id"] for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []


@pytest.mark.proof
def test_every_cell_of_the_notebook_runs(rooms_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient = pytest.importorskip("nbclient", reason="nbclient and ipykernel come with the test extra")
    pytest.importorskip("ipykernel", reason="nbclient and ipykernel come with the test extra")
    nbformat = pytest.importorskip("nbformat", reason="nbformat comes with nbclient")
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    book = nbformat.read(NOTEBOOK, as_version=4)
    client = nbclient.NotebookClient(book, timeout=None, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    shown = {
        line
        for cell in book.cells
        for output in cell.get("outputs", ())
        for line in output.get("data", {}).get("text/plain", "").splitlines()
    }
    assert "<Run runs/small: complete, 1 scene, opensu3d, oracle under rooms-semantic, rooms-instance>" in shown
    assert any("missed" in line and "chair" in line for line in shown), "the instance that its predictions lack"
    pages = [
        output["data"].get("text/html", "")
        for cell in book.cells
        for output in cell.get("outputs", ())
        if "data" in output
    ]
    assert any("<table>" in page and "rooms-instance" in page for page in pages), "a run shows its tables"
