"""Check that the code stays within its budget: ``check_budget.py [--write]``.

``.ci/budget.toml`` has the maximum lines of code of each package, of product, tests and test support together, and the
maximum number of files. Lines with only comments or docstrings do not count. ``--write`` stores the current counts,
rounded up to the next ten.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
STEP = 10
BUDGET = ROOT / ".ci" / "budget.toml"
PRODUCT = ("su3d_bench", "datasets", "baselines", "reports")
FOLDERS = (*PRODUCT, "tests", "benchmarks", ".ci", "tools")
NO_CODE = {getattr(tokenize, name) for name in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")}


def code_lines(text: str) -> int:
    """The lines of a module that contain a token other than a comment or docstring.

    >>> code_lines('\"\"\"Words.\"\"\"\\n\\n# a remark\\nx = (1,\\n  2)\\n')
    2
    """
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {line for t in tokens if t.type not in NO_CODE for line in range(t.start[0], t.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        has_docstring = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if has_docstring and ast.get_docstring(node, clean=False) is not None:
            lines -= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return len(lines)


def counts() -> Counter[str]:
    """The lines of each package and in total, and the number of files."""
    found: Counter[str] = Counter()
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        place = path.relative_to(ROOT).parts
        if any(Path(ROOT, *place[:n]).is_symlink() for n in range(1, len(place))):
            continue
        n_lines = code_lines(path.read_text(encoding="utf-8"))
        found["files"] += 1
        if place[0] in PRODUCT:
            is_inner = place[0] == "su3d_bench" and len(place) > 2
            found["product"] += n_lines
            found["/".join(place[:2]) if is_inner else place[0]] += n_lines
        elif place[0] == "tests":
            found["tests"] += n_lines
            found["tests/support"] += n_lines if place[1] == "support" else 0
    return found


def main(arguments: list[str]) -> int:
    found = counts()
    if "--write" in arguments:
        lines = (f'"{name}" = {-(-n // STEP) * STEP}\n' for name, n in sorted(found.items()))
        BUDGET.write_text("".join(lines), encoding="utf-8")
        return 0
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8"))
    over = [f"{name}: {n:,}, budget {budget.get(name, 0):,}" for name, n in found.items() if n > budget.get(name, 0)]
    for line in sorted(over):
        print(f".ci/budget.toml: {line}; remove as much elsewhere, or raise the budget with a reason in the commit")
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
