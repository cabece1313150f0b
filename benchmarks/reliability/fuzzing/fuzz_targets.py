"""The table of readers of external files: tests and ``python benchmarks fuzz`` damage every row.

A row has a name, a function that writes a valid sample into a folder and returns the reading call, and files to damage.
"""

from __future__ import annotations

import atexit
import functools
import gzip
import itertools
import pickle
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from cli_calls import called
from fuzzing import Make, Read, Target, every_one_of
from places import CASES, SCENES

# ---- predictions


def _prediction(name: str, *, has_points: bool) -> Make:
    """A scene in the format of that name, with its own points or over the vertices of a mesh."""

    def make(folder: Path) -> Read:
        from prediction_files import write_small, written_in

        from su3d_bench.predictions.formats import READERS, recognise

        written = write_small(folder, name) if has_points else written_in(folder, name)
        (scene,) = READERS[name].scenes(written)
        reads = partial(recognise, written, None), partial(READERS[name].read, written, scene)
        return lambda: every_one_of(iter(reads))

    return make


OVER_VERTICES = (
    *("scannet-text", "scannet-semantic-text", "openmask3d", "maskclustering", "open3dis", "openyolo3d", "openins3d"),
    *("sam3d", "sam3d-colours", "su3d-bench", "scannetpp-semantic", "opensun3d-challenge"),
)
WITH_POINTS = (
    *("conceptgraphs", "gradslam", "hovsg", "hovsg-graph", "openlex3d", "ovo", "rayfronts", "esam", "onlineanyseg"),
    "fross",
)


# ---- one file of a format


def _file(name: str, content: Callable[[], bytes], read: Callable[[Path], object]) -> Target:
    def make(folder: Path) -> Read:
        (folder / name).write_bytes(content())
        return partial(read, folder / name)

    return Target(f"file {name}", make, (name,))


def _ply(path: Path) -> object:
    from su3d_bench.formats.ply import read_ply

    return read_ply(path)


def _pcd(path: Path) -> object:
    from su3d_bench.formats.pcd import read_pcd_points

    return read_pcd_points(path, "a.pcd")


def _arrays(path: Path) -> object:
    from su3d_bench.formats.numpy_files import read_npy, read_npz
    from su3d_bench.formats.pickles import read_pickle_file
    from su3d_bench.formats.torch_files import read_torch

    readers: dict[str, Any] = {".npy": read_npy, ".npz": read_npz, ".pkl": read_pickle_file, ".gz": read_pickle_file}
    return readers.get(path.suffix, read_torch)(path)


def _image(path: Path) -> object:
    from su3d_bench.formats.images import decode_colour, decode_depth, read_bytes

    decode = decode_depth if path.suffix == ".pgm" else decode_colour
    return decode(read_bytes(path, "a"), "a")


def _query_file(path: Path) -> object:
    from su3d_bench.questions.query_files import read_query_file

    return read_query_file(path)


def _questions(path: Path) -> object:
    from su3d_bench.questions.question_files import read_questions

    return read_questions(path)


def _rules(path: Path) -> object:
    from su3d_bench.metrics.protocols.loading import read_protocol

    return read_protocol(path)


def _ply_bytes(form: str) -> bytes:
    from test_ply import MIXED, mesh_bytes

    with tempfile.TemporaryDirectory() as folder:
        return mesh_bytes(Path(folder), form, MIXED)


def _pcd_bytes(form: str) -> bytes:
    from test_pcd import forms

    return forms()[form]


def _image_bytes(suffix: str) -> bytes:
    import cv2

    values = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 80
    if suffix == ".pgm":
        return b"P5\n# made\n32 24\n65535\n" + values.astype(">u2").tobytes()
    colours = np.repeat((values >> 8).astype(np.uint8)[..., None], 3, 2)
    return bytes(cv2.imencode(suffix, colours)[1])


def _saved(name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        np.save(path, np.arange(12.0).reshape(3, 4)) if name.endswith("npy") else np.savez_compressed(path, a=np.eye(9))
        return path.read_bytes()


def _a_map() -> bytes:
    from prediction_files import a_map, an_object

    return pickle.dumps(a_map(objects=[an_object(2, [0, 1], mask=[np.zeros((9, 9), np.bool_)])]), 4)


def _of_test(module: str, name: str) -> bytes:
    import importlib

    return str(getattr(importlib.import_module(module), name)).encode()


FILES = (
    *(_file(f"{form}.ply", partial(_ply_bytes, form), _ply) for form in ("ascii", "binary_little_endian")),
    *(_file(f"{form}.pcd", partial(_pcd_bytes, form), _pcd) for form in ("ascii", "binary", "binary_compressed")),
    *(_file(f"a{suffix}", partial(_image_bytes, suffix), _image) for suffix in (".jpg", ".png", ".pgm", ".ppm")),
    *(_file(name, partial(_saved, name), _arrays) for name in ("a.npy", "a.npz")),
    *(
        _file(name, (CASES / "torch_files" / name).read_bytes, _arrays)
        for name in ("strided.pt", "openins3d.pt", "open3dis.pth")
    ),
    _file("map.pkl", _a_map, _arrays),
    _file("map.pkl.gz", lambda: gzip.compress(_a_map()), _arrays),
    _file("q.toml", partial(_of_test, "test_query_files", "TOML"), _query_file),
    _file("q.csv", partial(_of_test, "test_query_files", "CSV"), _query_file),
    _file("scanrefer.json", partial(_of_test, "test_question_files", "SCANREFER"), _questions),
    _file("nr3d.csv", partial(_of_test, "test_question_files", "NR3D"), _questions),
    _file("rules.toml", lambda: _rules_text(), _rules),
)


def _rules_text() -> bytes:
    from su3d_bench.metrics.protocols.loading import rules_file

    return rules_file("rooms-semantic").read_bytes()


# ---- datasets


def _whole_dataset(name: str, folder: Path, scene: str) -> Read:
    """All calls to a dataset, each made even if previous ones failed."""
    from su3d_bench.core.registry import load

    def asked() -> Iterator[Read]:
        dataset: Any = load("dataset", name)(folder)
        yield from (dataset.scenes, partial(dataset.files, scene), partial(dataset.info, scene, 1))
        yield lambda: list(dataset.frames(scene, 1))
        yield from (partial(dataset.ground_truth, scene, variant) for variant in dataset.variants)
        yield from (partial(_used_up, dataset, question, scene) for question in ("surface", "problems", "queries"))

    return lambda: every_one_of(asked())


def _used_up(dataset: Any, question: str, scene: str) -> object:
    found = getattr(dataset, question)(scene) if hasattr(dataset, question) else None
    return list(found) if isinstance(found, Iterator) else found


def _replica(folder: Path) -> Read:
    from recording_files import grid, write_mesh
    from replica_scene import QUADS, TWO_OBJECTS, write_original, write_render

    write_render(folder, n_frames=2)
    write_original(folder, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    write_mesh(folder / "Replica/room0_mesh.ply", *grid(4, 2))
    return _whole_dataset("replica", folder, "room0")


def _scannet(folder: Path) -> Read:
    from scannet_scan import write_floor_truth, write_scan

    write_floor_truth(write_scan(folder, n_frames=2), spacing_m=0.5)
    return _whole_dataset("scannet", folder, "scene0000_00")


def _scannetpp(folder: Path) -> Read:
    from scannetpp_scene import SCENE, write_scene

    write_scene(folder, spacing_m=0.5)
    return _whole_dataset("scannetpp", folder, SCENE)


def _arkitscenes(folder: Path) -> Read:
    from arkitscenes_scene import SCENE, write_scene

    write_scene(folder)
    return _whole_dataset("arkitscenes", folder, SCENE)


def _hm3dsem(folder: Path) -> Read:
    from hm3dsem_walk import SCENE, write_walk

    write_walk(folder)
    return _whole_dataset("hm3dsem", folder, SCENE)


def _rgbd(folder: Path) -> Read:
    from recording_files import grid, write_mesh
    from rgbd_scene import write_scene

    write_mesh(write_scene(folder, n_frames=2, mesh="mesh.ply") / "data/mesh.ply", *grid(3, 2))
    return _whole_dataset("rgbd", folder, "desk")


# ---- runs, sheets, fetched files


@functools.cache
def _made_run() -> Path:
    """A folder with a finished run of two painted scenes; created once per process."""
    import pytest
    from painted import colour_perception

    from su3d_bench.runs import scene as scene_run

    folder = Path(tempfile.mkdtemp(prefix="fuzzrun")).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    painted, collector = f"{SCENES}/painted.py:Painted", f"{SCENES}/painted.py:Collector"
    words = ["run", "--scenes", f"{painted}/a", f"{painted}/b", "--methods", collector, f"{collector}@drop=1"]
    words += ["--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--jobs", "1", "--quiet"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setenv("SU3D_DATA", str(folder / "data"))
        called([*words, "--out", str(folder / "a")])
    return folder / "a"


def copied_run(folder: Path) -> Path:
    shutil.copytree(_made_run(), folder / "runs/a")
    return folder / "runs/a"


def _run(folder: Path) -> Read:
    """Everything that is read of a finished run."""
    from su3d_bench.analysis.tables import measured_results
    from su3d_bench.runs.finished import read_run, read_update_times

    path = copied_run(folder)

    def asked() -> Iterator[Read]:
        yield lambda: measured_results([path])
        run = read_run(path)
        for method in (*run.methods[:3], "collector"):
            yield partial(read_update_times, run, method)
            yield partial(run.scores, method)

    return lambda: every_one_of(asked())


def _verbs(folder: Path) -> Read:
    """Verbs that read a run folder, one after another."""
    run = copied_run(folder)
    words = (["report", "tables", str(run), "--json"], ["report", "timing", str(run)])
    pair = ["compare", f"{run}:collector", f"{run}:collector@drop=1"]
    commands = itertools.cycle([*words, pair])
    return lambda: called(next(commands))


def _bundle(folder: Path) -> Read:
    from su3d_bench.reproducing.bundle import bundle_runs, verify_bundle

    bundle_runs(folder / "a.zip", [_made_run()])
    return partial(verify_bundle, folder / "a.zip")


def _answers(folder: Path) -> Read:
    from simulated_annotators import answered, as_csv, retrieval_set

    from su3d_bench.human_eval.answers import check_answers, read_answers

    sheet, key = retrieval_set(4)
    rows = answered(sheet, key, {"ann": 0.0})
    (folder / "ann.csv").write_text(as_csv(rows))
    return lambda: check_answers(sheet, read_answers(folder / "ann.csv"))


def _gsa(folder: Path) -> Read:
    from test_perception_gsa import FRAME, PATTERN, SCENE, detections, write

    from su3d_bench.perception.stored_masks import GsaFiles

    write(folder, detections())
    return lambda: GsaFiles(folder, PATTERN, SCENE).frame(FRAME)


def _config(folder: Path) -> Read:
    from su3d_bench.core.config import check_keys, read_file

    (folder / "run.toml").write_bytes((_made_run() / "run.toml").read_bytes())
    return lambda: check_keys(read_file(folder / "run.toml"))


def _archive(name: str) -> Make:
    """A fetched archive, of which nothing may leave its folder."""

    def make(folder: Path) -> Read:
        from su3d_bench.fetching.archives import unpack_tar_gz, unpack_zip

        path, out, content = folder / name, folder / "out", folder / "Replica"
        (content / "room0").mkdir(parents=True)
        (content / "room0/traj.txt").write_bytes(b"1 0 0 0\n" * 40)
        if name.endswith("zip"):
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.write(content / "room0/traj.txt", "Replica/room0/traj.txt")
        else:
            with tarfile.open(path, "w:gz") as tar:
                tar.add(content, "Replica")

        def read() -> None:
            shutil.rmtree(out, ignore_errors=True)
            unpack: Any = unpack_zip if name.endswith("zip") else unpack_tar_gz
            unpack(path if name.endswith("zip") else [path], out, PurePosixPath, lambda *_: None)
            for found in out.rglob("*"):
                assert not found.is_symlink() and found.resolve().is_relative_to(out.resolve()), found

        return read

    return make


def _truth(folder: Path) -> Read:
    from evaluated_text import write_texts, write_truth

    from su3d_bench.evaluation.text_ground_truth import read_values
    from su3d_bench.evaluation.texts import read_text_features

    write_truth(folder, values=[0, 5001, 1163002, 39001, 7])
    write_texts(folder / "texts.npz", ["chair", "table"], {"chair": 1}, encoder="one")
    reads = partial(read_values, folder / "scene0001_00.txt"), partial(read_text_features, folder / "texts.npz")
    return lambda: every_one_of(iter(reads))


TARGETS = {
    one.name: one
    for one in (
        *(Target(f"prediction {name}", _prediction(name, has_points=False), ("**/*",)) for name in OVER_VERTICES),
        *(Target(f"prediction {name}", _prediction(name, has_points=True), ("**/*",)) for name in WITH_POINTS),
        *FILES,
        Target("dataset replica", _replica, ("**/*",), 0.5),
        Target("dataset scannet", _scannet, ("**/*",), 0.5),
        Target("dataset scannetpp", _scannetpp, ("data/*/scans/*", "data/*/iphone/**/*", "metadata/*/*"), 0.3),
        Target("dataset arkitscenes", _arkitscenes, ("**/*",), 0.3),
        Target("dataset hm3dsem", _hm3dsem, ("**/*",), 0.5),
        Target("dataset rgbd", _rgbd, ("**/*",), 0.5),
        Target("run", _run, ("runs/a/**/*",), 0.5),
        Target("verbs", _verbs, ("runs/a/**/*",), 0.3),
        Target("bundle", _bundle, ("a.zip",), 0.3),
        Target("answers ann.csv", _answers, ("ann.csv",)),
        Target("gsa detections", _gsa, ("**/*.pkl.gz",), 0.5),
        Target("configuration", _config, ("run.toml",)),
        *(Target(f"archive {name}", _archive(name), (name,)) for name in ("a.zip", "a.tar.gz")),
        Target("truth and texts", _truth, ("*.txt", "*.npz")),
    )
}
