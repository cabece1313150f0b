"""Reproduce a paper's tables from the wheel only: fetched from loopback servers, reproduced, verified separately.

``.ci/two_commands.py`` builds the wheel, installs it next to the packages of the project's environment and, with
an empty home, runs a user's commands: ``models fetch --profile paper``, ``datasets fetch replica``, ``reproduce
opensu3d --tables II III``, ``report verify``. The servers provide tiny networks and rooms in the published layouts,
first damaged in every named way; damaged files must never be accepted as complete.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "support" / "files"))

from check_wheel import built_wheel, copy_kernels  # noqa: E402
from file_server import (  # noqa: E402
    FileServer,
    Served,
    entry,
    hub_entry,
    serve_file,
    serve_model,
    serve_replica,
    serve_repository,
    write_table,
)

SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
ROOM = ("--scenes", "bedroom0", "--set", "n_frames=8", "width=64", "height=48", "mesh_spacing_m=0.2")
HUB = {
    "clip-vit-h-14": "laion/CLIP-ViT-H-14-laion2B-s32B-b79K",
    "clip-vit-l-14-336": "openai/clip-vit-large-patch14-336",
    "grounding-dino": "IDEA-Research/grounding-dino-tiny",
}
LARGEST = "grounding-dino"
SAM, RAM = "sam_vit_h_4b8939.pth", "ram_plus_swin_large_14m.pth"
REPLICA = "Replica.zip"
TABLES = ("II", "III")
MAX_SMALL_FILE = 100_000  # maximum file size in bytes for the full disk test


@dataclass(frozen=True)
class Place:
    """A separate home with the program in it, and nothing else."""

    folder: Path
    python: Path

    @property
    def models(self) -> Path:
        return self.folder / "home/.cache/su3d-bench/models"

    @property
    def data(self) -> Path:
        return self.folder / "data"

    def run(self, *words: object, cwd: Path | None = None, max_bytes: int | None = None) -> tuple[int, str, str]:
        """``su3d-bench`` with ``words``: exit code, stdout and stderr."""
        program = self.python.parent / "su3d-bench"
        return self._run([program, *words], cwd, max_bytes)

    def python_says(self, code: str, *words: object) -> str:
        rc, out, err = self._run([self.python, "-c", code, *words], None, None)
        assert rc == 0, err
        return out.strip()

    def _run(self, words: list[Any], cwd: Path | None, max_bytes: int | None) -> tuple[int, str, str]:
        variables = {"HOME": str(self.folder / "home"), "PATH": "/usr/bin:/bin", "SU3D_DATA": str(self.data)}

        def limited() -> None:
            if max_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

        where = cwd or self.folder
        done = subprocess.run(
            list(map(str, words)), cwd=where, env=variables, capture_output=True, text=True, preexec_fn=limited
        )
        return done.returncode, done.stdout, done.stderr


def installed(folder: Path) -> Place:
    """The wheel in a new virtual environment, with the packages of the project's environment on its path."""
    wheel = built_wheel(folder / "wheel")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
    python = folder / "venv/bin/python"
    words = ["-m", "pip", "--python", str(python), "--quiet", "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([sys.executable, *words], check=True)
    (packages,) = (folder / "venv/lib").glob("python*/site-packages")
    copy_kernels(packages / "su3d_bench")
    # Folders in .pth files are searched, but .pth files inside them (such as the one of the sources) are not read.
    (packages / "beside.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for name in ("home", "elsewhere"):
        (folder / name).mkdir()
    place = Place(folder, python)
    where = place.python_says("import su3d_bench; print(su3d_bench.__file__)")
    assert where.startswith(str(packages)), where
    return place


def serve_models(server: FileServer, place: Place) -> list[dict[str, Any]]:
    """Serve tiny networks like the hub and Meta's server; rows of the table."""
    made = place.folder / "made/models"
    code = "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[2]); import tiny_models\n"
    place.python_says(code + "tiny_models.write_fetched(Path(sys.argv[1]))", made, ROOT / "tests/support/models")
    rows = [serve_model(server, name, repository, made / name) for name, repository in HUB.items()]
    sam = serve_file(server, f"sam/{SAM}", b"tensors of a checkpoint" * 10_000)
    # The address in the table is dead: the file comes from a mirror.
    rows.append(entry("sam-vit-h", "models", {SAM: sam | {"address": f"http://127.0.0.1:9/{SAM}"}}))
    serve_repository(server, "xinyu1205/recognize-anything-plus-model", {RAM: b"of its own package alone" * 100})
    hub = {"repository": "xinyu1205/recognize-anything-plus-model", "files": [RAM], "optional": [], "read_at": "here"}
    return [*rows, hub_entry(server, "ram-plus", hub)]


def serve_rooms(server: FileServer, place: Place) -> list[dict[str, Any]]:
    """Serve one generated room as Replica's eight scenes, in the two published archives; rows of the table."""
    made = place.folder / "made/replica"
    rc, _, err = place.run("datasets", "make", "rooms", "--layout", "replica", "--out", made, *ROOM)
    assert rc == 0, err
    frames, mesh = made / "Replica/bedroom0", made / "replica_v1/bedroom_0"
    scan = made / "Replica/bedroom0_mesh.ply"
    for scene in SCENES:
        shutil.copytree(frames, frames.parent / scene)
        shutil.copy(scan, scan.parent / f"{scene}_mesh.ply")
        shutil.copytree(mesh, mesh.parent / f"{scene[:-1]}_{scene[-1]}")
    shutil.rmtree(frames)
    shutil.rmtree(mesh)
    scan.unlink()
    return serve_replica(server, made)


def expect(what: str, answer: tuple[int, str, str], code: int, expected: str) -> None:
    """Check that ``answer`` has ``code`` and ``expected`` in its final line, without a traceback."""
    rc, out, err = answer
    lines = err.strip().splitlines()
    assert rc == code, f"{what}: code {rc} instead of {code}\n{out}\n{err}"
    assert "Traceback" not in err, err
    assert expected in (lines[-1] if code else out + err), f"{what}: {expected!r} is missing\n{out}\n{err}"
    print(f"{what}: {(lines[-1] if code else expected)[:160]}", flush=True)


def damages_of_models(server: FileServer, place: Place, fetch: Callable[..., tuple[int, str, str]]) -> None:
    """Each kind of damage gives its message, and no incomplete model is found."""
    once = ("--accept", "models", "--retries", "0", "--quiet")
    before = len(server.asked)
    expect("licence not accepted", fetch("models", "--profile", "paper"), 2, "not accepted")
    assert len(server.asked) == before
    stores = [path for path in server.files if path.startswith("/store/")]
    store = max(stores, key=lambda path: len(server.files[path].content))
    whole = server.files[store]
    server.files[store] = Served(whole.content[:-1] + b"?")
    expect("wrong checksum", fetch("models", LARGEST, *once), 2, "it was deleted")
    server.files[store] = Served(whole.content, redirect="https://example.org/there")
    expect("redirect to another host", fetch("models", LARGEST, *once), 2, "is not allowed for it")
    server.files[store] = whole
    sam = server.files[f"/sam/{SAM}"]
    expect("full disk", fetch("models", "sam-vit-h", *once, max_bytes=MAX_SMALL_FILE), 2, SAM)
    server.files[f"/sam/{SAM}"] = Served(sam.content, breaks_after=[50_000])
    expect("break in the middle", fetch("models", "sam-vit-h", *once), 2, "rerun to resume")
    assert not here(place), "a damaged file was accepted as complete"
    expect(
        "the same again",
        fetch("models", "--profile", "paper", *once),
        0,
        f"{SAM}  (verified against: published SHA-256)",
    )
    assert server.asked and any(one.path.endswith(SAM) and one.range for one in server.asked), "nothing was resumed"
    assert here(place) == {*HUB, "sam-vit-h", "ram-plus"}


def here(place: Place) -> set[str]:
    """The models that are found."""
    rc, out, err = place.run("models", "list", "--json")
    assert rc == 0, err
    return {row["name"] for row in json.loads(out) if row["found"]}


def damages_of_replica(server: FileServer, place: Place, fetch: Callable[..., tuple[int, str, str]]) -> None:
    once = ("--accept", "replica", "--retries", "0", "--quiet")
    archive = server.files[f"/{REPLICA}"]
    server.files[f"/{REPLICA}"] = Served(archive.content, redirect=f"{server.other_host}/there")
    expect("redirect to another host", fetch("replica", *once), 2, "host 'localhost' is not allowed for it")
    server.files[f"/{REPLICA}"] = Served(archive.content, breaks_after=[len(archive.content) // 2])
    expect("break in the middle", fetch("replica", *once), 2, "rerun to resume")
    assert not (place.data / "Replica").exists()
    expect("the same again", fetch("replica", *once), 0, "(no published checksum; recorded)")
    expect("checked", place.run("datasets", "check", "replica/*", "--quick"), 0, "replica/office4")


def reproduced(place: Place) -> Path:
    """Tables II and III of OpenSU3D's paper from the fetched data; the archive."""
    words = ("reproduce", "opensu3d", "--tables", *TABLES, "--limit", "1", "--out", place.folder / "out")
    expect("preflight", place.run(*words, "--dry-run"), 0, "all requirements are available")
    # The fetched networks are tiny, with random weights: the numbers come from embedded perception.
    rc, out, err = place.run(*words, "--profile", "embedded", "--encoder", "embedded", "--quiet")
    assert rc == 0, err
    for name in TABLES:
        assert f"**{name}**" in out or f"{name}: " in out, out
    cells = json.loads((place.folder / "out/compared.json").read_text())["cells"]
    assert cells and all(cell["measured"] is not None for cell in cells)
    print(f"reproduce: {len(cells)} printed cells compared with measured ones", flush=True)
    return place.folder / "out/bundle.zip"


def verified(place: Place, bundle: Path) -> None:
    """The archive is valid after moving it, scored by another process."""
    moved = shutil.copy(bundle, place.folder / "elsewhere/b.zip")
    rc, out, err = place.run("report", "verify", Path(moved).name, "--json", cwd=place.folder / "elsewhere")
    assert rc == 0, out + err
    (found,) = json.loads(out)["bundles"]
    assert found["is_to_the_bit"] and not found["faults"], found
    print(f"verify: {found['n_scores']} scores and {found['n_cells']} cells, the same to the last bit", flush=True)


def main() -> int:
    with tempfile.TemporaryDirectory() as name, FileServer() as server:
        place = installed(Path(name).resolve())
        models, rooms = serve_models(server, place), serve_rooms(server, place)
        table = write_table(place.folder / "own.toml", [*models, *rooms])
        mirror = ("--mirror", f"sam-vit-h={server.url}/sam/")
        beside: Mapping[str, tuple[object, ...]] = {"models": mirror, "replica": ()}

        def fetch(what: str, *words: object, max_bytes: int | None = None) -> tuple[int, str, str]:
            verb = ("models", "fetch") if what == "models" else ("datasets", "fetch", what)
            return place.run(*verb, *words, "--sources", table, *beside[what], max_bytes=max_bytes)

        words = ("reproduce", "opensu3d", "--tables", *TABLES, "--dry-run")
        rc, out, err = place.run(*words)
        assert rc == 1 and "missing, about" in out, out + err
        damages_of_models(server, place, fetch)
        damages_of_replica(server, place, fetch)
        # RAM++ runs as its export, which is created in a separate environment.
        shutil.copytree(place.folder / "made/models/ram-plus-onnx", place.models / "ram-plus-onnx")
        verified(place, reproduced(place))
    spent = sum(resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime for who in WHOSE)
    print(f"two commands: {spent:.0f} s of processor time")
    return 0


WHOSE = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)

if __name__ == "__main__":
    os.environ.pop("PYTHONPATH", None)
    sys.exit(main())
