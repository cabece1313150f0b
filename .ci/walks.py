"""Do the walks of ``docs/walks.md`` work as they are written?  Each is typed in an empty folder, with the built wheel.

Only what stands in the page's ``sh`` blocks is typed, line by line as a shell does; the first that fails ends a walk.
``python .ci/walks.py [WALK ...]``, headings of the page in lower case, or all.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/walks.md"
HEADING = re.compile(r"^## (.+)$", re.MULTILINE)
BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def walks_of(page: str) -> dict[str, str]:
    """What is typed under each heading of a page, in its order.

    >>> walks_of("# P\\n## A walk\\n```sh\\ntrue\\n```\\nthen\\n```sh\\nls\\n```\\n## Words\\nnone\\n")
    {'a walk': 'true\\nls\\n'}
    """
    parts = HEADING.split(page)[1:]
    typed = {name.lower(): "".join(BLOCK.findall(text)) for name, text in zip(parts[::2], parts[1::2], strict=True)}
    return {name: lines for name, lines in typed.items() if lines}


def install(place: Path) -> dict[str, str]:
    """The environment in which ``su3d-bench`` is the wheel's, unpacked in ``place``."""
    wheels = place / "wheel"
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(wheels), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = wheels.glob("*.whl")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--disable-pip-version-check"]
    subprocess.run([*pip, "--target", str(place / "installed"), str(wheel)], check=True)
    path = os.pathsep.join([str(place / "installed/bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PYTHONPATH": str(place / "installed"), "PATH": path}
    where = [sys.executable, "-c", "import su3d_bench; print(su3d_bench.__file__)"]
    found = subprocess.run(where, cwd=place, env=environment, check=True, capture_output=True, text=True).stdout
    assert found.startswith(str(place / "installed")), f"not the wheel's: {found}"
    return environment


def main(wanted: list[str]) -> int:
    walks = walks_of(PAGE.read_text())
    unknown = [name for name in wanted if name not in walks]
    if unknown or not walks:
        print(f"walks: no '{', '.join(unknown)}'; known: {', '.join(walks)}")
        return 2
    failed = []
    with tempfile.TemporaryDirectory() as scratch:
        environment = install(Path(scratch))
        for name in wanted or walks:
            folder = Path(tempfile.mkdtemp(dir=scratch))
            began = time.monotonic()
            typed = ["bash", "-euxo", "pipefail", "-c", walks[name]]
            code = subprocess.run(typed, cwd=folder, env=environment, check=False).returncode
            print(f"walk '{name}': {'ok' if code == 0 else f'ended with {code}'}, {time.monotonic() - began:.0f} s")
            failed += [name] if code else []
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
