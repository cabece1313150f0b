"""GroundingDINO: boxes of the objects named in a text, each with the matching words.

The network is ``transformers``' GroundingDinoForObjectDetection; pre- and postprocessing are here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import require_transformers
from su3d_bench.core.types import BoolArray, Float32Array, Int64Array, UInt8Array
from su3d_bench.perception.models.encoders.images import normalised, resized, size_with_shortest_side
from su3d_bench.perception.models.files import ModelFiles, bounded, kept, load_class, on_device

# The published network's images: T.RandomResize([800], max_size=1333).
SHORTEST_PX, LONGEST_PX = 800, 1333


class BoxConfig(BaseModel):
    """Which boxes count; the defaults are the paper's (section III-A: box and text 0.25, IoU 0.4).

    ``names``: a box is named by its matching ``phrase``, as in the Grounded-SAM demonstrations; by the first tag that
    contains the phrase's ``first-word``, otherwise by the first of all tags, as in ConceptGraphs; or by the whole
    ``tag`` that the phrase is or contains, and dropped if it contains none.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    box_threshold: float = Field(default=0.25, ge=0, le=1)
    text_threshold: float = Field(default=0.25, ge=0, le=1)
    nms_iou: float = Field(default=0.4, ge=0, le=1)
    names: Literal["phrase", "first-word", "tag"] = "phrase"


# ConceptGraphs-Detect, generate_gsa_results.py (5c4da70)
CONCEPTGRAPHS_BOXES = BoxConfig(box_threshold=0.2, text_threshold=0.2, nms_iou=0.5, names="first-word")


@dataclass(frozen=True)
class NamedBoxes:
    """Boxes (K, 4) x0 y0 x1 y1 in pixels, their scores (K,) and one name each, the best first.

    A box may extend beyond the image, as the network returns it; the originals do not clip either.
    """

    boxes: Float32Array
    scores: Float32Array
    names: tuple[str, ...]

    def at(self, kept: Int64Array) -> NamedBoxes:
        """Those of ``kept`` in that order."""
        return NamedBoxes(self.boxes[kept], self.scores[kept], tuple(self.names[k] for k in kept))


def clean_tag(tag: str) -> str:
    """``tag`` as used in a prompt: lower case, single spaces, without the separators of the network.

    >>> clean_tag("  T.V.  Screen?")
    't v screen'
    """
    return " ".join(tag.lower().replace(".", " ").replace("?", " ").split())


def text_prompt(tags: Sequence[str]) -> str:
    """One text of all ``tags``, each followed by a full stop.

    >>> text_prompt(["Cat", "coffee  table"])
    'cat. coffee table.'
    """
    return " ".join(f"{clean_tag(tag)}." for tag in tags)


def tag_of(phrase: str, tags: Sequence[str]) -> str | None:
    """The tag of ``phrase``: itself, otherwise the first that it contains; None for no tag."""
    if phrase in tags:
        return phrase
    return next((tag for tag in tags if tag in phrase), None)


def tag_of_first_word(phrase: str, tags: Sequence[str]) -> str:
    """The first of ``tags`` that contains the first word of ``phrase``, even inside a word; otherwise the first tag.

    ConceptGraphs' rule: ``Model.find_index`` of Grounded-Segment-Anything at a4d76a2, GroundingDINO's inference.py. A
    phrase without words, for which that program crashes, gets the first tag too.

    >>> tag_of_first_word("table lamp", ["cat", "coffee table", "lamp"])
    'coffee table'
    """
    word = (phrase.lower().split() or [""])[0]
    return next((tag for tag in tags if word in tag.lower()), tags[0])


def is_in_phrase(probabilities: Float32Array, text_threshold: float, n_tokens: int) -> BoolArray:
    """Which tokens (K, T) match each of K boxes: those above the threshold except the text's first and last.

    These two mark its ends; GroundingDINO (856dde2) excludes the first, and the last position of the longest text. At
    the commit named by ConceptGraphs it excludes none, see ``GroundingDino.detect``.
    """
    chosen: BoolArray = probabilities > text_threshold
    chosen[:, 0] = False
    chosen[:, min(n_tokens, chosen.shape[1]) - 1 :] = False
    return chosen


class GroundingDino:
    """The network with its tokenizer, on its device."""

    def __init__(
        self, model: Any, tokenizer: Any, shortest_px: int = SHORTEST_PX, longest_px: int = LONGEST_PX
    ) -> None:
        self.model = model.eval()
        self.tokenizer = tokenizer
        self._sides_px = (shortest_px, longest_px)
        self._max_tokens: int = model.config.max_text_len

    def detect(self, rgb: UInt8Array, tags: Sequence[str], config: BoxConfig) -> NamedBoxes:
        """The objects in ``rgb`` (H, W, 3) named by ``tags``, the best first; empty for no tags.

        Tags that do not fit into the network's text go into further texts; the original truncates them.
        """
        tags = [tag for tag in dict.fromkeys(clean_tag(tag) for tag in tags) if tag]
        parts = [self._candidates(rgb, part, config) for part in self._texts(tags)]
        candidates = NamedBoxes(
            np.concatenate([part.boxes for part in parts] or [np.zeros((0, 4), np.float32)]),
            np.concatenate([part.scores for part in parts] or [np.zeros(0, np.float32)]),
            tuple(name for part in parts for name in part.names),
        )
        candidates = candidates.at(suppress(candidates.boxes, candidates.scores, config.nms_iou))
        if config.names == "first-word":
            names = tuple(tag_of_first_word(phrase, tags) for phrase in candidates.names)
            return NamedBoxes(candidates.boxes, candidates.scores, names)
        # A box that matches only marks has no name and is dropped.
        named = [tag_of(name, tags) if config.names == "tag" else name or None for name in candidates.names]
        kept = np.flatnonzero([name is not None for name in named])
        names = tuple(name for name in named if name is not None)
        return NamedBoxes(candidates.boxes[kept], candidates.scores[kept], names)

    def answer(self, pixels: Float32Array, text: str) -> tuple[Float32Array, Float32Array, list[int]]:
        """Token probabilities (Q, T) and boxes (Q, 4), centre and size as fractions, for pixels (3, H, W), and the
        text's tokens."""
        import torch

        tokens = self.tokenizer(text, return_tensors="pt", return_token_type_ids=True).to(self.model.device)
        image = torch.from_numpy(pixels[None]).to(self.model.device, self.model.dtype)
        with torch.inference_mode():
            answer = self.model(
                pixel_values=image,
                pixel_mask=torch.ones(image.shape[0], *image.shape[2:], dtype=torch.int64, device=image.device),
                input_ids=tokens["input_ids"],
                token_type_ids=tokens["token_type_ids"],
                attention_mask=tokens["attention_mask"],
            )
            probabilities = torch.sigmoid(answer.logits[0].float())
        return probabilities.cpu().numpy(), answer.pred_boxes[0].float().cpu().numpy(), tokens["input_ids"][0].tolist()

    def pixels(self, rgb: UInt8Array) -> Float32Array:
        """``rgb`` (H, W, 3) as input for the network, (3, h, w)."""
        height, width = rgb.shape[:2]
        return normalised(resized(rgb, *size_with_shortest_side(height, width, *self._sides_px)))

    def _candidates(self, rgb: UInt8Array, tags: Sequence[str], config: BoxConfig) -> NamedBoxes:
        """Everything above the thresholds, in the network's order."""
        probabilities, boxes, tokens = self.answer(self.pixels(rgb), text_prompt(tags))
        scores = probabilities.max(axis=1)
        kept = np.flatnonzero(scores > config.box_threshold)
        if config.names == "first-word":
            # In ConceptGraphs the end marks match boxes too: no tag contains "[cls]", so these get the first tag.
            chosen = probabilities[kept] > config.text_threshold
        else:
            chosen = is_in_phrase(probabilities[kept], config.text_threshold, len(tokens))
        names = tuple(self._phrase([tokens[i] for i in np.flatnonzero(row[: len(tokens)])]) for row in chosen)
        height, width = rgb.shape[:2]
        return NamedBoxes(corners_of(boxes[kept], height, width), scores[kept], names)

    def _phrase(self, tokens: list[int]) -> str:
        """Tokens as words, without the full stops between them, as in the original."""
        return " ".join(self.tokenizer.decode(tokens).replace(".", "").split())

    def _texts(self, tags: Sequence[str]) -> list[list[str]]:
        """``tags`` in order, in as few parts as the network's maximum text length allows."""
        parts: list[list[str]] = []
        for tag in tags:
            longer = [*parts[-1], tag] if parts else []
            if longer and len(self.tokenizer(text_prompt(longer))["input_ids"]) <= self._max_tokens:
                parts[-1] = longer
            else:
                parts.append([tag])
        return parts


def load_grounding_dino(files: ModelFiles, device: str, precision: str) -> GroundingDino:
    """GroundingDINO with its tokenizer ready to run."""

    def load() -> GroundingDino:
        model = load_class(files, "GroundingDinoForObjectDetection")
        transformers = require_transformers(f"detector '{files.entry.name}'")
        try:
            tokenizer = transformers.BertTokenizer.from_pretrained(str(files.folder), local_files_only=True)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{files.folder}: tokenizer unreadable: {bounded(error)}; download it again") from error
        return GroundingDino(on_device(model, device, precision), tokenizer)

    return kept(files, (device, precision), load)


# ---- boxes


def corners_of(boxes: Float32Array, height: int, width: int) -> Float32Array:
    """Boxes (K, 4) x0 y0 x1 y1 in pixels from boxes centre x, centre y, width, height as fractions of the image.

    Each product and sum is float32 and in the original's order: to pixels first, then from centres to corners
    (``Model.post_process_result`` of GroundingDINO's inference.py, with torchvision's ``box_convert``).
    """
    pixels = boxes * np.array([width, height, width, height], np.float32)
    centre, half = pixels[:, :2], np.float32(0.5) * pixels[:, 2:]
    return np.concatenate([centre - half, centre + half], axis=1).astype(np.float32)


def box_overlaps(box: Float32Array, others: Float32Array) -> Float32Array:
    """Intersection over union (K,) of one box with ``others`` (K, 4); NaN between two boxes without area.

    Each step is float32 and in torchvision's order (``torchvision::nms`` on the CPU, nms_kernel.cpp).
    """
    rest = others.reshape(-1, 4)
    low, high = np.maximum(box[:2], rest[:, :2]), np.minimum(box[2:], rest[:, 2:])
    sides = np.maximum(high - low, np.float32(0))
    shared = sides[:, 0] * sides[:, 1]
    area = (box[2] - box[0]) * (box[3] - box[1])
    areas = (rest[:, 2] - rest[:, 0]) * (rest[:, 3] - rest[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        overlaps: Float32Array = shared / (area + areas - shared)
    return overlaps


def suppress(boxes: Float32Array, scores: NDArray[np.floating[Any]], most_overlap: float) -> Int64Array:
    """Indices of the boxes that no better box overlaps by more than ``most_overlap``, the best first.

    Class-agnostic non-maximum suppression; of equal scores the first counts as better. As in torchvision, the float32
    overlap is compared with the float64 threshold: an overlap of 0.4 is float32's 0.4, which is more than 0.4, and
    suppresses; one of 0.5 is 0.5 and does not.

    >>> square = np.array([[0, 0, 10, 10], [0, 0, 10, 5], [20, 0, 30, 10]], np.float32)
    >>> suppress(square, np.array([0.5, 0.9, 0.1], np.float32), 0.4).tolist()
    [1, 2]
    """
    order = np.argsort(-scores.astype(np.float64), kind="stable")
    is_open = np.ones(len(order), bool)
    kept = []
    for place, index in enumerate(order):
        if not is_open[place]:
            continue
        kept.append(index)
        rest = place + 1 + np.flatnonzero(is_open[place + 1 :])
        overlaps = box_overlaps(boxes[index], boxes[order[rest]]).astype(np.float64)
        # NaN (two boxes without area) is not an overlap.
        is_open[rest[overlaps > most_overlap]] = False
    return np.array(kept, np.int64)
