"""Check that the README's table is what the tool prints.  ``--write`` updates it.

Words, rows and columns must be equal; values may differ by ``TOLERANCE`` points, because ONNX Runtime, Embree and BLAS
round differently on other processors, and a region on the other side of a threshold changes a metric slightly.
The ends of an interval over four scenes are the value and 3.18 standard errors: if each scene changes by
``TOLERANCE``, they change by up to ``TOLERANCE * (1 + 3.18 / 2)``.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from su3d_bench.reports.tables.formats import markdown
from su3d_bench.reports.tables.run import run_tables

README = Path(__file__).resolve().parent.parent / "README.md"
BEGIN = "<!-- demo table: written by `su3d-bench run`, checked by .ci/check_readme.py -->\n"
END = "<!-- demo table ends -->"
TOLERANCE = 5.0
END_TOLERANCE = TOLERANCE * (1 + 3.18 / 2)
NUMBER = re.compile(r"-?\d+\.\d+")
INTERVAL = re.compile(r"\[-?\d+\.\d+, -?\d+\.\d+\]")


def table_in(readme: str) -> str:
    return readme.split(BEGIN)[1].split(END)[0].strip()


def shape_of(table: str) -> str:
    """The table without its decimals and without the spaces that align them."""
    return re.sub(r"[ -]{2,}", " ", NUMBER.sub("#", table))


def differences(shown: str, written: str) -> list[str]:
    if shape_of(shown) != shape_of(written):
        return ["the README's table differs in rows, columns or words from the tool's output:", written]
    return [
        *_over_tolerance(INTERVAL.sub("", shown), INTERVAL.sub("", written), TOLERANCE),
        *_over_tolerance(" ".join(INTERVAL.findall(shown)), " ".join(INTERVAL.findall(written)), END_TOLERANCE),
    ]


def _over_tolerance(shown: str, written: str, tolerance: float) -> list[str]:
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(written), strict=True)
    return [f"README has {a}, the run {b}" for a, b in pairs if abs(float(a) - float(b)) > tolerance]


def main(arguments: list[str]) -> int:
    run = Path(next(one for one in arguments if not one.startswith("--")))
    written = markdown(run_tables(json.loads((run / "metrics.json").read_text()))).strip()
    readme = README.read_text()
    if "--write" in arguments:
        README.write_text(readme.replace(table_in(readme) or END, written if table_in(readme) else f"{written}\n{END}"))
        return 0
    found = differences(table_in(readme), written)
    print("\n".join(found) or "the README's table matches the tool's output")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
