"""The examples in the docstrings are correct."""

from __future__ import annotations

import doctest
import importlib

import pytest
from places import ROOT

RUN_OPTIONS = {"su3d_bench.analysis.comparison"}  # their examples use a user's run
PACKAGES = ("analysis", "evaluation", "metrics", "reports")


@pytest.mark.parametrize("package", PACKAGES)
def test_examples_in_docstrings_are_correct(package: str) -> None:
    files = sorted((ROOT / "su3d_bench" / package).rglob("*.py"))
    with_examples = [file for file in files if ">>> " in file.read_text(encoding="utf-8")]
    names = {".".join(file.relative_to(ROOT).with_suffix("").parts) for file in with_examples} - RUN_OPTIONS
    found = {name: doctest.testmod(importlib.import_module(name)) for name in names}
    assert names and all(one.attempted and not one.failed for one in found.values()), found
