"""Response time of the command line and the package, compared with an idle Python and one that imports numpy and
pydantic.

``python benchmarks startup --json build/measured/startup.json``, one minute. Every command is started in turn, in ten
rounds after a warm-up; the best time of each is reported. Python's compiled modules are cached
in a folder of the measurement, as for an installed program, and libraries are in the page cache.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from as_installed import as_installed
from measured import write_measured

PYTHON, COMMAND = [sys.executable, "-c"], [sys.executable, "-m", "su3d_bench"]
COMMANDS = {
    "python -c pass": [*PYTHON, "pass"],
    "python -c 'import numpy, pydantic'": [*PYTHON, "import numpy, pydantic"],
    "python -c 'import su3d_bench'": [*PYTHON, "import su3d_bench"],
    "su3d-bench --help": [*COMMAND, "--help"],
    "su3d-bench run --help": [*COMMAND, "run", "--help"],
    "su3d-bench datasets list": [*COMMAND, "datasets", "list"],
    "su3d-bench methods": [*COMMAND, "methods"],
    "su3d-bench protocols": [*COMMAND, "protocols"],
    "su3d-bench models list": [*COMMAND, "models", "list"],
}


def seconds(words: Sequence[str], environment: Mapping[str, str]) -> tuple[float, float]:
    """Wall and processor seconds of a command."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        environment = as_installed(Path(folder))
        for words in COMMANDS.values():
            seconds(words, environment)
        for _ in range(arguments.rounds):
            for name, words in COMMANDS.items():
                times[name].append(seconds(words, environment))
    rows = []
    for name, found in times.items():
        wall, cpu = (min(one[k] for one in found) * 1e3 for k in range(2))
        rows.append((name, f"{wall:.0f}", f"{cpu:.0f}"))
        print(f"{name:<36} {wall:6.0f} ms, {cpu:6.0f} ms of processor time")
    if arguments.json is not None:
        command = "python benchmarks startup --json build/measured/startup.json"
        notes = (
            f"Best of {arguments.rounds} rounds, all commands in turn in each; the targets are 100 ms for `--help` and "
            "for the package, 400 ms for lists.",
        )
        write_measured(
            arguments.json, "Command-line latency", command, ("command", "wall ms", "processor ms"), rows, notes
        )


if __name__ == "__main__":
    main()
