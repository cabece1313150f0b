"""What reads tables of sources, archives and records of what was fetched, recipes of reproductions."""

from __future__ import annotations

import gzip
import io
import shutil
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

from fuzzing import Make, Read, Target

MEMBERS = {"Replica/room0/traj.txt": b"1 0 0 0\n" * 40, "Replica/room0/results/frame000000.jpg": bytes(3000)}
MORE = {"Replica/office0/a.txt": b"x" * 700, "Replica/" + "long/" * 40 + "b.txt": b"y"}
PARTS = ("a.tar.gz.partaa", "a.tar.gz.partab")
SOURCES = """
[[sources]]
name = "replica-frames"
group = "replica"
what = "frames"
licence = { name = "terms", address = "https://example.org/terms", read_at = "a page" }
hosts = ["127.0.0.1", "*.example.org"]
archive = "zip"
about_bytes = 12_000
about_read_at = "a log"
scenes = { n_scenes = 8, n_frames = 16_000, read_at = "a paper" }

[[sources.files]]
name = "Replica.zip"
address = "http://127.0.0.1:8000/Replica.zip"
n_bytes = 12_345
sha256 = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef"
md5_prefix = "0123abcd"
read_at = "a script"

[[sources]]
name = "clip-vit-b-32"
group = "models"
what = "CLIP"
licence = { name = "MIT", address = "https://example.org/mit", signed_with = "me@example.org", read_at = "a page" }
hosts = ["huggingface.co"]

[sources.hub]
repository = "openai/clip-vit-base-patch32"
files = ["model.safetensors | pytorch_model.bin", "config.json"]
optional = ["merges.txt"]
weights = [{ name = "model.safetensors", n_bytes = 605, read_at = "the hub" }]
read_at = "the catalogue"
"""
RECIPE = """
schema = 1
name = "mine"
title = "My paper"
profile = "embedded"
encoder = "embedded"
settings = ["opensu3d.top_m=5"]

[rehearsal]
rooms = ["bedroom0"]
settings = ["n_frames=80"]
profile = "embedded"

[[experiment]]
name = "II"
title = "Instance segmentation"
methods = ["opensu3d"]
vary = ["m=1,5"]
stride = 10
scenes = ["replica/room0"]
protocols = ["replica-mesh-ex6"]
figures = [{ table = "II" }]
predictions = ["HOV-SG"]
note = "of a made room"
"""


def _silent(name: str, done: int, total: int | None) -> None:
    pass


def _wanted(path: PurePosixPath) -> PurePosixPath | None:
    return PurePosixPath(*path.parts[1:]) if path.parts[0] == "Replica" else None


def _sources(folder: Path) -> Read:
    from su3d_bench.fetching.sources import load_sources

    path = folder / "sources.toml"
    path.write_text(SOURCES)

    def read() -> None:
        for source in load_sources(path).entries.values():
            assert source.is_exact in (True, False) and (source.n_bytes or 0) >= 0

    return read


def _zip(folder: Path) -> Read:
    from su3d_bench.fetching.archives import members, unpack_zip

    path, out = folder / "a.zip", folder / "out"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {**MEMBERS, **MORE}.items():
            archive.writestr(name, content)

    def read() -> None:
        shutil.rmtree(out, ignore_errors=True)
        members(path)
        unpack_zip(path, out, _wanted, _silent)
        _stays_inside(out)

    return read


def _tar(form: int) -> Make:
    def make(folder: Path) -> Read:
        from su3d_bench.fetching.archives import unpack_tar_gz

        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w", format=form) as archive:
            for name, content in {**MEMBERS, **MORE}.items():
                info = tarfile.TarInfo(name)
                info.size = len(content)
                archive.addfile(info, io.BytesIO(content))
        whole, out = gzip.compress(packed.getvalue(), mtime=0), folder / "out"
        middle = len(whole) // 2
        for name, part in zip(PARTS, (whole[:middle], whole[middle:]), strict=True):
            (folder / name).write_bytes(part)

        def read() -> None:
            shutil.rmtree(out, ignore_errors=True)
            unpack_tar_gz([folder / name for name in PARTS], out, _wanted, _silent)
            _stays_inside(out)

        return read

    return make


def _stays_inside(out: Path) -> None:
    for path in out.rglob("*"):
        assert not path.is_symlink() and path.resolve().is_relative_to(out.resolve()), path


def _record(folder: Path) -> Read:
    from su3d_bench.fetching.bringing import Arrived, read_record, write_arrival

    write_arrival(folder, Arrived("frames", "Replica.zip", "http://127.0.0.1/Replica.zip", 5, "0" * 64, ("size",)))
    return lambda: read_record(folder)


def _recipe(folder: Path) -> Read:
    from su3d_bench.reproducing.asked import Asked, asked_runs
    from su3d_bench.reproducing.recipe import load_recipe

    path = folder / "mine.toml"
    path.write_text(RECIPE)

    def read() -> None:
        recipe = load_recipe(str(path))
        asked_runs(recipe, recipe.chosen(()), Asked(None, None, None, {}, ()))

    return read


TARGETS = (
    Target("fetch sources", _sources, ("sources.toml",)),
    Target("fetch zip", _zip, ("a.zip",)),
    *(
        Target(f"fetch tar.gz {name}", _tar(form), PARTS, 0.5)
        for name, form in (("gnu", tarfile.GNU_FORMAT), ("pax", tarfile.PAX_FORMAT))
    ),
    Target("fetch record", _record, (".fetched/record.json",)),
    Target("reproduce recipe", _recipe, ("mine.toml",)),
)
