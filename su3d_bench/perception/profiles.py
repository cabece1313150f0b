"""Who supplies perception: the profiles that a run chooses among by name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.errors import ConfigError, suggest
from su3d_bench.perception.cache import FrameCache, content_key, frame_digest, pack_masks, unpack_masks
from su3d_bench.perception.features import CropEncoder, regions_to_keep
from su3d_bench.perception.naming import Namer, NamingConfig, colour_word, scene_caption, with_article
from su3d_bench.perception.oracle import OracleConfig, OracleSegmenter
from su3d_bench.perception.segmenter import RgbdSegmenter, SegmenterConfig
from su3d_bench.perception.stored import StoredConfig, StoredFrame, read_stored, stored_path
from su3d_bench.perception.stored_images import LabelImages
from su3d_bench.types import (
    Detections,
    Encoder,
    Float32Array,
    Frame,
    ImageDomain,
    InstanceMesh,
    PerceptionNeeds,
    Regions,
    SceneInfo,
    Segmenter,
    StageTimer,
)

PROFILES = ("auto", "embedded", "oracle", "stored")

CAMERA_CAVEAT = (
    "embedded perception on camera images: its encoder has seen rendered rooms only, so names and labels mean little "
    "here; use --profile stored with detections made by real models"
)
ORACLE_CAVEAT = "oracle perception: masks and names come from the ground truth; a ceiling, not a result"
STORED_CAVEAT = "stored perception: masks and names were made elsewhere and are taken as they are"


class PerceptionConfig(BaseModel):
    """All parameters of all profiles; ``cache`` off: nothing is read from or written to the cache."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    segmenter: SegmenterConfig = SegmenterConfig()
    naming: NamingConfig = NamingConfig()
    oracle: OracleConfig = OracleConfig()
    stored: StoredConfig = StoredConfig()
    cache: bool = True


class Perception(Protocol):
    """What a run asks of perception; ``digest`` moves with everything that moves the answer of ``detect``."""

    profile: str
    encoder: Encoder
    caveat: str | None
    digest: str

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections: ...


def resolve_profile(profile: str, image_domain: ImageDomain) -> str:
    """The profile behind ``profile``: ``auto`` is ``embedded``, on images of either domain, until others exist."""
    if profile not in PROFILES:
        raise ConfigError(
            f"unknown profile '{profile}'{suggest(profile, PROFILES) or '; known: ' + ', '.join(PROFILES)}"
        )
    return "embedded" if profile == "auto" else profile


def build_perception(
    profile: str,
    config: PerceptionConfig,
    *,
    scene: SceneInfo,
    cache_root: Path,
    mesh: InstanceMesh | None,
    encoder: Encoder | None = None,
) -> Perception:
    """Perception for one scene; ``mesh`` for the oracle alone; without ``encoder`` the embedded one is made."""
    resolved = resolve_profile(profile, scene.image_domain)
    if encoder is None:
        from su3d_bench.perception.embedded_encoder import EmbeddedEncoder

        encoder = EmbeddedEncoder()
    cache = FrameCache(cache_root if config.cache else None)
    if resolved == "oracle":
        if mesh is None:
            raise ConfigError(f"{scene.dataset}/{scene.scene}: profile 'oracle' needs an annotated mesh, there is none")
        return OraclePerception(config, mesh, encoder, cache)
    assert mesh is None, "ground truth may reach the oracle only"
    if resolved == "stored":
        if config.stored.folder is None:
            raise ConfigError("profile 'stored': perception.stored.folder is not set; name the folder of detections")
        if config.stored.images is not None:
            return LabelImagePerception(config, scene, encoder, cache)
        return StoredPerception(config.stored.folder, scene, encoder, cache)
    return EmbeddedPerception(config, scene, encoder, cache)


class EmbeddedPerception:
    """Geometric segmentation of the frame, names by the encoder, captions from a template."""

    profile = "embedded"

    def __init__(self, config: PerceptionConfig, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self.caveat = CAMERA_CAVEAT if scene.image_domain == "camera" else None
        self._segmenters = {
            "grounded": RgbdSegmenter(config.segmenter, "objects"),
            "class-agnostic": RgbdSegmenter(config.segmenter, "parts"),
        }
        self._namer = Namer(config.naming, encoder)
        self._cache = cache
        self._crops = CropEncoder(encoder, cache)
        digests = [segmenter.digest for segmenter in self._segmenters.values()]
        self.digest = content_key(self.profile, *digests, self._namer.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        regions = cached_regions(self._segmenters[needs.masks], frame, self._cache, False, timer)
        everything = np.arange(len(regions.boxes))
        best_fit = self._crops.crops(frame, regions.boxes, everything, (1.0,), timer)[:, 0]
        with timer.stage("encode"):
            named = self._namer.name(best_fit)
        kept = regions_to_keep(named.names, regions.boxes, frame.depth_m.shape, needs)
        masks = regions.masks[kept]
        names = tuple(named.names[k] for k in kept)
        with timer.stage("encode"):
            colours = [colour_word(frame.rgb, mask) for mask in masks]
        return Detections(
            frame_index=frame.index,
            masks=masks,
            boxes=regions.boxes[kept],
            scores=(regions.scores[kept] * named.confidences[kept]).astype(np.float32),
            names=names,
            captions=tuple(scene_caption(name, colour) for name, colour in zip(names, colours, strict=True)),
            crop_ratios=needs.crop_ratios,
            crop_features=self._crops.crops(frame, regions.boxes, kept, needs.crop_ratios, timer, {1.0: best_fit}),
            global_feature=self._crops.whole(frame, timer),
        )


class OraclePerception:
    """The ground truth seen from the frame; features are those of the class names, alike at every ratio."""

    profile = "oracle"
    caveat: str | None = ORACLE_CAVEAT

    def __init__(self, config: PerceptionConfig, mesh: InstanceMesh, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self._prompt = config.oracle.prompt
        self._segmenter = OracleSegmenter(mesh, config.oracle)
        self._cache = cache
        self._feature_of_name: dict[str, Float32Array] = {}
        self.digest = content_key(self.profile, self._segmenter.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        regions = cached_regions(self._segmenter, frame, self._cache, True, timer)
        assert regions.names is not None
        with timer.stage("encode"):
            features = self._name_features(regions.names)
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        mean = features.astype(np.float64).sum(axis=0)
        length = float(np.linalg.norm(mean))
        names = tuple(regions.names[k] for k in kept)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=regions.scores[kept],
            names=names,
            captions=tuple(scene_caption(name) for name in names),
            crop_ratios=needs.crop_ratios,
            crop_features=np.repeat(features[kept][:, None], len(needs.crop_ratios), axis=1),
            global_feature=(mean / length if length > 0 else mean).astype(np.float32),
        )

    def _name_features(self, names: tuple[str, ...]) -> Float32Array:
        for name in names:
            if name not in self._feature_of_name:
                prompt = self._prompt.replace("{}", with_article(name))
                self._feature_of_name[name] = self.encoder.encode_texts([prompt])[0]
        features = [self._feature_of_name[name] for name in names]
        return np.array(features, np.float32).reshape(len(names), self.encoder.dim)


class StoredPerception:
    """Detections from files; features are computed where the files lack them."""

    profile = "stored"
    caveat: str | None = STORED_CAVEAT

    def __init__(self, folder: Path, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self._folder = folder
        self._scene = scene
        self._crops = CropEncoder(encoder, cache)
        self.digest = content_key(self.profile, _files_digest(folder, scene), encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("cache"):
            path = stored_path(self._folder, self._scene.dataset, self._scene.scene, frame.index)
            stored = read_stored(path, frame, self.encoder)
        regions = stored.regions
        assert regions.names is not None and regions.captions is not None
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        features, whole = self._features(frame, stored, kept, needs.crop_ratios, timer)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=regions.scores[kept],
            names=tuple(regions.names[k] for k in kept),
            captions=tuple(regions.captions[k] for k in kept),
            crop_ratios=needs.crop_ratios,
            crop_features=features,
            global_feature=whole,
        )

    def _features(
        self,
        frame: Frame,
        stored: StoredFrame,
        kept: np.typing.NDArray[np.intp],
        ratios: tuple[float, ...],
        timer: StageTimer,
    ) -> tuple[Float32Array, Float32Array]:
        given, boxes = stored.features, stored.regions.boxes
        if given is None:
            return self._crops.crops(frame, boxes, kept, ratios, timer), self._crops.whole(frame, timer)
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
        self.digest = content_key(self.profile, _content_digest(self._images.files), self._namer.digest, encoder.digest)

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
            crop_features=self._crops.crops(frame, regions.boxes, kept, needs.crop_ratios, timer, {1.0: best_fit}),
            global_feature=self._crops.whole(frame, timer),
        )


def _files_digest(folder: Path, scene: SceneInfo) -> str:
    """A digest of the names and contents of the scene's files."""
    return _content_digest(sorted(stored_path(folder, scene.dataset, scene.scene, 0).parent.glob("*.npz")))


def _content_digest(files: Iterable[Path]) -> str:
    import hashlib

    hasher = hashlib.sha256()
    for path in files:
        hasher.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return hasher.hexdigest()


def cached_regions(
    segmenter: Segmenter, frame: Frame, cache: FrameCache, with_pose: bool, timer: StageTimer
) -> Regions:
    """The regions that ``segmenter`` finds in ``frame``, from the cache where they are known.

    ``with_pose``: they depend on the camera's pose, and on the index of the frame, which seeds the oracle's noise.
    """
    if not cache.is_on:
        with timer.stage("segment"):
            return segmenter.segment(frame)
    with timer.stage("cache"):
        index = str(frame.index) if with_pose else ""
        key = content_key("regions", segmenter.digest, frame_digest(frame, with_pose), index)
        entry = cache.load(key)
        if entry is not None:
            names = tuple(str(name) for name in entry["names"]) if "names" in entry else None
            return Regions(unpack_masks(entry), entry["boxes"], entry["scores"], names)
    with timer.stage("segment"):
        regions = segmenter.segment(frame)
    with timer.stage("cache"):
        arrays = {**pack_masks(regions.masks), "boxes": regions.boxes, "scores": regions.scores}
        if regions.names is not None:
            arrays["names"] = np.array(regions.names, np.str_)
        cache.save(key, arrays)
    return regions
