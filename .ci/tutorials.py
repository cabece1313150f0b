"""Check that the tutorials work as written and show the real output. Each is run in an empty folder with the wheel.

The ``sh`` blocks of a page of ``docs/tutorials`` are run one by one; the first failure ends the
tutorial. Every line of a following ``text`` block must have been printed, except for numbers (which may differ on
other processors or versions) and ``...``, which stands for omitted lines.

``python .ci/tutorials.py [NAME ...]``, or all.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))  # a test runs this by path

from check_wheel import built_wheel, copy_kernels

ROOT = Path(__file__).resolve().parent.parent
PAGES = {page.stem: page for page in sorted((ROOT / "docs" / "tutorials").glob("*.md"))}
BLOCK = re.compile(r"^```(sh|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"\b[0-9a-f]{16}\b|[-+]?\d+(?:[.,]\d+)*")  # including digests of code
LEFT_OUT = "..."


def steps_of(page: str) -> list[tuple[str, str]]:
    """The commands of each block, and the output that the page shows.

    >>> steps_of("# P\\n```sh\\ntrue\\n```\\nthen\\n```sh\\nls\\n```\\nshows\\n```text\\na.txt\\n```\\n")
    [('true\\n', ''), ('ls\\n', 'a.txt\\n')]
    """
    steps: list[tuple[str, str]] = []
    for language, text in BLOCK.findall(page):
        if language == "sh":
            steps.append((text, ""))
        elif steps and not steps[-1][1]:
            steps[-1] = (steps[-1][0], text)
    return steps


def shape_of(line: str) -> str:
    """A line without numbers, and without the spaces and rules that align it.

    >>> shape_of("| mine   | 54.8 [25.0, 84.6] | +1,204 |") == shape_of("| mine | 9.1 [0, 100.0] | 3 |")
    True
    """
    return re.sub(r"\s+", " ", re.sub(r"-{2,}", "-", NUMBER.sub("#", line))).strip()


def not_printed(shown: str, printed: str) -> list[str]:
    """The lines that a page shows but that were not printed.

    >>> not_printed("2 scenes\\n...\\nwritten: a.tex\\n", "7 scenes\\nsomething\\nwritten: b.tex\\n")
    ['written: a.tex']
    """
    there = {shape_of(line) for line in printed.splitlines()} | {LEFT_OUT, ""}
    return [line for line in shown.splitlines() if shape_of(line) not in there]


def install(place: Path) -> dict[str, str]:
    """The environment in which ``su3d-bench`` is that of the wheel, unpacked in ``place``."""
    wheel = built_wheel(place / "wheel")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--disable-pip-version-check"]
    subprocess.run([*pip, "--target", str(place / "installed"), str(wheel)], check=True)
    copy_kernels(place / "installed" / "su3d_bench")
    path = os.pathsep.join([str(place / "installed/bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PYTHONPATH": str(place / "installed"), "PATH": path}
    where = [sys.executable, "-c", "import su3d_bench; print(su3d_bench.__file__)"]
    found = subprocess.run(where, cwd=place, env=environment, check=True, capture_output=True, text=True).stdout
    assert found.startswith(str(place / "installed")), f"not the wheel's: {found}"
    return environment


def follow(page: str, folder: Path, environment: Mapping[str, str]) -> list[str]:
    """Faults of a page run in ``folder``; its output is printed."""
    wrong: list[str] = []
    for typed, shown in steps_of(page):
        print(f"$ {typed.rstrip()}", flush=True)
        call = ["bash", "-euo", "pipefail", "-c", typed]
        done = subprocess.run(
            call, cwd=folder, env=environment, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        print(done.stdout, flush=True)
        if done.returncode:
            return [*wrong, f"ended with {done.returncode}: {typed.rstrip()}"]
        wrong += [f"was not printed: {line}" for line in not_printed(shown, done.stdout)]
    return wrong


def main(wanted: list[str]) -> int:
    unknown = [name for name in wanted if name not in PAGES]
    if unknown or not PAGES:
        print(f"tutorials: no '{', '.join(unknown)}'; known: {', '.join(PAGES)}")
        return 2
    has_failed = False
    with tempfile.TemporaryDirectory() as scratch:
        environment = install(Path(scratch))
        for name in wanted or PAGES:
            began = time.monotonic()
            folder = Path(tempfile.mkdtemp(dir=scratch))
            wrong = follow(PAGES[name].read_text(encoding="utf-8"), folder, environment)
            print(f"tutorial '{name}': {'not as written' if wrong else 'ok'}, {time.monotonic() - began:.0f} s")
            for line in wrong:
                print(line)
            has_failed |= bool(wrong)
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
