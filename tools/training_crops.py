"""Training crops cut from rendered homes: windows as placed by a segmenter, with their content."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
from training_captions import CropTruth, Neighbour

from su3d_bench.core import registry
from su3d_bench.core.system.files import file_text, regular
from su3d_bench.core.types import Float32Array, Float64Array, Frame, Int32Array, Int64Array, Regions, UInt8Array
from su3d_bench.datasets.homes.furnish import KINDS
from su3d_bench.perception.cache import crop_window, mask_boxes
from su3d_bench.perception.embedded.encoder import IMAGE_SIZE, log_size, shrink
from su3d_bench.perception.embedded.join_rules import SegmenterConfig
from su3d_bench.perception.embedded.segmenter import RgbdSegmenter

TRAINING, MEASURED = "training", "seed"  # series of homes: without held-out models, and with all
FIRST_MEASURED_NUMBER = 990_000
# Where the camera stands: heights and distances of a person and of a robot, m; it looks at some object.
HEIGHTS, DISTANCES = (0.5, 1.75), (0.7, 3.2)
TRIES = 12  # candidate views of an image; the one that shows most objects is rendered
MIN_VIEW_PIXELS = 80
# A neighbour counts as shown if it fills this part of the window, or if this part of its visible pixels is inside.
SHOWN_OF_WINDOW, SHOWN_OF_NEIGHBOUR = 0.02, 0.5
# Ratio from which a window shows the kind of room, if it covers this part of the image.
ROOM_PART_OF_IMAGE = 0.25
HELD = ("on", "in")  # the holder is shown "with" what it holds; of other pairs the ground truth has both directions
TIGHT_RATIOS = (0.8, 1.0, 1.2)
WIDE_RATIOS = (2.0, 2.0, 4.0)
# A region of the segmenter is assigned to the object that owns at least this part of its pixels.
MIN_PURITY = 0.6
SEGMENTER_LEVELS: tuple[Literal["objects", "parts"], ...] = ("objects", "parts")


@dataclass(frozen=True)
class CropSet:
    """N crops: ``pixels`` (N, 64, 64, 3) uint8, ``log_sizes`` (N, 2) float32, their content, and how they were cut.

    ``ratios`` (N,) float32 are crop ratios, 0 for a whole image; ``is_exact`` (N,): whether the box was the object's;
    ``homes`` (N,): the number of the home.
    """

    pixels: UInt8Array
    log_sizes: Float32Array
    truths: tuple[CropTruth, ...]
    ratios: Float32Array
    is_exact: np.ndarray[Any, np.dtype[np.bool_]]
    homes: Int64Array

    def __len__(self) -> int:
        return len(self.truths)

    def first(self, n: int) -> CropSet:
        """The first ``n`` crops."""
        return CropSet(
            self.pixels[:n], self.log_sizes[:n], self.truths[:n], self.ratios[:n], self.is_exact[:n], self.homes[:n]
        )


def home_names(series: str, n_homes: int, first_number: int = 0) -> list[str]:
    """The names of ``n_homes`` homes of a series; never one of a benchmark."""
    return [f"{series}{first_number + index}" for index in range(n_homes)]


def make_crops(scenes: Sequence[str], frames_per_home: int, seed: int, folder: Path, jobs: int) -> CropSet:
    """The crops of ``scenes``, read from ``folder`` if an earlier call wrote them, otherwise rendered into it."""
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [(scene, frames_per_home, seed, folder) for scene in scenes if not _facts_path(folder, scene).is_file()]
    if jobs == 1 or len(tasks) < 2:
        for task in tasks:
            _render_home(task)
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            list(pool.map(_render_home, tasks))
    return read_crops(scenes, folder)


def read_crops(scenes: Sequence[str], folder: Path) -> CropSet:
    """The crops of ``scenes`` from the files written by ``make_crops``."""
    facts = [json.loads(file_text(_facts_path(folder, scene))) for scene in scenes]
    rows = [row for of_scene in facts for row in of_scene]
    pixels = np.empty((len(rows), IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
    start = 0
    for scene, of_scene in zip(scenes, facts, strict=True):
        pixels[start : start + len(of_scene)] = np.load(regular(_pixels_path(folder, scene)))
        start += len(of_scene)
    return CropSet(
        pixels,
        np.array([row[7] for row in rows], np.float32).reshape(-1, 2),
        tuple(_crop_truth(row) for row in rows),
        np.array([row[8] for row in rows], np.float32),
        np.array([row[9] for row in rows], np.bool_),
        np.repeat(np.arange(len(facts)), [len(of_scene) for of_scene in facts]),
    )


def _crop_truth(row: list[Any]) -> CropTruth:
    name, colour, material, size_word, neighbours, room, model = row[:7]
    return CropTruth(name, colour, material, size_word, tuple(Neighbour(*item) for item in neighbours), room, model)


def _facts_path(folder: Path, scene: str) -> Path:
    return folder / f"{scene}.json"


def _pixels_path(folder: Path, scene: str) -> Path:
    return folder / f"{scene}.npy"


def _render_home(task: tuple[str, int, int, Path]) -> None:
    scene, n_frames, seed, folder = task
    homes = registry.load("dataset", "homes")(folder / "no cache")
    rng = np.random.default_rng([seed, *scene.encode()])
    built, truth = homes.built(scene), homes.truth(scene)
    segmenters = [RgbdSegmenter(SegmenterConfig(), level) for level in SEGMENTER_LEVELS]
    pixels, facts = [], []
    for count in range(n_frames):
        pose = _best_view(built, truth, rng)
        view = built.renderer.render(pose)
        frame = Frame(count, 0.0, view.rgb, view.depth_m, pose, homes.intrinsics)
        regions = segmenters[count % len(segmenters)].segment(frame)
        shown = _View(view.instance, truth, _room_at(built.plan, pose[:2, 3]))
        for crop, row in _view_crops(view.rgb, shown, regions, rng):
            pixels.append(crop)
            facts.append(row)
    np.save(_pixels_path(folder, scene), np.stack(pixels))
    # The facts come last: their presence marks the home as complete.
    _facts_path(folder, scene).write_text(json.dumps(facts))


def _room_at(plan: Any, place: Float64Array) -> str:
    """The kind of room at a place (2,), or of the first zone in the doorway between two."""
    zones = plan.layout.zones
    return str(KINDS[next((zone for zone in zones if zone.contains(place)), zones[0]).kind].suits[0])


def _best_view(built: Any, truth: Any, rng: np.random.Generator) -> Float64Array:
    """Of a few random poses that look at an object from a free place, the one that shows most objects."""
    free, origin = built.plan.free(0.1)
    cells = (np.argwhere(free) + 0.5) * 0.1 + origin
    best, most = np.eye(4), -1.0
    small = built.coarser(80)
    every = np.arange(small.width * small.height)
    for _ in range(TRIES):
        target = np.array(truth.objects[int(rng.integers(len(truth.objects)))].centre)
        distance = np.linalg.norm(cells - target[:2], axis=1)
        near = np.flatnonzero((distance > DISTANCES[0]) & (distance < DISTANCES[1]))
        if not len(near):
            continue
        eye = np.array([*cells[int(rng.choice(near))], float(rng.uniform(*HEIGHTS))])
        pose = _looking(eye, target + rng.normal(0.0, 0.25, 3))
        depth, ids = small.depth_and_instance(pose, every)
        n_shown = len(np.unique(ids)) - 40.0 * float((depth < 0.4).mean())
        if n_shown > most:
            best, most = pose, n_shown
    return best


def _looking(eye: Float64Array, target: Float64Array) -> Float64Array:
    forward = (target - eye) / max(float(np.linalg.norm(target - eye)), 1e-6)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-6)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = eye
    return pose


def _view_crops(
    rgb: UInt8Array, view: _View, regions: Regions, rng: np.random.Generator
) -> Iterator[tuple[UInt8Array, list[Any]]]:
    """The crops of one image: a few per object, one per region of the segmenter, and the whole image."""
    height, width = view.instance.shape
    for object_id in np.flatnonzero(view.counts >= MIN_VIEW_PIXELS).tolist():
        if object_id == 0:
            continue
        for box, ratio, is_exact in _boxes(view.instance == object_id, rng):
            window = crop_window(box, ratio, width, height)
            yield _cut(rgb, window), _row(view.truth_of(object_id, window), window, ratio, is_exact)
    for mask, box in zip(regions.masks, regions.boxes, strict=True):
        owners = np.bincount(view.instance[mask], minlength=1)
        owner = int(owners.argmax())
        if owner and owners[owner] >= MIN_PURITY * owners.sum():
            ratio = float(rng.choice((*TIGHT_RATIOS, 2.0)))
            window = crop_window(box, ratio, width, height)
            yield _cut(rgb, window), _row(view.truth_of(owner, window), window, ratio, False)
    window = np.array([0, 0, width, height])
    yield _cut(rgb, window), _row(view.whole(), window, 0.0, True)


def _cut(rgb: UInt8Array, window: Int64Array) -> UInt8Array:
    x0, y0, x1, y1 = window.tolist()
    return shrink(rgb[y0:y1, x0:x1])


def _row(crop: CropTruth, window: Int64Array, ratio: float, is_exact: bool) -> list[Any]:
    x0, y0, x1, y1 = window.tolist()
    return [*astuple(crop), log_size(y1 - y0, x1 - x0), ratio, is_exact]


def _boxes(mask: np.ndarray[Any, Any], rng: np.random.Generator) -> Iterator[tuple[Float32Array, float, bool]]:
    """Boxes, ratios, and whether the box is exact: the object's box, an inaccurate one, a part of it, a wide one."""
    box = mask_boxes(mask[None])[0]
    yield box, float(rng.choice(TIGHT_RATIOS)), True
    size = np.array([box[2] - box[0], box[3] - box[1]] * 2, np.float32)
    careless = (box + rng.uniform(-0.18, 0.18, 4) * size).astype(np.float32)
    yield careless, float(rng.choice(TIGHT_RATIOS)), False
    part = _part_box(mask, box, rng)
    if part is not None:
        yield part, float(rng.choice((1.0, 1.2))), False
    wide = box if rng.random() < 0.6 or part is None else part
    yield wide, float(rng.choice(WIDE_RATIOS)), wide is box


def _part_box(mask: np.ndarray[Any, Any], box: Float32Array, rng: np.random.Generator) -> Float32Array | None:
    """A rectangle of 15 to 70 % of ``box``, mostly filled by the object, like a region of an over-segmentation."""
    x0, y0, x1, y1 = (int(value) for value in box)
    for _ in range(6):
        width, height = (int(max(6, side * rng.uniform(0.35, 0.9))) for side in (x1 - x0, y1 - y0))
        left = int(rng.integers(x0, max(x0, x1 - width) + 1))
        top = int(rng.integers(y0, max(y0, y1 - height) + 1))
        inside = mask[top : top + height, left : left + width]
        if inside.mean() > 0.55:
            part: Float32Array = mask_boxes(inside[None])[0] + np.array([left, top, left, top], np.float32)
            return part
    return None


class _View:
    """Content of one image: visible pixels and relations by object."""

    def __init__(self, instance: Int32Array, truth: Any, room: str) -> None:
        self.instance = instance
        self._room = room
        self._objects = {item.id: item for item in truth.objects}
        n_ids = 1 + max(self._objects)
        self.counts = np.bincount(instance.ravel(), minlength=n_ids)
        self._related: dict[int, list[tuple[str, int]]] = {}
        for link in truth.relations:
            self._related.setdefault(link.subject, []).append((link.relation, link.object))
            if link.relation in HELD:
                self._related.setdefault(link.object, []).append(("with", link.subject))

    def truth_of(self, object_id: int, window: Int64Array) -> CropTruth:
        """The ground truth of a window around ``object_id``, with only those neighbours that the window shows."""
        x0, y0, x1, y1 = window.tolist()
        inside = np.bincount(self.instance[y0:y1, x0:x1].ravel(), minlength=len(self.counts))
        area = (x1 - x0) * (y1 - y0)
        shown = (inside >= SHOWN_OF_WINDOW * area) | (inside >= SHOWN_OF_NEIGHBOUR * np.maximum(self.counts, 1))
        neighbours = {
            Neighbour(relation, self._objects[other].class_name, self._objects[other].colour): None
            for relation, other in self._related.get(object_id, [])
            if shown[other] and inside[other] > 0
        }
        item = self._objects[object_id]
        shows_room = area >= ROOM_PART_OF_IMAGE * self.instance.size
        return CropTruth(
            item.class_name,
            item.colour,
            item.material,
            item.size_word,
            tuple(neighbours),
            self._room if shows_room else "",
            item.model,
        )

    def whole(self) -> CropTruth:
        """The ground truth of the whole image: the kind of room, and its most prominent content."""
        large = np.flatnonzero(self.counts >= 0.01 * self.instance.size)
        seen = [self._objects[int(object_id)] for object_id in large if object_id]
        shown = {Neighbour("with", item.class_name, item.colour): None for item in seen if item.support != "room"}
        return CropTruth("", "", "", "", tuple(shown), self._room)
