"""Fail if a text uses a word for which the field or plain English has a standard one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
THINGS = "row|column|line|file|folder|scene|frame|class|method|mask|object|instance|page|sheet|question"
STANDARD = {  # pattern -> what to write
    r"anew": "again",
    r"held against|hold against": "compared with",
    r"mend|mends|mended|mending": "fix, correct, repair",
    r"spoil|spoils|spoilt|spoiled": "damaged, corrupted",
    r"likeliest": "most likely",
    r"all the same": "anyway",
    r"somebody|anybody|somebody's|anybody's": "a user, anyone; user-defined",
    r"is none here|are none here": "is not available",
    r"takes? up|took up|taken up": "resume",
    r"brought|bring|brings": "download, move",
    r"bears|borne": "has",
    r"as told|is told|was told|were told": "configured; uses",
    r"stands beside|stand beside|stands behind": "is shown with, follows",
    rf"an? (?:{THINGS}) an? (?:{THINGS})": "one X per Y",
}
PATTERN = re.compile("|".join(rf"(?P<w{n}>\b(?:{words})\b)" for n, words in enumerate(STANDARD)), re.IGNORECASE)
# Names of classes and phrases of datasets are not our words; nor is this list.
DATA = ("tests/cases/", "su3d_bench/metrics/rules/", "su3d_bench/perception/embedded/weights/", ".ci/check_words.py")
ALLOWED = {"su3d_bench/questions/grammar.toml", "su3d_bench/core/english.toml"}  # English that users may type


def faults(path: str) -> list[str]:
    """One line for each word of the file that has a standard one."""
    found = []
    for number, line in enumerate((ROOT / path).read_text(encoding="utf-8").splitlines(), 1):
        for match in PATTERN.finditer(line):
            better = list(STANDARD.values())[int((match.lastgroup or "w0")[1:])]
            found.append(f"{path}:{number}: '{match[0]}'; write: {better}")
    return found


def main() -> int:
    command = ["git", "ls-files", "*.py", "*.md", "*.toml", "*.js", "*.html", "*.yml", "Makefile"]
    files = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\n")
    lines = [
        line for path in files if path and not path.startswith(DATA) and path not in ALLOWED for line in faults(path)
    ]
    print("\n".join(lines) or "words: OK")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
