"""Rule attribution works between every two protocols of one kind and dataset, and its steps sum to the difference.

A small room is read through the adapters of Replica and ScanNet from files in their layouts, with third-party ground
truths, and the oracle's map is replaced by a faulty one.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from replica_scene import first_pose, write_clouds
from written_scenes import write_scene

from su3d_bench.analysis.attribution import Inputs
from su3d_bench.analysis.rule_attribution import KINDS, RuleStepper
from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, GroundTruth, UInt8Array
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.recordings.meshes import vertex_positions
from su3d_bench.datasets.replica.truth import OVO_CLASSES
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.formats.ply import read_ply
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.protocols.loading import class_names, load_protocol, protocol_names
from su3d_bench.metrics.protocols.mixtures import Mixtures
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.numerics.statistics import EXACT_STEPS, N_ORDERS
from su3d_bench.runs import finished
from su3d_bench.runs.finished import read_run
from su3d_bench.store.predictions import write_prediction

ROOM = "bathroom0"
ADDRESS = {"replica": f"replica/{ROOM}", "scannet": "scannet/scene9400_00", "rooms": f"rooms/{ROOM}"}
ANY = {"replica": "replica-mesh-ex6", "scannet": "scannet-instance", "rooms": "rooms-instance"}  # for the oracle's run
RULES = [load_protocol(name) for name in protocol_names()]


def pairs_of(dataset: str) -> Iterator[tuple[ProtocolRules, ProtocolRules]]:
    fitting = [rules for rules in RULES if rules.kind in KINDS and dataset in rules.datasets]
    for first, second in combinations(fitting, 2):
        is_one = (first.kind, first.label_space) == (
            second.kind,
            second.label_space,
        )  # a ground truth has one label set
        if is_one and set(first.headline) & set(second.value_names):
            yield first, second


PAIRS = [(dataset, first, second) for dataset in ADDRESS for first, second in pairs_of(dataset)]


def pairs_to_walk() -> Iterator[Any]:
    """All pairs; only the first of each dataset and one with many groups run outside proofs."""
    seen = set[Any]()
    for dataset, first, second in PAIRS:
        gives: set[Any] = {dataset}
        if not {True, False} <= seen:
            gives.add(len(Mixtures(first, second).groups) > EXACT_STEPS)
        yield pytest.param(dataset, first, second, marks=[] if gives - seen else pytest.mark.proof)
        seen |= gives


class NamingEncoder:
    """The feature of a text is that of the longest class name in it, plus a smaller one of the exact wording."""

    name, digest, dim = "naming", "naming-1", 24

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("rule attribution must not encode images")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.stack([self._feature(text) for text in texts])

    def _feature(self, text: str) -> Float32Array:
        name = max((name for name in class_names() if name in text), key=len, default=text)
        drawn = [np.random.default_rng(zlib.crc32(one.encode())).normal(size=self.dim) for one in (name, text)]
        return (drawn[0] + 0.4 * drawn[1]).astype(np.float32)


def faulty_map(truth: GroundTruth) -> Instances:
    """Masks of ground-truth objects with gaps and ragged edges, some split, merged or mislabelled."""
    generator = np.random.default_rng(3)
    points = (truth.points + generator.normal(0, 0.004, truth.points.shape)).astype(np.float32)
    points[::7] += np.float32(0.03)
    name_of = dict(zip(truth.labels.ids, truth.labels.names, strict=True))
    masks, texts = list[Any](), list[str]()
    for k, number in enumerate(np.unique(truth.instance[truth.instance > 0])):
        rows = np.flatnonzero(truth.instance == number)
        rows = rows[generator.random(len(rows)) > 0.1]
        name = name_of.get(int(np.bincount(np.maximum(truth.semantic[rows], 0)).argmax()) if len(rows) else 0, "wall")
        ragged = np.union1d(rows, generator.integers(0, len(points), len(rows) // 9 + 1))
        masks += [ragged[: len(ragged) // 2], ragged[len(ragged) // 2 :]] if k % 5 == 4 else [ragged]
        texts += [name] * (len(masks) - len(texts)) if k % 4 else ["chair"] * (len(masks) - len(texts))
    masks.append(np.union1d(masks[0], masks[1]))
    features = NamingEncoder().encode_texts([*(f"some {text}" for text in texts), "some table"])
    return Instances.of(points, masks, generator.random(len(masks)).astype(np.float32).tolist(), features)


def write_others_truths(root: Path) -> None:
    """Write third-party ground truths for Replica: two label files and the clouds of ConceptGraphs."""
    dataset_class = registry.load("dataset", "replica")
    truth = dataset_class(root, dataset_class.Options()).ground_truth(ROOM, "mesh-vertices")
    (mesh,) = root.glob("Replica/*_mesh.ply")
    vertices = vertex_positions(read_ply(mesh), "mesh")
    _, row = nearest(truth.points, vertices)
    semantic, instance = np.maximum(truth.semantic[row], 0), np.maximum(truth.instance[row], 0)
    values = np.where(instance > 0, semantic * 1000 + instance, 0)
    classes = np.where(np.isin(semantic, OVO_CLASSES), semantic, -1)
    for folder, numbers in (("ground_truth", values), ("semantic_gt", classes)):
        (root / "Replica" / folder).mkdir(parents=True, exist_ok=True)
        (root / "Replica" / folder / f"{ROOM}.txt").write_text("".join(f"{number}\n" for number in numbers))
    first = first_pose()
    in_camera = (truth.points - first[:3, 3]) @ first[:3, :3]
    write_clouds(root, in_camera, np.maximum(truth.semantic, 0), truth.points[::2] + np.float32(0.002), ROOM)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Dataset -> folder with a run of the room whose map has faults."""
    folder = tmp_path_factory.mktemp("pairs")
    options = Rooms.Options(width=64, height=48, n_frames=3, mesh_spacing_m=0.09)
    rooms, found = Rooms(folder / "cache", options), {}
    small = [f"rooms.{key}={getattr(options, key)}" for key in ("width", "height", "n_frames", "mesh_spacing_m")]
    for dataset, address in ADDRESS.items():
        root = folder / dataset
        if dataset != "rooms":
            write_scene(LAYOUTS[dataset], rooms, ROOM, root)
        if dataset == "replica":
            write_others_truths(root)
        words = ["run", "--scenes", address, "--methods", "oracle", "--protocols", ANY[dataset], "--no-pictures"]
        words += ["--set", *small] if dataset == "rooms" else []
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("SU3D_DATA", str(root))
            patch.setenv("SU3D_CACHE", str(folder / "cache"))
            assert main([*words, "--jobs", "1", "--quiet", "--out", str(folder / f"run-{dataset}")]) == 0
            run = read_run(folder / f"run-{dataset}")
            (scene,) = run.scenes
            rules = load_protocol(ANY[dataset])
            truth = run.dataset(scene).ground_truth(scene.partition("/")[2], rules.ground_truth)
            write_prediction(run.folder.job(scene, "oracle").prediction, faulty_map(truth))
        found[dataset] = folder
    return found


@pytest.fixture(autouse=True)
def _places(runs: dict[str, Path], request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = request.node.callspec.params["dataset"]
    monkeypatch.setenv("SU3D_DATA", str(runs[dataset] / dataset))
    monkeypatch.setenv("SU3D_CACHE", str(runs[dataset] / "cache"))
    monkeypatch.setattr(finished, "encoder_of", lambda run, device: NamingEncoder())
    # The map in the oracle's place is a faulty one, which does not use ground truth
    monkeypatch.setattr(finished.FinishedRun, "truth_part", lambda run, method: None)


def alone(rules: ProtocolRules, run_folder: Path) -> Any:
    """The numbers of the run's map under one protocol, computed without rule attribution."""
    run = read_run(run_folder)
    (scene,) = run.scenes
    truth = run.dataset(scene).ground_truth(scene.partition("/")[2], rules.ground_truth)
    prediction = Inputs(run, "oracle").of_map(scene)
    return combine(rules, {scene: score_scene(rules, truth, prediction, NamingEncoder())}).metrics


@pytest.mark.parametrize(("dataset", "first", "second"), [*pairs_to_walk()], ids=lambda one: getattr(one, "name", one))
def test_steps_between_two_protocols_sum_to_the_difference_of_their_numbers(
    dataset: str, first: ProtocolRules, second: ProtocolRules, runs: dict[str, Path]
) -> None:
    folder = runs[dataset] / f"run-{dataset}"
    walk = RuleStepper.of(first, second, str(folder)).walk()
    is_exact = len(walk.steps) <= EXACT_STEPS
    assert walk.n_orders == (None if is_exact else N_ORDERS)
    for rules, printed in ((first, walk.start), (second, walk.end)):
        known = alone(rules, folder)
        assert {name: known[name] for name in printed} == pytest.approx(printed, abs=1e-12)
    for name in walk.start:
        parts = [step.adds[name] for step in walk.steps]
        assert math.fsum(part.share for part in parts) == pytest.approx(walk.end[name] - walk.start[name], abs=1e-12)
        for part in parts:
            assert part.least - 1e-12 <= part.share <= part.most + 1e-12
            assert (part.standard_error == 0.0) if is_exact or part.least == part.most else part.standard_error > 0.0


@pytest.mark.parametrize("dataset", ADDRESS)
def test_faulty_map_is_neither_perfect_nor_empty(dataset: str, runs: dict[str, Path]) -> None:
    for rules in {rules.name: rules for one, *pair in PAIRS if one == dataset for rules in pair}.values():
        value = alone(rules, runs[dataset] / f"run-{dataset}")[rules.headline[0]]
        assert 0.02 < value < 0.98, rules.name
