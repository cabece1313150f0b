"""Build the wheel and compare its content with the files tracked by git: nothing missing, nothing extra."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINKED = ("datasets", "baselines", "reports")


def tracked() -> set[str]:
    """Paths inside the wheel of the tracked files."""
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    expected = set()
    for path in filter(None, listing.split("\0")):
        top = path.split("/")[0]
        if top in LINKED:
            expected.add(f"su3d_bench/{path}")
        elif top == "su3d_bench" and path not in {f"su3d_bench/{name}" for name in LINKED}:
            expected.add(path)
    return expected


def built_wheel(folder: Path) -> Path:
    """The project's wheel, built into ``folder``."""
    words = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)]
    subprocess.run(words, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def copy_kernels(installed: Path) -> None:
    """Reuse Numba's compiled kernels for unchanged sources: compiling them again takes a minute.

    Numba identifies a source by its size and time.
    """
    for source in installed.rglob("*.py"):
        original = ROOT / "su3d_bench" / source.relative_to(installed)
        kept = [*original.parent.glob(f"__pycache__/{original.stem}.*.nb[ic]")]
        if kept and original.read_bytes() == source.read_bytes():
            shutil.copystat(original, source)
            (source.parent / "__pycache__").mkdir(exist_ok=True)
            for file in kept:
                shutil.copy2(file, source.parent / "__pycache__")


def main() -> int:
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(built_wheel(Path(folder))) as archive:
        packaged = {name for name in archive.namelist() if ".dist-info/" not in name}
    expected = tracked()
    for name in sorted(expected - packaged):
        print(f"not in the wheel: {name}")
    for name in sorted(packaged - expected):
        print(f"in the wheel, but not tracked: {name}")
    print(f"wheel: {len(packaged)} files, {len(expected)} tracked")
    return int(expected != packaged)


if __name__ == "__main__":
    sys.exit(main())
