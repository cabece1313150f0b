"""The perception backends that a run selects by profile name, and their parameters."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

from pydantic import BaseModel, ConfigDict

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.system.devices import gpu_memory_bytes
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import (
    Detections,
    Frame,
    ImageDomain,
    InstanceMesh,
    ObjectBoxes,
    PerceptionNeeds,
    Regions,
    SceneInfo,
)
from su3d_bench.perception.cache import FrameCache, RegionsOnDemand, cached_regions, content_key
from su3d_bench.perception.detections import Assembler, captioned_by_colour
from su3d_bench.perception.embedded.join_rules import SegmenterConfig
from su3d_bench.perception.embedded.lexicon import Namer, NamingConfig
from su3d_bench.perception.embedded.segmenter import RgbdSegmenter
from su3d_bench.perception.language.chat import LanguageConfig
from su3d_bench.perception.models.catalogue import MODELS
from su3d_bench.perception.models.config import EMBEDDED, ModelsConfig, PaperConfig
from su3d_bench.perception.oracle import OracleConfig, OraclePerception
from su3d_bench.perception.stored import NpzFiles, StoredConfig, StoredPerception
from su3d_bench.perception.stored_masks import LabelImages

PROFILES = ("auto", "embedded", "paper", "oracle", "stored")
# Replies of vision models, below the cache's folder, so that a rerun sends no request twice.
REPLIES = "replies"


class PerceptionConfig(BaseModel):
    """All parameters of all profiles; ``cache`` false: nothing is read from or written to the cache."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    segmenter: SegmenterConfig = SegmenterConfig()
    naming: NamingConfig = NamingConfig()
    oracle: OracleConfig = OracleConfig()
    stored: StoredConfig = StoredConfig()
    models: ModelsConfig = ModelsConfig()
    paper: PaperConfig = PaperConfig()
    language: LanguageConfig = LanguageConfig()
    cache: bool = True


class Perception(Protocol):
    """The interface of perception for a run; ``digest`` changes with everything that affects ``detect``."""

    profile: str
    encoder: Encoder
    caveat: str | None

    @property
    def digest(self) -> str: ...

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections: ...

    def regions(self) -> RegionPerception:
        """Perception on demand, for methods that process images themselves."""
        ...


CAMERA_CAVEAT = (
    "embedded perception on camera images: its encoder was trained on rendered homes only, so names and labels are "
    "unreliable here; use --profile paper, or --profile stored with detections of real models"
)


class EmbeddedPerception:
    """Geometric segmentation of the frame, names by the encoder, captions from a template."""

    profile = "embedded"

    def __init__(
        self, segmenter: SegmenterConfig, naming: NamingConfig, scene: SceneInfo, encoder: Encoder, cache: FrameCache
    ) -> None:
        self.encoder = encoder
        self.caveat = CAMERA_CAVEAT if scene.image_domain == "camera" else None
        self._segmenters = {
            "grounded": RgbdSegmenter(segmenter, "objects"),
            "class-agnostic": RgbdSegmenter(segmenter, "parts"),
        }
        self._namer = Namer(naming, encoder)
        self._cache = cache
        self._assembler = Assembler(encoder, cache, "own")
        digests = [segmenter.digest for segmenter in self._segmenters.values()]
        self.digest = content_key(self.profile, *digests, self._namer.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        assert needs.masks != "none", "the runner asks nothing for a method that needs no masks"
        segmented = self._segmented(needs.masks, frame, timer)
        regions, known = self._assembler.named(frame, segmented, self._namer, needs, timer)
        return self._assembler.assemble(frame, regions, needs, timer, describe=captioned_by_colour, known=known)

    def regions(self) -> RegionPerception:
        return RegionsOnDemand(lambda frame: self._segmented("class-agnostic", frame, Timer()), self.encoder)

    def _segmented(self, masks: str, frame: Frame, timer: StageTimer) -> Regions:
        return cached_regions(self._segmenters[masks], frame, self._cache, False, timer)


def resolve_profile(profile: str, image_domain: ImageDomain, config: PerceptionConfig | None = None) -> str:
    """The profile selected by ``profile``: ``auto`` is ``paper`` on camera images if its models are installed.

    Otherwise ``auto`` is ``embedded``: on rendered scenes, for which its encoder was trained, and without ``config``.
    """
    if profile not in PROFILES:
        raise ConfigError(f"unknown profile '{profile}'{suggest(profile, PROFILES)}")
    if profile != "auto":
        return profile
    if config is None or image_domain != "camera":
        return "embedded"
    from su3d_bench.perception.models.loading import is_front_end_available

    return "paper" if is_front_end_available(config.paper, config.models) else "embedded"


def models_of(profile: str, config: PerceptionConfig) -> list[str]:
    """The foundation models that a profile, not ``auto``, loads, by their names in the catalogue."""
    from su3d_bench.perception.models.loading import DETECTOR, PAPER_ENCODER, TAGGER

    is_paper = profile == "paper"
    encoder = config.models.encoder or (PAPER_ENCODER if is_paper else EMBEDDED)
    tagger = [] if config.paper.tagger == "words" else [TAGGER]
    return [
        *([] if encoder == EMBEDDED else [encoder]),
        *([config.paper.segmenter, DETECTOR, *tagger] if is_paper else []),
    ]


# While one process builds its map on the CPU, another uses the GPU. Kernels of different processes take turns, so a
# third adds memory and hardly any speed: networks take most of an update's time (docs/running/gpu.md).
MAX_PROCESSES_PER_GPU = 2
GPU_OVERHEAD_MB = 4000  # of a process besides weights, assumed: context, SAM's attention at 1024 px, batches of crops


def default_jobs(profile: str, config: PerceptionConfig) -> int:
    """Parallel jobs unless requested otherwise: one per CPU core; with foundation models on GPUs at most two per GPU,
    one if two do not fit into its memory."""
    n_cores = os.cpu_count() or 1
    models = models_of(profile, config)
    memory = gpu_memory_bytes(config.models.device) if models else []
    # in float16, except for RAM++
    weights_mb = sum(one.memory_mb(4 if one.kind == "tagger" else 2) for one in (MODELS[name] for name in models))
    need = 1e6 * (weights_mb + GPU_OVERHEAD_MB)
    return min(n_cores, sum(max(1, min(MAX_PROCESSES_PER_GPU, int(total / need))) for total in memory) or n_cores)


def check_models(profile: str, config: PerceptionConfig) -> None:
    """Raises ``ModelMissing`` for the first required model that is not installed, without any heavy import."""
    if profile == "paper":
        from su3d_bench.perception.models.loading import check_front_end

        check_front_end(config.paper, config.models)
    elif config.models.encoder not in (None, EMBEDDED):
        from su3d_bench.perception.models.loading import check_encoder

        check_encoder(config.models, config.models.encoder)


def build_perception(
    profile: str,
    config: PerceptionConfig,
    *,
    scene: SceneInfo,
    cache_root: Path,
    mesh: InstanceMesh | ObjectBoxes | None,
    encoder: Encoder | None = None,
    job_index: int = 0,
    replies: Path | None = None,
    is_offline: bool = False,
) -> Perception:
    """Perception for one scene; ``mesh`` (or object boxes) only for the oracle.

    Without ``encoder`` the configured one is loaded, or the profile's own; ``job_index`` chooses among several GPUs.
    ``replies``: the folder of language-model replies (None: in the cache); ``is_offline``: only stored ones are used.
    """
    resolved = resolve_profile(profile, scene.image_domain, config)
    cache = FrameCache(cache_root if config.cache else None)
    if encoder is None:
        from su3d_bench.perception.models.loading import PAPER_ENCODER, load_encoder

        own = PAPER_ENCODER if resolved == "paper" else EMBEDDED
        encoder = load_encoder(config.models, default=own, cache=cache, job_index=job_index)
    if resolved == "oracle":
        if mesh is None:
            raise ConfigError(f"{scene.dataset}/{scene.scene}: no annotated mesh, which profile 'oracle' needs")
        return OraclePerception(config.oracle, mesh, encoder, cache)
    assert mesh is None, "ground truth may reach the oracle only"
    if resolved == "stored":
        return _stored(config, scene, encoder, cache)
    if resolved == "paper":
        return _paper(config, encoder, cache, replies or cache_root / REPLIES, is_offline, job_index)
    return EmbeddedPerception(config.segmenter, config.naming, scene, encoder, cache)


def _stored(config: PerceptionConfig, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> Perception:
    stored = config.stored
    if stored.folder is None:
        raise ConfigError("profile 'stored': perception.stored.folder is not set; set it to the folder of detections")
    if stored.images is not None:
        images = LabelImages(stored.folder, stored.images, stored.names, scene)
        return StoredPerception(images, encoder, cache, Namer(config.naming, encoder))
    if stored.detections is not None:
        from su3d_bench.perception.stored_masks import GsaFiles

        return StoredPerception(GsaFiles(stored.folder, stored.detections, scene), encoder, cache)
    return StoredPerception(NpzFiles(stored.folder, scene, encoder), encoder, cache)


def _paper(
    config: PerceptionConfig, encoder: Encoder, cache: FrameCache, replies: Path, is_offline: bool, job_index: int
) -> Perception:
    from su3d_bench.perception.models.loading import load_networks
    from su3d_bench.perception.paper import PaperPerception

    captioner = None
    if config.paper.captions == "model":
        from su3d_bench.perception.language.captioner import Captioner
        from su3d_bench.perception.language.chat import ReplyStore
        from su3d_bench.perception.language.client import ChatClient

        client = ChatClient(config.language, ReplyStore(replies), offline=is_offline)
        captioner = Captioner(client, config.language)
    networks = load_networks(config.paper, config.models, encoder, job_index)
    return PaperPerception(config.paper, networks, encoder, cache, captioner)
