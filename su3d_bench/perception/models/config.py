"""Which foundation models a run loads, how they run, and how the profile ``paper`` computes tags, boxes and masks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from su3d_bench.core.system.devices import DEVICE, EXPECTED_DEVICE
from su3d_bench.perception.models.catalogue import MODELS, Kind
from su3d_bench.perception.models.masks.automatic_masks import AutomaticMaskConfig
from su3d_bench.perception.models.masks.grounded_sam import GroundedConfig

EMBEDDED = "embedded"
Precision = Literal["auto", "float32", "float16", "bfloat16"]


def _one_of(kind: Kind, *more: str) -> AfterValidator:
    """A check that a name is one of the models of ``kind``, or one of ``more``."""
    known = [*more, *(entry.name for entry in MODELS.values() if entry.kind == kind)]

    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"is not a {kind}; known: {', '.join(known)}")
        return name

    return AfterValidator(check)


class ModelsConfig(BaseModel):
    """How foundation models run.

    ``device``: ``cpu``, ``cuda`` (the GPUs in turn, one per job) or ``cuda:1``. ``precision`` ``auto``: float16 on a
    GPU that supports it, otherwise float32. ``batch`` 0: 1 on the CPU, so that no feature depends on the rest of its
    batch, and as much as fits into memory on a GPU. ``encoder`` None: the profile's own. ``folder``: searched instead
    of ``$SU3D_MODELS``; ``paths``: a model's folder or file by model name. ``transform``: ``original`` prepares images
    as open_clip does, ``transformers`` as that library's image processor does.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    device: str = "cpu"
    precision: Precision = "auto"
    batch: int = Field(default=0, ge=0, le=4096)
    encoder: Annotated[str, _one_of("encoder", EMBEDDED)] | None = None
    transform: Literal["original", "transformers"] = "original"
    folder: Path | None = None
    paths: dict[str, Path] = {}

    @field_validator("device")
    @classmethod
    def _is_a_device(cls, name: str) -> str:
        if DEVICE.fullmatch(name) is None:
            raise ValueError(EXPECTED_DEVICE)
        return name

    @field_validator("paths")
    @classmethod
    def _are_of_models(cls, paths: dict[str, Path]) -> dict[str, Path]:
        unknown = [name for name in paths if name not in MODELS]
        if unknown:
            raise ValueError(f"'{unknown[0]}' is not a known model; known: {', '.join(MODELS)}")
        return paths


TaggerName = Literal["auto", "ram-onnx", "words"]


class PaperConfig(BaseModel):
    """Tags, boxes and masks; the defaults are OpenSU3D's.

    ``tagger`` ``auto``: the exported RAM++, otherwise the most likely ``n_tags`` words of
    ``words``, a text file (our own list if not set). ``grounded`` and ``automatic`` apply to methods that request no
    settings of their own. ``segmenter``: which SAM.
    ``captions`` ``model``: names and captions of crops come from the vision model of ``perception.language``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    tagger: TaggerName = "auto"
    words: Path | None = None
    n_tags: int = Field(default=20, ge=1, le=200)
    segmenter: Annotated[str, _one_of("segmenter")] = "sam-vit-h"
    grounded: GroundedConfig = GroundedConfig()
    automatic: AutomaticMaskConfig = AutomaticMaskConfig()
    captions: Literal["template", "model"] = "template"

    @model_validator(mode="after")
    def _words_are_used(self) -> PaperConfig:
        if self.words is not None and self.tagger == "ram-onnx":
            raise ValueError(f"words are for the tagger 'words', but '{self.tagger}' has its own list")
        return self
