"""Foundation models of small configurations with random weights, in memory and as model folders, for tests."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.types import Frame, UInt8Array

SAM_PX = 64
DINO_PX = (48, 80)
# Where transformers' GroundingDINO expects its marks, those of bert-base-uncased.
_MARKS = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
WORDS = (
    "cat",
    "dog",
    "table",
    "coffee",
    "chair",
    "lamp",
    "sofa",
    "book",
    "##s",
    "wall",
    "floor",
    "window",
    "a",
    "item",
)


@cache
def tiny_sam() -> Any:
    """SAM with two layers, one of them global, and an image of 64 px."""
    import torch
    from transformers import SamConfig, SamModel

    torch.manual_seed(1)
    config = SamConfig(
        vision_config={
            "hidden_size": 16, "output_channels": 8, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": SAM_PX, "patch_size": 8, "window_size": 3, "global_attn_indexes": [1], "num_pos_feats": 4,
            "initializer_range": 0.05,
        },
        prompt_encoder_config={"hidden_size": 8, "image_size": SAM_PX, "patch_size": 8, "mask_input_channels": 4},
        mask_decoder_config={"hidden_size": 8, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 8},
    )  # fmt: skip
    model: Any = SamModel(config)
    with torch.no_grad():
        for parameter in model.parameters():
            # Weights that carry signals on; as initialised the network says the same of every image.
            if parameter.dim() > 1:
                parameter.normal_(0, 1.5 / parameter[0].numel() ** 0.5)
    return model.eval()


@cache
def tiny_dino() -> Any:
    """GroundingDINO with small towers, ten queries and texts of at most 32 tokens."""
    import torch
    from transformers import BertConfig, GroundingDinoConfig, GroundingDinoForObjectDetection, SwinConfig

    torch.manual_seed(2)
    tower: dict[str, Any] = {
        "embed_dim": 8, "depths": [1, 1, 1, 1], "num_heads": [1, 1, 2, 2], "window_size": 4, "image_size": 64,
        "out_features": ["stage2", "stage3", "stage4"],
    }  # fmt: skip
    config = GroundingDinoConfig(
        backbone_config=SwinConfig(**tower),
        text_config=BertConfig(
            hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=32, vocab_size=1100,
            max_position_embeddings=64,
        ),
        num_queries=10, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=32, decoder_ffn_dim=32, d_model=32,
        encoder_attention_heads=4, decoder_attention_heads=4, encoder_n_points=2, decoder_n_points=2, max_text_len=32,
    )  # fmt: skip
    model: Any = GroundingDinoForObjectDetection(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
    return model.eval()


def write_vocabulary(folder: Path) -> Path:
    """``vocab.txt`` of the tiny tokenizer: bert's marks in their places, some words, and nothing else of use."""
    words = {200 + k: word for k, word in enumerate(WORDS)} | _MARKS
    lines = [words.get(k, f"[unused{k}]") for k in range(1030)]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "vocab.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def tiny_tokenizer(folder: Path) -> Any:
    from transformers import BertTokenizer

    return BertTokenizer(vocab=str(write_vocabulary(folder)))


def write_models(root: Path) -> Path:
    """Folders of tiny SAM and GroundingDINO under the names that they are looked for."""
    tiny_sam().save_pretrained(root / "sam-vit-h")
    (root / "sam-vit-h" / "preprocessor_config.json").write_text("{}")
    tiny_dino().save_pretrained(root / "grounding-dino")
    (root / "grounding-dino" / "preprocessor_config.json").write_text("{}")
    tiny_tokenizer(root / "grounding-dino").save_pretrained(root / "grounding-dino")
    return root


def paper_words(models: Path, out: Path, scene: str, settings: Sequence[str] = (), *words: str) -> list[str]:
    """``su3d-bench run --profile paper`` on the models of ``write_models``, over two small images of a scene."""
    lenient = [f"models.folder={models}", "models.encoder=embedded", "paper.n_tags=6"]
    # Random masks are scattered over the image; their own boxes would be too large to count.
    lenient += ["paper.grounded.boxes.box_threshold=0.3", "paper.grounded.region_boxes=detector"]
    lenient += ["paper.automatic.points_per_side=2", "paper.automatic.pred_iou_thresh=0"]
    lenient += ["paper.automatic.stability_score_thresh=0", "paper.automatic.box_nms_thresh=1.0"]
    if scene.startswith("rooms/"):
        settings = (*settings, "rooms.width=160", "rooms.height=120", "rooms.mesh_spacing_m=0.1")
        words = (*words, "--protocols", "rooms-semantic")
    options = ["--scenes", scene, "--profile", "paper", "--limit", "2", "--no-pictures", "--jobs", "1", "--quiet"]
    return ["run", *options, *words, "--out", str(out), "--set", *(f"perception.{one}" for one in lenient), *settings]


def blocks(height: int, width: int, seed: int = 0, cell: int = 8) -> UInt8Array:
    """An image of coloured squares."""
    random = np.random.default_rng(seed)
    small = random.integers(0, 256, (-(-height // cell), -(-width // cell), 3), dtype=np.uint8)
    return np.ascontiguousarray(small.repeat(cell, 0).repeat(cell, 1)[:height, :width])


def frame_of(rgb: UInt8Array, index: int = 0) -> Frame:
    """A frame that shows ``rgb`` on a wall 2 m away."""
    intrinsics = np.array([[100.0, 0, rgb.shape[1] / 2], [0, 100.0, rgb.shape[0] / 2], [0, 0, 1]])
    return Frame(index, 0.0, rgb, np.full(rgb.shape[:2], 2, np.float32), np.eye(4), intrinsics)
