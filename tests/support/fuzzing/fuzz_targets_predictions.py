"""What reads predictions of other programs and of runs: a small valid sample of each and the call that reads it."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from fuzzing import Make, Read, Target, every_one_of
from places import CASES

FILES = CASES / "predictions"


def _format(name: str) -> Make:
    """A scene in the format of that name, over the vertices of a mesh."""

    def make(folder: Path) -> Read:
        from prediction_files import written_in
        from test_predictions_faults import scene_name

        from su3d_bench.predictions.formats import READERS, recognise

        written = written_in(folder, name)

        def asked() -> Iterator[Read]:
            yield lambda: recognise(written, None)
            yield lambda: READERS[name].read(written, scene_name(name))

        return lambda: every_one_of(asked())

    return make


def _cloud_format(name: str) -> Make:
    """A scene in the format of that name, with points of its own."""

    def make(folder: Path) -> Read:
        from cloud_files import write_small

        from su3d_bench.predictions.formats import READERS, recognise

        written = write_small(folder, name)

        def asked() -> Iterator[Read]:
            yield lambda: recognise(written, None)
            yield lambda: READERS[name].read(written, "room0")

        return lambda: every_one_of(asked())

    return make


def _scannetpp(folder: Path) -> Read:
    """ScanNet++'s masks of runs, which both readers of lists take."""
    from prediction_files import TOY, write_scannetpp_json

    from su3d_bench.predictions.formats import READERS, recognise

    write_scannetpp_json(folder, TOY)
    by_lines, by_ids = READERS["scannetpp"], READERS["scannet-text"]

    def asked() -> Iterator[Read]:
        yield lambda: recognise(folder, None)
        for reader in (by_lines, by_ids):
            yield partial(reader.read, folder, "scene0011_00")

    return lambda: every_one_of(asked())


def _pickle(kind: str) -> Make:
    def make(folder: Path) -> Read:
        from test_predictions_pickles import written

        from su3d_bench.formats.numpy_files import read_npy_value
        from su3d_bench.formats.pickles.pickles import read_pickle_file

        path = folder / kind
        path.write_bytes(written(folder, kind))
        return lambda: read_npy_value(path) if kind.endswith(".npy") else read_pickle_file(path)

    return make


def _archive(name: str) -> Make:
    def make(folder: Path) -> Read:
        from test_predictions_torch import whole

        from su3d_bench.formats.numpy_files import read_npy, read_npz
        from su3d_bench.formats.torch_zip import read_torch, torch_kind

        path = folder / name
        path.write_bytes(whole(folder, name))

        def asked() -> Iterator[Read]:
            if path.suffix in (".npy", ".npz"):
                yield lambda: (read_npy if path.suffix == ".npy" else read_npz)(path)
            else:
                yield lambda: torch_kind(path)
                yield lambda: read_torch(path)

        return lambda: every_one_of(asked())

    return make


def _packed_masks(folder: Path) -> Read:
    """Masks of a scene that somebody has compressed."""
    from su3d_bench.predictions.formats import READERS

    masks = np.zeros((500, 7), np.bool_)
    masks[100:200, 3] = True
    np.savez_compressed(folder / "scene0011_00.npz", pred_masks=masks, pred_score=np.ones(7))
    return lambda: READERS["maskclustering"].read(folder, "scene0011_00")


def _own_prediction(kind: str) -> Make:
    """Our own file, as a run reads it again and as others' predictions are read."""

    def make(folder: Path) -> Read:
        from prediction_files import own_instances

        from su3d_bench.core.maps import DenseFeatures, Partition, Prediction
        from su3d_bench.store.predictions import read_prediction, write_prediction

        points = np.zeros((3, 3), np.float32)
        predictions: dict[str, Prediction] = {
            "instances": own_instances(),
            "partition": Partition(points, np.array([0, -1, 0], np.int32), np.ones((1, 4), np.float32)),
            "dense": DenseFeatures(points, np.ones((3, 4), np.float16)),
        }
        path = folder / "prediction.npz"
        write_prediction(path, predictions[kind])
        return lambda: read_prediction(path)

    return make


def _truth(folder: Path) -> Read:
    from evaluated_text import write_truth

    from su3d_bench.evaluation.text_truth import read_values

    write_truth(folder, values=[0, 5001, 1163002, 39001, 7])
    return lambda: read_values(folder / "scene0001_00.txt")


def _texts(folder: Path) -> Read:
    from evaluated_text import write_texts

    from su3d_bench.evaluation.texts import read_text_features

    write_texts(folder / "texts.npz", ["chair", "table"], {"chair": 1}, encoder="one")
    return lambda: read_text_features(folder / "texts.npz")


def _proposals(folder: Path) -> Read:
    from prediction_files import write_openmask3d, write_scannet_text
    from test_proposals import SCENE, flat

    from su3d_bench.baselines.openmask3d.proposals import digest_of_folder, read_proposals

    write_scannet_text(folder / "text", SCENE)
    write_openmask3d(folder / "torch", SCENE, np.zeros((3, 4)))

    def asked() -> Iterator[Read]:
        for name in ("text", "torch"):
            yield partial(digest_of_folder, folder / name)
            yield partial(read_proposals, folder / name, "room0", flat())

    return lambda: every_one_of(asked())


def _command_output(folder: Path) -> Read:
    """What a program that was run as a method left behind, made a map over the scene's mesh."""
    from prediction_files import TOY, write_openyolo3d
    from test_proposals import flat

    from su3d_bench.baselines.command.folders import as_prediction, read_output

    write_openyolo3d(folder, TOY)
    n = TOY["masks"].shape[1]
    return lambda: as_prediction(read_output(folder, TOY["name"], None).content, flat(n), {})


def _evaluated(folder: Path) -> Read:
    """Predictions, truth and texts from the command line to a score."""
    from cli_calls import called
    from evaluated_text import feature_scene, write_texts

    from su3d_bench.metrics.protocols.loading import load_protocol

    feature_scene(folder)
    names = [entry.name for entry in load_protocol("scannet-instance").classes]
    write_texts(folder / "texts.npz", names, {"chair": 3, "table": 9})
    words = ["evaluate", str(folder / "pred"), "--ground-truth", str(folder / "gt"), "--protocol", "scannet-instance"]
    return lambda: called([*words, "--text-features", str(folder / "texts.npz"), "--quiet"])


def _conceptgraphs_inside(folder: Path) -> Read:
    """A map whose gzip is left whole; see the pickles for the layers themselves."""
    from cloud_files import a_map, an_object, write_map

    from su3d_bench.predictions.formats import READERS

    file = write_map(folder / "room0/pcd_saves/full_pcd_x.pkl.gz", a_map(objects=[an_object(2, [0, 1], mask=[])]))
    plain = folder / "plain.pkl"
    plain.write_bytes(gzip.decompress(file.read_bytes()))

    def read() -> object:
        file.write_bytes(gzip.compress(plain.read_bytes() if plain.is_file() else b"", 1))
        return READERS["conceptgraphs"].read(folder, "room0")

    return read


OVER_VERTICES = (
    *("scannet-text", "scannet-semantic-text", "openmask3d", "maskclustering", "open3dis", "openyolo3d", "openins3d"),
    *("sam3d", "sam3d-colours", "su3d-bench", "scannetpp-semantic", "opensun3d-challenge"),
)
WITH_OWN_POINTS = ("conceptgraphs", "hovsg", "openlex3d", "ovo", "rayfronts", "esam", "onlineanyseg", "fross")
TARGETS = (
    *(Target(f"prediction {name}", _format(name), ("**/*",)) for name in OVER_VERTICES),
    *(Target(f"prediction {name}", _cloud_format(name), ("**/*",)) for name in WITH_OWN_POINTS),
    Target("prediction hovsg-graph", _cloud_format("hovsg-graph"), ("**/*",)),
    Target("prediction gradslam", _cloud_format("gradslam"), ("**/pc_points.h5", "**/pc_embeddings.h5")),
    Target("prediction conceptgraphs inside", _conceptgraphs_inside, ("plain.pkl",)),
    Target("prediction scannet++", _scannetpp, ("**/*",)),
    *(
        Target(f"pickle {kind}", _pickle(kind), (kind,))
        for kind in ("map.pkl", "old.pkl", "map.pkl.gz", "object_dict.npy")
    ),
    *(Target(f"archive {name}", _archive(name), (name,)) for name in ("strided.pt", "openins3d.pt", "open3dis.pth")),
    *(Target(f"archive {name}", _archive(name), (name,)) for name in ("a.npy", "a.npz")),
    Target("archive of packed masks", _packed_masks, ("*.npz",)),
    *(Target(f"own {kind}", _own_prediction(kind), ("*",)) for kind in ("instances", "partition", "dense")),
    Target("truth as text", _truth, ("*.txt",)),
    Target("text features", _texts, ("*.npz",)),
    Target("proposals", _proposals, ("**/*",)),
    Target("output of a command", _command_output, ("**/*",)),
    Target("evaluate", _evaluated, ("pred/*", "gt/*", "texts.npz"), 0.05),
)
