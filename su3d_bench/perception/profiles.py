"""Who supplies perception: the profiles that a run chooses among by name."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from su3d_bench.errors import ConfigError, suggest
from su3d_bench.perception.cache import FrameCache
from su3d_bench.perception.config import PerceptionConfig
from su3d_bench.perception.profile_embedded import CAMERA_CAVEAT, EmbeddedPerception
from su3d_bench.perception.profile_oracle import ORACLE_CAVEAT, OraclePerception
from su3d_bench.perception.profile_stored import STORED_CAVEAT, LabelImagePerception, StoredPerception
from su3d_bench.types import (
    Detections,
    Encoder,
    Frame,
    ImageDomain,
    InstanceMesh,
    PerceptionNeeds,
    RegionPerception,
    SceneInfo,
    StageTimer,
)

__all__ = [
    "CAMERA_CAVEAT",
    "ORACLE_CAVEAT",
    "PROFILES",
    "STORED_CAVEAT",
    "EmbeddedPerception",
    "OraclePerception",
    "Perception",
    "PerceptionConfig",
    "build_perception",
    "resolve_profile",
]

PROFILES = ("auto", "embedded", "oracle", "stored")


class Perception(Protocol):
    """What a run asks of perception; ``digest`` moves with everything that moves the answer of ``detect``."""

    profile: str
    encoder: Encoder
    caveat: str | None
    digest: str

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections: ...

    def regions(self) -> RegionPerception:
        """Perception on demand, for methods that look into images themselves."""
        ...


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
