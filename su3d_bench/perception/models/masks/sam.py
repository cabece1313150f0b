"""Segment Anything: one look at an image, then masks from boxes and points in it.

A network that says what it sees is separate from the geometry around it: ``TorchSam`` runs ``transformers``' SamModel,
``OnnxSam`` the same network exported. Prompts are in pixels of the image; masks come back at its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from su3d_bench.core.system.devices import Batches
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from su3d_bench.perception.models.encoders.model_images import normalised_bytes, resized, size_with_longest_side

MASK_THRESHOLD = 0.0  # on the network's logits
BACKGROUND_POINT, OBJECT_POINT = 0, 1
# Logits at full size are float32: 64 masks of a 1200x680 image take 209 MB.
FULL_SIZE_AT_ONCE = 64


@dataclass(frozen=True)
class Prompts:
    """One prompt a mask: ``points`` (B, P, 2) x y with ``labels`` (B, P), 1 on the object, or ``boxes`` (B, 4).

    ``points`` are float32 where somebody chose them, as in the original's predictor, and float64 where they are a grid,
    as in its generator of automatic masks.
    """

    points: Float32Array | Float64Array | None = None
    labels: Int64Array | None = None
    boxes: Float32Array | None = None

    def __post_init__(self) -> None:
        assert (self.points is None) == (self.labels is None) != (self.boxes is None), "points with labels, or boxes"

    def __len__(self) -> int:
        given = self.boxes if self.points is None else self.points
        assert given is not None
        return len(given)


class SamNetwork(Protocol):
    """What SAM computes: tensors are torch's, on the network's own device."""

    image_px: int

    def embed(self, pixels: Float32Array) -> Any:
        """The embedding of one image (3, image_px, image_px) float32."""
        ...

    def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
        """Logits (B, M, h, w) of M masks a prompt and their predicted IoU (B, M), float32; M is 1 or 3.

        ``prompts`` are in pixels of the network's own image.
        """
        ...


@dataclass(frozen=True)
class SeenImage:
    """An image that SAM has looked at: its ``size`` and the size at which SAM saw it, height first."""

    embedding: Any
    size: tuple[int, int]
    seen_size: tuple[int, int]


class Sam:
    """Masks of one image after another; ``batch`` prompts are decoded at once, fewer after a GPU's memory ran out.

    Another batch may move the last digits of a logit, so a mask by single pixels; on the CPU, where no batch is ever
    halved, the same image gives the same bytes.
    """

    def __init__(self, network: SamNetwork, batch: int = 64) -> None:
        self.network = network
        self._batches = Batches(batch)

    def look(self, rgb: UInt8Array) -> SeenImage:
        """The embedding of ``rgb`` (H, W, 3), for any number of prompts."""
        height, width = rgb.shape[:2]
        seen = size_with_longest_side(height, width, self.network.image_px)
        pixels = np.zeros((3, self.network.image_px, self.network.image_px), np.float32)
        # The border is 0 after the mean is taken off, which is the original's order.
        pixels[:, : seen[0], : seen[1]] = normalised_bytes(resized(rgb, *seen))
        return SeenImage(self.network.embed(pixels), (height, width), seen)

    def decode(self, image: SeenImage, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
        """Small logits (B, M, h, w) and predicted IoU (B, M) for prompts in pixels of the image."""
        return self.network.decode(image.embedding, _at_seen_size(prompts, image), is_single)

    def full_size(self, image: SeenImage, logits: Any) -> Any:
        """``logits`` (N, h, w) at the size of the image (N, H, W): up to the network's image, cut, then to the image.

        Both steps are bilinear without antialiasing, as in the original.
        """
        from torch.nn.functional import interpolate

        square = (self.network.image_px, self.network.image_px)
        padded = interpolate(logits[:, None], square, mode="bilinear", align_corners=False)
        cut = padded[..., : image.seen_size[0], : image.seen_size[1]]
        return interpolate(cut, image.size, mode="bilinear", align_corners=False)[:, 0]

    def from_boxes(self, image: SeenImage, boxes: Float32Array, is_single: bool) -> tuple[BoolArray, Float32Array]:
        """A mask (B, H, W) for each box (B, 4) and its predicted IoU (B,).

        ``is_single``: the one mask that SAM gives when asked for one; else the best of its three by predicted IoU.
        """
        masks = np.zeros((len(boxes), *image.size), bool)
        scores = np.zeros(len(boxes), np.float32)

        def work(part: Sequence[int]) -> None:
            logits, predicted = self.decode(image, Prompts(boxes=boxes[part].astype(np.float32)), is_single)
            best = predicted.argmax(dim=1, keepdim=True)
            scores[part] = predicted.gather(1, best)[:, 0].cpu().numpy()
            chosen = logits.gather(1, best[..., None, None].expand(-1, 1, *logits.shape[2:]))[:, 0]
            masks[part] = self._masks(image, chosen)

        self._batches.run(range(len(boxes)), work)
        return masks, scores

    def from_points(self, image: SeenImage, points: Float32Array) -> tuple[BoolArray, float]:
        """The one mask (H, W) of the object that all ``points`` (P, 2), x y, lie on, and its predicted IoU."""
        labels = np.full((1, len(points)), OBJECT_POINT, np.int64)
        logits, predicted = self.decode(image, Prompts(points.astype(np.float32)[None], labels), is_single=True)
        return self._masks(image, logits[:, 0])[0], float(predicted[0, 0])

    def _masks(self, image: SeenImage, logits: Any) -> BoolArray:
        parts = [
            (self.full_size(image, logits[start : start + FULL_SIZE_AT_ONCE]) > MASK_THRESHOLD).cpu().numpy()
            for start in range(0, len(logits), FULL_SIZE_AT_ONCE)
        ]
        return np.concatenate(parts)


def _at_seen_size(prompts: Prompts, image: SeenImage) -> Prompts:
    scale = np.array(image.seen_size[::-1], np.float64) / np.array(image.size[::-1], np.float64)
    if prompts.boxes is not None:
        return Prompts(boxes=(prompts.boxes.astype(np.float64) * np.tile(scale, 2)).astype(np.float32))
    assert prompts.points is not None
    points = prompts.points.astype(np.float64) * scale
    return Prompts(points if prompts.points.dtype == np.float64 else points.astype(np.float32), prompts.labels)


def as_shares_of_float32(points: Float32Array | Float64Array, image_px: int) -> Float32Array | Float64Array:
    """``points`` moved so little that their shares of the image are float32 numbers, where they are float64.

    The original rounds the share and then takes 2 x - 1 (``PositionEmbeddingRandom.forward_with_coords``); transformers
    takes it first, in float64. After this both give the same bits.
    """
    if points.dtype == np.float32:
        return points
    shares = ((points + 0.5) / image_px).astype(np.float32)
    return shares.astype(np.float64) * image_px - 0.5


class TorchSam:
    """``transformers``' SamModel on its device, in its precision; embeddings stay on the device."""

    def __init__(self, model: Any) -> None:
        self.model = model.eval()
        self.image_px: int = model.config.vision_config.image_size

    def embed(self, pixels: Float32Array) -> Any:
        import torch

        with torch.inference_mode():
            return self.model.get_image_embeddings(self._tensor(pixels[None]).to(self.model.dtype))

    def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
        import torch

        given: dict[str, Any] = {}
        if prompts.boxes is not None:
            given["input_boxes"] = self._tensor(prompts.boxes[None])
        else:
            assert prompts.points is not None and prompts.labels is not None
            given["input_points"] = self._tensor(as_shares_of_float32(prompts.points, self.image_px)[None])
            given["input_labels"] = self._tensor(prompts.labels[None])
        with torch.inference_mode():
            answer = self.model(image_embeddings=embedding, multimask_output=not is_single, **given)
        return answer.pred_masks[0].float(), answer.iou_scores[0].float()

    def _tensor(self, array: np.typing.NDArray[Any]) -> Any:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array)).to(self.model.device)
