"""The settings of the profile ``paper`` beside those of its models."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from su3d_bench.perception.models.catalogue import MODELS
from su3d_bench.perception.models.masks.automatic_masks import AutomaticMaskConfig
from su3d_bench.perception.models.masks.grounded_sam import GroundedConfig

TaggerName = Literal["auto", "ram", "ram-onnx", "words"]


class PaperConfig(BaseModel):
    """Tags, boxes and masks; the defaults are OpenSU3D's.

    ``tagger`` ``auto``: RAM++ through its package, else exported, else the likeliest ``n_tags`` words of ``words``, a
    text file (our own list where it is not set). ``grounded`` and ``automatic`` hold for methods that ask for no
    settings of their own. ``segmenter``: which SAM; ``sam_runtime`` ``onnx``: as exported by ``models export``.
    ``captions`` ``model``: names and captions of crops are asked of the vision model of ``perception.language``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    tagger: TaggerName = "auto"
    words: Path | None = None
    n_tags: int = Field(default=20, ge=1, le=200)
    segmenter: str = "sam-vit-h"
    sam_runtime: Literal["torch", "onnx"] = "torch"
    grounded: GroundedConfig = GroundedConfig()
    automatic: AutomaticMaskConfig = AutomaticMaskConfig()
    captions: Literal["template", "model"] = "template"

    @field_validator("segmenter")
    @classmethod
    def _is_a_segmenter(cls, name: str) -> str:
        known = [entry.name for entry in MODELS.values() if entry.kind == "segmenter"]
        if name not in known:
            raise ValueError(f"is no segmenter; known: {', '.join(known)}")
        return name

    @model_validator(mode="after")
    def _words_are_used(self) -> PaperConfig:
        if self.words is not None and self.tagger in ("ram", "ram-onnx"):
            raise ValueError(f"words are for the tagger 'words', and '{self.tagger}' has a list of its own")
        return self
