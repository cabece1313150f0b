"""Folders and fixtures shared by the tests."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

TESTS = Path(__file__).resolve().parent
MEMORY = Path("/dev/shm")
MAX_KEPT_BYTES = 4 << 30

# The table of readers to damage uses samples from the tests of those readers.
sys.path += sorted({str(file.parent) for file in TESTS.rglob("*.py")} - {*sys.path})

from chat_server import ChatServer  # noqa: E402 (it is found by the line above)
from painted_runs import see_painted  # noqa: E402
from painted_sheets import painted_folder, painted_source  # noqa: E402, F401

# Tables wrap if a terminal width is set, as pytest-xdist does for its workers.
os.environ.pop("COLUMNS", None)

# Every file of a run is flushed to disk before it counts; thousands of small runs would wait only for this.
if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MAX_KEPT_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# Hundreds of processes start, each of which would compile the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell script ignores interrupts in what it starts in the background; tests interrupt themselves.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests never fail because of a slow machine, including the generation of examples.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


@pytest.fixture(scope="session")
def rooms_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root for the session, shared by all its processes: a room rendered by one test is available to others."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "rooms-data"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def painted_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which this process finds painted scenes."""
    see_painted(monkeypatch)
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def data_to_spoil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], Path]:
    """Copies a folder of data to ``data``, where a test may damage it, and makes it the data root; its path."""

    def copied(whole: Path) -> Path:
        shutil.copytree(whole, tmp_path / "data")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("SU3D_DATA", "data")
        monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
        return tmp_path / "data"

    return copied


@pytest.fixture(scope="module")
def chat_of_module() -> Iterator[ChatServer]:
    with ChatServer() as server:
        yield server


@pytest.fixture
def chat(chat_of_module: ChatServer, monkeypatch: pytest.MonkeyPatch) -> ChatServer:
    """A language model's server without recorded requests; the test sets its answers."""
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    chat_of_module.forget()
    return chat_of_module


def pytest_xdist_auto_num_workers() -> int:
    """One more than the cores: tests wait for processes, browsers and servers."""
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """If several processes share the work, each takes whole files: fixtures of a file are created once."""
    if getattr(config.option, "numprocesses", None) and config.option.dist == "no":
        config.option.dist = "loadfile"
        config.option.loadscopereorder = False  # files with few, possibly slow tests would come last
