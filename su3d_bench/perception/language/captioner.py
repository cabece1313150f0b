"""Names and captions of image crops by a vision-language model, with the tagger's name as fallback.

Also the paper's own prompts for its models, including those for other tasks.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from su3d_bench.core.types import UInt8Array
from su3d_bench.perception.cache import content_key
from su3d_bench.perception.embedded.lexicon import scene_caption
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply, fitted
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.parsing import CaptionForm, described, is_refusal

# OpenSU3D, section II-A.
DESCRIBE = "Give name and description to the object. Output e.g. `name':`description'"
# OpenSU3D, section II-B1. The paper prints no more; the answer format is ours, so that the reply can be parsed.
REFINE = "assign a single name to the object based on a given list of names"
REFINE_FORM = "Answer with that name alone."
# OpenSU3D, section II-D, the six points of the prompting strategy.
STRATEGY = (
    "Use `Name' & `Description' to understand object.",
    "Use `ID' to refer object.",
    "Use `Cartesian Coordinates'.",
    "Get `Centroid' & `Bounding Box' information.",
    "Compute `Euclidean Distance' if necessary.",
    "Assume `Tolerance' if necessary.",
)

# Settings of the language model that affect a caption; times, prices and limits do not.
CAPTION_SETTINGS = {
    "vision_model", "temperature", "seed", "max_answer_tokens", "image_detail", "max_image_px", "reasoning_effort",
}  # fmt: skip
logger = logging.getLogger(__name__)


def list_of_names(names: Sequence[str]) -> str:
    """The names in the form given to the model."""
    return json.dumps(list(names), ensure_ascii=False)


@dataclass(frozen=True)
class CropCaption:
    """Name and caption of a crop, their source, and the reason for a fallback; ``key`` identifies the reply."""

    name: str
    caption: str
    source: Literal["model", "fallback"]
    reason: str
    key: str


class Captioner:
    """Asks the vision model for the name and description of each crop; ``digest`` covers all that affects an answer."""

    def __init__(self, model: LanguageModel, config: LanguageConfig) -> None:
        self._model = model
        self._config = config
        self.vision_model = config.vision_model
        self.digest = content_key("captioner", config.model_dump_json(include=CAPTION_SETTINGS))

    def requests(self, crops: Sequence[UInt8Array]) -> list[ChatRequest]:
        """The requests for the crops (h, w, 3)."""
        config = self._config
        return [
            ChatRequest(
                "caption",
                config.vision_model,
                "",
                DESCRIBE,
                (fitted(crop, config.max_image_px),),
                max_answer_tokens=config.max_answer_tokens,
                temperature=config.temperature,
                seed=config.seed,
                image_detail=config.image_detail,
                reasoning_effort=config.reasoning_effort,
                form=CaptionForm,
            )
            for crop in crops
        ]

    def captions(self, crops: Sequence[UInt8Array], tagger_names: Sequence[str]) -> list[CropCaption]:
        """One caption per crop; ``tagger_names`` are the fallback names. Reasons of fallbacks are logged."""
        requests = self.requests(crops)
        replies = self._model.ask_all(requests)
        captions = [
            caption_from(reply, name, request.key)
            for request, reply, name in zip(requests, replies, tagger_names, strict=True)
        ]
        for reason in dict.fromkeys(caption.reason for caption in captions if caption.source == "fallback"):
            logger.warning("captions: the tagger's name and a template replace unusable replies: %s", reason)
        return captions


def caption_from(reply: Reply, tagger_name: str, key: str) -> CropCaption:
    """The model's caption, or the tagger's name and "an {object} in a scene" (the paper's section III-A3)."""
    description = None if reply.failure else described(reply.text)
    if description is None:
        name = tagger_name.strip() or "object"
        return CropCaption(name, scene_caption(name), "fallback", reason_of(reply), key)
    return CropCaption(description.name, description.description or scene_caption(description.name), "model", "", key)


def reason_of(reply: Reply) -> str:
    """The reason why a reply is unusable."""
    if reply.failure:
        return reply.failure
    if not reply.text.strip():
        return f"an empty answer ({reply.finish_reason or 'no reason given'})"
    return "the model refused" if is_refusal(reply.text) else "the answer cannot be parsed"
