"""``python benchmarks NAME [WORDS ...]`` runs a measuring program, ``python benchmarks`` lists them."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path


def main(words: list[str]) -> None:
    here = Path(__file__).resolve().parent
    programs = runpy.run_path(str(here / "measuring" / "folders.py"))["PROGRAMS"]
    runs = {name: file for name, file in programs.items() if 'if __name__ == "__main__":' in file.read_text()}
    if not words or words[0] not in runs:
        for name, file in runs.items():
            first_line = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]
            print(f"{name:22} {file.parent.name:12} {first_line}")
        sys.exit(2 if words else 0)
    sys.argv = [str(runs[words[0]]), *words[1:]]
    runpy.run_path(str(runs[words[0]]), run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])
