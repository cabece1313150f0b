"""The error gallery of a page: the most costly errors of each scene, with photos of the worst ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.analysis.attribution import Explained
from su3d_bench.analysis.page.scene import SKETCH_WIDTH, SceneData, fed_frames
from su3d_bench.core.errors import Su3dError, printable
from su3d_bench.core.types import BoolArray, Float32Array, Frame, UInt8Array
from su3d_bench.metrics.attribution.arrays import EvaluatedScene, SingleError
from su3d_bench.metrics.matching.nearest import Points
from su3d_bench.reports.page.maps import frame_cover, jpeg_text
from su3d_bench.reports.pictures.items import PIXEL_STEP, best_view, draw_outline, fitted, seen_in, window_around

PHOTO = (256, 192)  # width and height
PREDICTED, TRUTH = (255, 64, 200), (0, 96, 255)  # an area and an outline: distinguishable without colours, too
SHADE = 0.45  # opacity of the area over the photo
MIN_ROWS = 48.0  # of a mask, which has one row for every second row of the frame
MAX_POINTS = 20_000  # points of a mask that are projected into a frame
PROBES = 16  # points of a mask from which its spacing is estimated
JPEG_QUALITY = 60


@dataclass(frozen=True)
class ErrorView:
    """The points (N, 3) m of each ``predicted`` mask and of each object of the ground ``truth``."""

    predicted: tuple[Float32Array, ...]
    truth: tuple[Float32Array, ...]

    @property
    def points(self) -> Float32Array:
        return np.concatenate([np.zeros((0, 3), np.float32), *self.predicted, *self.truth])


def error_photo(frame: Frame, error: ErrorView) -> UInt8Array | None:
    """A photo (192, 256, 3) with predictions as an area and an outline around each ground-truth object.

    None if the frame shows neither. With several masks, each also has a thin outline.
    """
    areas = [seen_mask(frame, points) for points in error.predicted]
    objects = [seen_mask(frame, points) for points in error.truth]
    seen = np.any([*areas, *objects], axis=0)
    if not seen.any():
        return None
    rows, columns = window_around(seen, PHOTO[0] / PHOTO[1], MIN_ROWS)
    part = tuple(slice(one.start * PIXEL_STEP, one.stop * PIXEL_STEP) for one in (rows, columns))
    shown = fitted(np.ascontiguousarray(frame.rgb[part]), PHOTO)
    area = np.any([np.zeros_like(seen), *areas], axis=0)[rows, columns]
    is_area = fitted(area.astype(np.uint8) * 255, PHOTO) > 127
    shown[is_area] = ((1 - SHADE) * shown[is_area] + SHADE * np.array(PREDICTED, np.float32)).astype(np.uint8)
    for mask in areas if len(areas) > 1 else ():
        draw_outline(shown, mask[rows, columns], line=1, colour=PREDICTED, halo=0)
    for mask in objects:
        draw_outline(shown, mask[rows, columns], line=2, colour=TRUTH, halo=2 if len(objects) == 1 else 0)
    return shown


def seen_mask(frame: Frame, points: Float32Array) -> BoolArray:
    """Mask of every ``PIXEL_STEP``-th pixel in which the frame shows ``points`` (N, 3) m unoccluded, gaps closed."""
    import cv2

    height, width = frame.depth_m.shape
    mask = np.zeros((-(-height // PIXEL_STEP), -(-width // PIXEL_STEP)), np.uint8)
    looked_for = points[:: -(-len(points) // MAX_POINTS) or 1].astype(np.float64)
    columns, rows, is_seen = seen_in(frame, looked_for)
    if not is_seen.any():
        return mask.astype(bool)
    mask[rows[is_seen].astype(np.int64) // PIXEL_STEP, columns[is_seen].astype(np.int64) // PIXEL_STEP] = 1
    depth_m = (looked_for[is_seen] - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, 2]
    pixels = _spacing(looked_for) * frame.intrinsics[0, 0] / max(float(np.median(depth_m)), 1e-6) / PIXEL_STEP
    reach = int(np.clip(np.ceil(pixels), 1, width // 16 or 1))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    padded = np.pad(mask, reach)  # so that the image border does not affect the closing
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[reach:-reach, reach:-reach]
    return closed.astype(bool)


def _spacing(points: np.ndarray) -> float:
    """The distance between neighbouring points, in metres."""
    if len(points) < 2:
        return 0.0
    probes = points[np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)]
    squared = ((points[None] - probes[:, None]) ** 2).sum(axis=2)
    return float(np.median(np.sqrt(np.partition(squared, 1, axis=1)[:, 1])))


MAX_ERRORS = 40  # listed errors of a scene under a method and a protocol
MAX_PHOTOS = 64  # on a page, distributed over its scenes, each of which has at least one per method
CANDIDATES = 24  # frames of a scene in which objects are searched for
MAX_FRAMES = 6  # frames of a scene from which photos are taken
PHOTO_WIDTH = 320  # of a frame for photos, if reading it smaller saves time
AS_GOOD = 0.7  # fraction of an object's best view score that is good enough to share a frame with other objects
MAX_NAMES, MAX_TEXT = 6, 60  # classes that a card names, characters of a name
ONLY_WORST_NOTE = "only the worst errors of a scene have a photo"


@dataclass(frozen=True)
class Card:
    """One error. ``gains``: increase of each metric if only this error is corrected, as fractions, None if undefined.

    ``true`` and ``called`` are names of classes, ``ids`` the method's instance ids, ``rows`` their rows in its map,
    ``objects`` ground-truth instance numbers, ``n_points`` the number of points of the masks, or of wrong points,
    ``n_true`` that of the true object. ``photo`` is an index into the scene's photos, ``frame`` the frame it was taken
    from; ``why``: the reason if there is none.
    """

    kind: str
    true: tuple[str, ...]
    called: tuple[str, ...]
    ids: tuple[int, ...]
    rows: tuple[int, ...]
    objects: tuple[int, ...]
    score: float | None
    iou: float | None
    n_points: int
    n_true: int
    gains: tuple[float | None, ...]
    photo: int | None = None
    frame: int | None = None
    why: str | None = ONLY_WORST_NOTE


@dataclass(frozen=True)
class Cards:
    """The ``n`` errors of a scene under a method and a protocol; ``cards`` lists the most costly ones.

    ``truth``: the ground-truth variant whose numbers the objects have.
    """

    run: int
    method: str
    protocol: str
    kind: str
    truth: str
    metrics: tuple[str, ...]
    n: int
    cards: tuple[Card, ...]


@dataclass(frozen=True)
class SceneGallery:
    """The errors of one scene; ``photos`` are JPEGs in base64."""

    scene: str
    of_methods: tuple[Cards, ...]
    photos: tuple[str, ...]


def summary_of(galleries: Sequence[SceneGallery]) -> list[dict[str, Any]]:
    """A summary of galleries by method and protocol: number of errors per scene, and their classes, kinds and pairs."""
    summary: dict[tuple[int, str, str], dict[str, Any]] = {}
    for gallery in galleries:
        for one in gallery.of_methods:
            about = {"run": one.run, "method": one.method, "protocol": one.protocol}
            empty: dict[str, Any] = {"scenes": [], "n": [], "listed": [], "kinds": {}, "classes": {}, "pairs": {}}
            of = summary.setdefault((one.run, one.method, one.protocol), about | empty)
            if one.cards:
                of["scenes"].append(gallery.scene)
                of["n"].append(one.n)
                of["listed"].append(len(one.cards))
            for card in one.cards:
                of["kinds"][card.kind] = None
                of["classes"] |= dict.fromkeys((*card.true, *card.called))
                of["pairs"] |= dict.fromkeys((true, called) for true in card.true for called in card.called)
    lists = ("kinds", "classes", "pairs")
    return [{name: list(value) if name in lists else value for name, value in one.items()} for one in summary.values()]


def photos_of_each(n_scenes: int, n_methods: int) -> int:
    """The number of photos of each scene on a page of ``n_scenes`` scenes and ``n_methods`` methods.

    >>> photos_of_each(4, 2), photos_of_each(20, 8)
    (16, 8)
    """
    return max(n_methods, MAX_PHOTOS // max(1, n_scenes))


class GalleryOfScene:
    """Collects the errors of a scene, method by method, and then takes the photos."""

    def __init__(self, scene: str, max_photos: int) -> None:
        self._scene, self._max_photos = scene, max_photos
        self._cards: list[tuple[Cards, list[ErrorView]]] = []
        self._fed: list[int] = []

    def add(self, index: int, explained: Explained, evaluated: Mapping[str, EvaluatedScene]) -> None:
        """Add the errors of the method of ``explained``, from run ``index``, under each protocol."""
        self._fed += fed_frames(explained.run, self._scene, explained.method)
        ids, method = explained.instance_ids(self._scene), printable(explained.method, 200)
        for protocol, scene in evaluated.items():
            n, errors = explained.errors(self._scene, protocol, scene, MAX_ERRORS)
            rules, metrics = explained.run.rules(protocol), tuple(explained.rules(protocol).headline)
            cards = tuple(_card(error, scene, metrics, ids) for error in errors)
            points = scene.points
            seen = [
                ErrorView(_places(points, one.predicted), _places(points, one.truth))
                for one in errors[: self._max_photos]
            ]
            summary = Cards(index, method, protocol, rules.kind, rules.ground_truth, metrics, n, cards)
            self._cards.append((summary, seen))

    def finish(self, dataset: Any, data: SceneData) -> SceneGallery:
        """The gallery with photos of the worst errors; ``dataset`` is the reason as text if there is no dataset."""
        # the first error of every method, then the second of each, and so on
        places = sorted((k, of) for of, (_, seen) in enumerate(self._cards) for k in range(len(seen)))
        places = places[: self._max_photos]
        taken: Sequence[tuple[int, str] | str] = [str(dataset)] * len(places)
        if places and not isinstance(dataset, str):
            try:
                taken = _photos([self._cards[of][1][k] for k, of in places], dataset, data, self._fed)
            except Su3dError as error:
                taken = [str(error)] * len(places)
        cards, photos = [list(summary.cards) for summary, _ in self._cards], list[str]()
        for (k, of), photo in zip(places, taken, strict=True):
            if isinstance(photo, str):
                cards[of][k] = replace(cards[of][k], why=printable(photo, 200))
            else:
                cards[of][k] = replace(cards[of][k], photo=len(photos), frame=photo[0], why=None)
                photos.append(photo[1])
        of_methods = tuple(replace(one, cards=tuple(own)) for (one, _), own in zip(self._cards, cards, strict=True))
        return SceneGallery(printable(self._scene, 200), of_methods, tuple(photos))


def _card(error: SingleError, scene: EvaluatedScene, metrics: Sequence[str], ids: Sequence[int]) -> Card:
    def names(classes: Sequence[int]) -> tuple[str, ...]:
        return tuple(printable(scene.class_name(one), MAX_TEXT) for one in classes[:MAX_NAMES])

    gains = (error.gains[name] for name in metrics)
    numbers = (int(scene.instance[points[0]]) for points in error.truth[:MAX_NAMES] if len(points))
    return Card(
        kind=error.kind,
        true=names(error.true),
        called=names(error.called),
        ids=tuple(ids[k] if k < len(ids) else k for k in error.masks[:MAX_NAMES]),
        rows=tuple(error.masks[:MAX_NAMES]),
        objects=tuple(number for number in numbers if number > 0),
        score=None if error.score is None else round(error.score, 4),
        iou=None if error.iou is None else round(error.iou, 3),
        n_points=sum(map(len, error.predicted)),
        n_true=sum(map(len, error.truth)),
        gains=tuple(round(gain, 6) if np.isfinite(gain) else None for gain in gains),
    )


def _places(points: Points, sets: Sequence[NDArray[np.integer[Any]]]) -> tuple[Float32Array, ...]:
    return tuple(points[one].astype(np.float32) for one in sets)


def _photos(
    things: Sequence[ErrorView], dataset: Any, data: SceneData, fed: Sequence[int]
) -> list[tuple[int, str] | str]:
    """For each error the index of the frame that shows it best and its photo, or why there is none."""
    places = sorted(data.in_turn(dataset, fed)[:CANDIDATES])
    looks = np.zeros((len(things), len(places)))
    for column, place in enumerate(places):
        frame = data.frame(dataset, place, SKETCH_WIDTH)
        for row, thing in enumerate(things):
            view = best_view([frame], thing.points)
            looks[row, column] = 0.0 if view is None else view.score
    good = [[places[k] for k in np.flatnonzero((row >= AS_GOOD * row.max()) & (row > 0))] for row in looks]
    frames = {place: data.frame(dataset, place, PHOTO_WIDTH) for place in frame_cover(good, MAX_FRAMES)}
    return [_photo(thing, row, places, frames) for thing, row in zip(things, looks, strict=True)]


def _photo(
    thing: ErrorView, look: np.ndarray, places: Sequence[int], frames: Mapping[int, Frame]
) -> tuple[int, str] | str:
    for column in np.argsort(-look, kind="stable").tolist():
        if look[column] > 0 and places[column] in frames:
            frame = frames[places[column]]
            if (photo := error_photo(frame, thing)) is not None:
                return frame.index, jpeg_text(photo, JPEG_QUALITY)
    return "none of the searched frames shows it"
