"""The profile of detections that were made elsewhere."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.types import BoolArray, Detections, Float32Array, Frame, Int64Array, PerceptionNeeds, SceneInfo
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.config import PerceptionConfig
from su3d_bench.perception.embedded.naming import Namer, colour_word, scene_caption
from su3d_bench.perception.regions import (
    CropEncoder,
    NameEncoder,
    encode_boxes,
    grown_boxes,
    region_under,
    regions_to_keep,
)
from su3d_bench.perception.stored.label_images import LabelImages
from su3d_bench.perception.stored.npz_files import StoredFrame, read_stored, stored_path

STORED_CAVEAT = "stored perception: masks and names were made elsewhere and are taken as they are"


class StoredPerception:
    """Detections from files; features are computed where the files lack them."""

    profile = "stored"
    caveat: str | None = STORED_CAVEAT

    def __init__(self, folder: Path, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self._folder = folder
        self._scene = scene
        self._crops = CropEncoder(encoder, cache)
        self._names = NameEncoder(encoder)
        self.digest = content_key(self.profile, _files_digest(folder, scene), encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("cache"):
            path = stored_path(self._folder, self._scene.dataset, self._scene.scene, frame.index)
            stored = read_stored(path, frame, self.encoder)
        regions = stored.regions
        assert regions.names is not None and regions.captions is not None
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        features, whole = self._features(frame, stored, kept, needs, timer)
        names = tuple(regions.names[k] for k in kept)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=regions.scores[kept],
            names=names,
            captions=tuple(regions.captions[k] for k in kept),
            crop_ratios=needs.crop_ratios,
            crop_features=features,
            global_feature=whole,
            name_features=self._names.features(names, needs),
        )

    def regions(self) -> RegionPerception:
        return StoredRegions(self._regions_of, self.encoder)

    def _regions_of(self, frame: Frame) -> BoolArray:
        path = stored_path(self._folder, self._scene.dataset, self._scene.scene, frame.index)
        return read_stored(path, frame, self.encoder).regions.masks

    def _features(
        self,
        frame: Frame,
        stored: StoredFrame,
        kept: np.typing.NDArray[np.intp],
        needs: PerceptionNeeds,
        timer: StageTimer,
    ) -> tuple[Float32Array, Float32Array]:
        given, ratios = stored.features, needs.crop_ratios
        boxes = grown_boxes(stored.regions.boxes, needs.crop_padding_px)
        if given is None:
            return self._crops.crops(frame, boxes, kept, ratios, timer), self._crops.whole(frame, timer)
        # Stored features are those of the ratios that the file names, whatever surroundings its maker chose.
        known = {ratio: given.crop_features[:, column] for column, ratio in enumerate(given.crop_ratios)}
        return self._crops.crops(frame, boxes, kept, ratios, timer, known), given.global_feature


class LabelImagePerception:
    """Regions from label images; those that have no name get one as any other region does, and its confidence."""

    profile = "stored"
    caveat: str | None = STORED_CAVEAT

    def __init__(self, config: PerceptionConfig, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> None:
        assert config.stored.folder is not None and config.stored.images is not None
        self.encoder = encoder
        self._images = LabelImages(config.stored.folder, config.stored.images, config.stored.names, scene)
        self._namer = Namer(config.naming, encoder)
        self._crops = CropEncoder(encoder, cache)
        self._names = NameEncoder(encoder)
        self.digest = content_key(self.profile, content_digest(self._images.files), self._namer.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("cache"):
            regions = self._images.regions(frame)
        everything = np.arange(len(regions.values))
        best_fit = self._crops.crops(frame, regions.boxes, everything, (1.0,), timer)[:, 0]
        with timer.stage("encode"):
            guessed = self._namer.name(best_fit)
            colours = [colour_word(frame.rgb, mask) for mask in regions.masks]
        pairs = list(zip(regions.names, guessed.names, strict=True))
        names = tuple(guess if given is None else given for given, guess in pairs)
        scores = np.where([given is None for given, _ in pairs], guessed.confidences, 1.0).astype(np.float32)
        kept = regions_to_keep(names, regions.boxes, frame.depth_m.shape, needs)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=scores[kept],
            names=tuple(names[k] for k in kept),
            captions=tuple(scene_caption(names[k], colours[k]) for k in kept),
            crop_ratios=needs.crop_ratios,
            crop_features=self._crops.crops(
                frame,
                grown_boxes(regions.boxes, needs.crop_padding_px),
                kept,
                needs.crop_ratios,
                timer,
                None if needs.crop_padding_px else {1.0: best_fit},
            ),
            global_feature=self._crops.whole(frame, timer),
            name_features=self._names.features([names[k] for k in kept], needs),
            score_scale="own",
        )

    def regions(self) -> RegionPerception:
        return StoredRegions(lambda frame: self._images.regions(frame).masks, self.encoder)


class StoredRegions:
    """``RegionPerception`` over masks from files: the one under the points, as sure as the share of them in it."""

    def __init__(self, masks_of: Callable[[Frame], BoolArray], encoder: Encoder) -> None:
        self.dim = encoder.dim
        self._masks_of = masks_of
        self._encoder = encoder
        self._last: tuple[Frame, BoolArray] | None = None

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """The stored mask that holds most of ``points``; empty and 0 where none does."""
        if self._last is None or self._last[0] is not frame:
            self._last = frame, self._masks_of(frame)
        best, share = region_under(self._last[1], points)
        return (self._last[1][best], share) if best >= 0 else (np.zeros(frame.depth_m.shape, np.bool_), 0.0)

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """Features of the crops, whatever the mask."""
        return encode_boxes(self._encoder, frame, boxes)


def _files_digest(folder: Path, scene: SceneInfo) -> str:
    """A digest of the names and contents of the scene's files."""
    return content_digest(sorted(stored_path(folder, scene.dataset, scene.scene, 0).parent.glob("*.npz")))


def content_digest(files: Iterable[Path]) -> str:
    """A digest of the names and contents of ``files``, in their order."""
    hasher = hashlib.sha256()
    for path in files:
        hasher.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return hasher.hexdigest()
