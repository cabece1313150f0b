"""The check of code size."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from places import ROOT


def test_a_package_over_its_budget_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = importlib.util.spec_from_file_location("check_budget", ROOT / ".ci" / "check_budget.py")
    assert spec is not None and spec.loader is not None
    check = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(check)
    monkeypatch.setattr(check, "ROOT", tmp_path)
    monkeypatch.setattr(check, "BUDGET", tmp_path / "budget.toml")
    monkeypatch.setattr(check, "STEP", 1)
    code = tmp_path / "su3d_bench/core/a.py"
    code.parent.mkdir(parents=True)
    code.write_text('"""Words.\n\nMore."""\n\n# a remark\nx = """two\nlines"""\n')
    assert check.main(["--write"]) == 0 and check.main([]) == 0
    assert (tmp_path / "budget.toml").read_text() == '"files" = 1\n"product" = 2\n"su3d_bench/core" = 2\n'
    code.write_text(code.read_text() + "y = 1\n")
    assert check.main([]) == 1
    assert "su3d_bench/core: 3, budget 2" in capsys.readouterr().out
