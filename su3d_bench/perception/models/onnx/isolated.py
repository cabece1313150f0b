"""An environment of its own for the code of others that runs with other versions of packages than ours."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from su3d_bench.core.errors import CheckFailed, ConfigError, printable, shown
from su3d_bench.core.files.atomic import is_file, make_folder, read_json, write_error, write_json
from su3d_bench.core.files.locks import unfinished_folder

# What recognize-anything's network of RAM++ needs: transformers 5 has lost functions that it imports. These versions
# have wheels for Python 3.11 and 3.12, and it was run with them.
RAM_PLUS_PACKAGES = ("torch==2.13.0", "transformers==4.46.3", "onnx==1.18.0", "numpy==2.2.6")
NOTE = "su3d-bench.json"


def made_environment(folder: Path, packages: Sequence[str]) -> Path:
    """The Python of an environment in ``folder`` that has ``packages``, made with pip where it is not there yet.

    Raises ``ConfigError`` where something else lies there, and ``CheckFailed`` with pip's own last line.
    """
    python = folder / "bin" / "python"
    note = {"packages": list(packages)}
    if is_file(folder / NOTE):
        if read_json(folder / NOTE) != note or not is_file(python):
            raise ConfigError(f"{shown(folder)}: is an environment of other versions; remove it or name another folder")
        return python
    if folder.is_symlink() or folder.exists():
        raise ConfigError(
            f"{shown(folder)}: is there, and this command did not make it; name another folder, or the environment's "
            "own python with --python"
        )
    make_folder(folder.parent)
    with unfinished_folder(folder) as place:
        _run([sys.executable, "-m", "venv", str(place)], "no environment can be made")
        _run(
            [str(place / "bin" / "python"), "-m", "pip", "install", "--no-input", "--quiet", *packages],
            f"pip cannot install {', '.join(packages)}",
        )
        write_json(place / NOTE, note)
        try:
            os.replace(place, folder)  # an environment finds its packages by where its python lies
        except OSError as error:
            raise write_error(folder, error) from error
    return python


def run_program(python: Path, program: Path, words: Sequence[str], folder: Path) -> None:
    """Run the file ``program`` with ``python``, in ``folder``, without this program's modules and without a hub.

    Raises ``ConfigError`` where ``python`` cannot be started, ``CheckFailed`` with the program's last line where it
    fails.
    """
    quiet = {"HF_HUB_OFFLINE": "1", "TRANSFORMERS_OFFLINE": "1"}
    # Found without resolving links: a python finds its environment by where the link lies.
    found = Path(shutil.which(python) or python).absolute()
    _run([str(found), "-I", "-B", str(program), *words], f"{program.name} failed", folder, quiet)


def _run(words: Sequence[str], fault: str, folder: Path | None = None, more: dict[str, str] | None = None) -> None:
    try:
        done = subprocess.run(
            words,
            cwd=folder,
            env=os.environ | (more or {}),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            check=False,
        )
    except OSError as error:
        raise ConfigError(f"{printable(words[0])}: cannot be started ({error.strerror}); name a Python") from error
    if done.returncode:
        lines = [line for line in done.stderr.decode(errors="replace").splitlines() if line.strip()]
        raise CheckFailed(f"{fault}: {printable(lines[-1] if lines else f'exit code {done.returncode}')}")
