"""Bundles for registries: of painted scenes (fast), and of a small room, which can be scored again."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from painted_runs import COLLECTOR, painted_run

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_bytes
from su3d_bench.reproducing.bundle import bundle_runs

ROOM = "rooms/bathroom0"
SMALL = ("rooms.n_frames=8", "rooms.width=160", "rooms.height=120", "rooms.mesh_spacing_m=0.1")
PROTOCOLS = ("rooms-semantic", "rooms-instance")
Files = dict[str, bytes]


def painted_bundle(
    folder: Path, name: str, methods: Sequence[str], scenes: str = "abc", more: Sequence[str] = (), printed: str = ""
) -> Path:
    """``folder/name.zip``: variants of the painted collector; it uses its own code, so verifiers reject it."""
    named = [f"{COLLECTOR}{method}" for method in methods]
    painted_run(folder / "runs" / name, "--quiet", *more, methods=named, scenes=scenes)
    stated = {"trained_on": printed, "authors": printed, "link": "https://example.org/method" if printed else ""}
    bundle_runs(folder / f"{name}.zip", [folder / "runs" / name], **stated)
    return folder / f"{name}.zip"


def room_bundle(folder: Path, *, data: Path) -> Path:
    """A valid bundle: three methods on a small room, perception by ground truth; one has no instances to score."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(data))
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        words = ["run", "--scenes", ROOM, "--methods", "opensu3d", "conceptfusion", "oracle", "--protocols", *PROTOCOLS]
        words += ["--set", *SMALL]
        words += ["--profile", "oracle", "--no-pictures", "--jobs", "1", "--quiet", "--stride", "2"]
        assert main([*words, "--out", str(folder / "room")]) == 0
        assert main(["report", "bundle", str(folder / "room"), "--out", str(folder / "room.zip"), "--quiet"]) == 0
    return folder / "room.zip"


def read_bundle(bundle: Path) -> tuple[Files, dict[str, object]]:
    """The files of a bundle and its manifest."""
    with zipfile.ZipFile(bundle) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return files, json.loads(files.pop("manifest.json"))


def rewrite_bundle(place: Path, files: Files, manifest: Mapping[str, object]) -> Path:
    """Recompute all digests of a bundle."""
    entries = {name: {"n_bytes": len(content), "sha256": digest_bytes(content)} for name, content in files.items()}
    place.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("manifest.json", json.dumps({**manifest, "files": entries}))
        for name, content in files.items():
            archive.writestr(name, content)
    return place


def flip_labels(files: Files, job: str) -> None:
    """Change names and features of instances in the map of ``job``, and update the job's completion record."""
    arrays = dict(np.load(io.BytesIO(files[f"{job}/prediction.npz"])))
    for name in {"features", "names", "view_names"} & arrays.keys():
        arrays[name] = arrays[name][::-1].copy()
    content = io.BytesIO()
    np.savez(content, **arrays)
    files[f"{job}/prediction.npz"] = content.getvalue()
    done = json.loads(files[f"{job}/done.json"])
    done["steps"]["predict"]["files"]["prediction.npz"] = digest_bytes(content.getvalue())
    files[f"{job}/done.json"] = json.dumps(done).encode()


def edit_record(files: Files, name: str, old: str, new: str) -> None:
    """Replace every ``old`` in the text of a record by ``new``; at least one exists."""
    assert old.encode() in files[name], (old, name)
    files[name] = files[name].replace(old.encode(), new.encode())
