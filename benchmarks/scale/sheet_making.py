"""Time to create the sheets of all three kinds on the four demo rooms with the four fusion schemes.

``python benchmarks sheet_making [--run runs/demo-schemes] [--json build/measured/sheet_making.json]``: one command
for all kinds, then one command each, as a user would type them; wall and processor time of each including all its
processes. The run is created first if missing (some minutes). Exit code 1 if the three kinds take at least two
minutes, either in one command or in three.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measured import write_measured

ROOMS = [f"rooms/{name}" for name in ("living0", "bedroom0", "kitchen0", "office0")]
SCHEMES = [f"opensu3d@scheme{k}" for k in range(1, 5)]
KINDS = ("retrieval", "annotation", "reasoning")
MAX_S = 120.0


def timed(words: list[str]) -> tuple[float, float]:
    """Wall and processor seconds of one command and its processes."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run([sys.executable, "-m", "su3d_bench", *words], check=True, stdout=subprocess.DEVNULL)
    wall_s, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/demo-schemes"))
    parser.add_argument("--json", type=Path, default=Path("build/measured/sheet_making.json"))
    arguments = parser.parse_args()
    if not (arguments.run / "metrics.json").is_file():
        words = ["run", "--scenes", *ROOMS, "--methods", *SCHEMES, "--protocols", "rooms-retrieval", "--no-pictures"]
        timed([*words, "--quiet", "--out", str(arguments.run)])
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        make = ["sheets", "make", str(arguments.run), "--quiet", "--out", folder + "/sheets", "--kinds"]
        for name, kinds in {"all three": KINDS, **{kind: (kind,) for kind in KINDS}}.items():
            found[name] = timed([*make, *kinds])
            print(f"{name}: {found[name][0]:.1f} s, {found[name][1]:.1f} s of processor", flush=True)
    apart_s = sum(found[kind][0] for kind in KINDS)
    write_measured(
        arguments.json,
        "Annotation sheets of four rooms and four schemes",
        "python benchmarks sheet_making",
        ("sheets", "seconds", "seconds of processor"),
        [(name, f"{wall:.1f}", f"{cpu:.1f}") for name, (wall, cpu) in found.items()],
        (f"Retrieval, annotation and reasoning in three commands take {apart_s:.1f} s.",),
    )
    print(f"separately: {apart_s:.1f} s")
    return 0 if max(apart_s, found["all three"][0]) < MAX_S else 1


if __name__ == "__main__":
    sys.exit(main())
