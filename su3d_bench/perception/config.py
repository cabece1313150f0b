"""All parameters of all perception profiles."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from su3d_bench.perception.embedded.naming import NamingConfig
from su3d_bench.perception.embedded.segmenter.segmenter import SegmenterConfig
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.perception.models.config import ModelsConfig, PaperConfig
from su3d_bench.perception.oracle.segmenter import OracleConfig
from su3d_bench.perception.stored.npz_files import StoredConfig


class PerceptionConfig(BaseModel):
    """All parameters of all profiles; ``cache`` off: nothing is read from or written to the cache."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    segmenter: SegmenterConfig = SegmenterConfig()
    naming: NamingConfig = NamingConfig()
    oracle: OracleConfig = OracleConfig()
    stored: StoredConfig = StoredConfig()
    models: ModelsConfig = ModelsConfig()
    paper: PaperConfig = PaperConfig()
    language: LanguageConfig = LanguageConfig()
    cache: bool = True
