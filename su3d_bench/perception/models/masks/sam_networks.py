"""SAM's network in torch: ``transformers``' SamModel."""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.types import Float32Array
from su3d_bench.perception.models.masks.sam import Prompts


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
            given["input_points"] = self._tensor(prompts.points[None])
            given["input_labels"] = self._tensor(prompts.labels[None])
        with torch.inference_mode():
            answer = self.model(image_embeddings=embedding, multimask_output=not is_single, **given)
        return answer.pred_masks[0].float(), answer.iou_scores[0].float()

    def _tensor(self, array: np.typing.NDArray[Any]) -> Any:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array)).to(self.model.device)
