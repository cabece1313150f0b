"""Tiny networks with random weights in the published formats, and images to run them on."""

from __future__ import annotations

import json
import string
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.system.devices import require, require_transformers
from su3d_bench.core.types import Frame, UInt8Array
from su3d_bench.perception.models.encoders.images import CLIP_MEAN, CLIP_STD
from su3d_bench.perception.models.masks.grounded_sam import RAM_MODEL, RAM_PX, RAM_TAG_LIST

DINO_PX = (48, 80)
SAM_PX = 64


def write_models(root: Path) -> Path:
    """Folders of tiny SAM and GroundingDINO in the hub's format, with the expected names."""
    for name, model in (("sam-vit-h", tiny_sam()), ("grounding-dino", tiny_dino())):
        model.save_pretrained(root / name)
        (root / name / "preprocessor_config.json").write_text("{}")
    tiny_tokenizer(root / "grounding-dino").save_pretrained(root / "grounding-dino")
    return root


def write_fetched(root: Path) -> Path:
    """Tiny networks in the folders of the models fetched for the papers, RAM++ as its export."""
    write_models(root)
    for name, seed in (("clip-vit-h-14", 14), ("clip-vit-l-14-336", 336)):
        write_tiny_clip(root / name, seed, n_tokens=77)  # as published, so that no text is truncated
    write_tagger(root / "ram-plus-onnx", [word for word in DINO_WORDS if word.isalpha() and len(word) > 1])
    return root


def paper_words(models: Path, out: Path, scene: str, settings: Sequence[str] = (), *words: str) -> list[str]:
    """``su3d-bench run --profile paper`` on the models of ``write_models``, over two small images of a scene."""
    lenient = [f"models.folder={models}", "models.encoder=embedded", "paper.n_tags=6"]
    # Random masks are scattered over the image; their boxes would be too large to count.
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


def noise_images(n: int, seed: int = 0) -> list[UInt8Array]:
    """RGB images of different sizes, one of them a single pixel high, in different colours."""
    rng = np.random.default_rng(seed)
    sizes = [((1, 9), (50, 20), (33, 90), (64, 64), (120, 45))[k % 5] for k in range(n)]
    return [rng.integers(0, 256, (*size, 3), np.uint8) // 2 + rng.integers(0, 128, 3, np.uint8) for size in sizes]


# ---- SAM


@cache
def tiny_sam() -> Any:
    """``transformers``' SamModel of two layers, one of them global, and an image of 64 px; random throughout."""
    import torch

    transformers = require_transformers("a tiny SAM")
    torch.manual_seed(1)
    config = transformers.SamConfig(
        vision_config={
            "hidden_size": 16, "output_channels": 8, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": SAM_PX, "patch_size": 8, "window_size": 3, "global_attn_indexes": [1],
            "num_pos_feats": 4, "initializer_range": 0.05,
        },
        prompt_encoder_config={"hidden_size": 8, "image_size": SAM_PX, "patch_size": 8, "mask_input_channels": 4},
        mask_decoder_config={"hidden_size": 8, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 8},
    )  # fmt: skip
    model = transformers.SamModel(config)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim() > 1:  # weights that propagate signals; as initialised all images look the same
                parameter.normal_(0, 1.5 / parameter[0].numel() ** 0.5)
    return model.eval()


# ---- GroundingDINO

# Ids of special tokens expected by transformers' GroundingDINO, as in bert-base-uncased.
_MARKS = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
_N_WORDS, _FIRST_WORD = 1100, 200
DINO_WORDS = (
    "cat", "dog", "table", "coffee", "chair", "lamp", "sofa", "book", "##s", "wall", "floor", "window", "a", "item",
)  # fmt: skip


@cache
def tiny_dino() -> Any:
    """``transformers``' GroundingDINO with small towers; texts of at most 32 tokens."""
    import torch

    transformers = require_transformers("a stand-in of GroundingDINO")
    torch.manual_seed(2)
    tower: dict[str, Any] = {
        "embed_dim": 8, "depths": [1, 1, 1, 1], "num_heads": [1, 1, 2, 2], "window_size": 4, "image_size": 64,
        "out_features": ["stage2", "stage3", "stage4"],
    }  # fmt: skip
    config = transformers.GroundingDinoConfig(
        backbone_config=transformers.SwinConfig(**tower),
        text_config=transformers.BertConfig(
            hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=32, vocab_size=_N_WORDS,
            max_position_embeddings=64,
        ),
        num_queries=10, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=32, decoder_ffn_dim=32, d_model=32,
        encoder_attention_heads=4, decoder_attention_heads=4, encoder_n_points=2, decoder_n_points=2,
        max_text_len=32,
    )  # fmt: skip
    model = transformers.GroundingDinoForObjectDetection(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
    return model.eval()


def tiny_tokenizer(folder: Path) -> Any:
    """A tokenizer over ``vocab.txt`` in ``folder``: bert's special tokens at their ids, and some words."""
    named = {_FIRST_WORD + k: word for k, word in enumerate(DINO_WORDS)} | _MARKS
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.txt").write_text("".join(f"{named.get(k, f'[unused{k}]')}\n" for k in range(_N_WORDS)))
    return require_transformers("a stand-in of GroundingDINO").BertTokenizer(vocab=str(folder / "vocab.txt"))


# ---- encoders

CLIP_WORDS = (
    "chair", "table", "lamp", "a", "the", "in", "scene", "red", "cup", "image", "of", "an", "on", "tv", "screen",
)  # fmt: skip
N_TOKENS = 16
CLIP_PX = 32
CLIP_DIM = 24


_LAYERS = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}


def write_tiny_clip(folder: Path, seed: int = 0, n_tokens: int = N_TOKENS) -> Path:
    """A two-layer CLIP as saved by transformers."""
    n_words = write_clip_tokenizer(folder)
    ends = {"bos_token_id": n_words - 2, "eos_token_id": n_words - 1, "pad_token_id": n_words - 1}
    words = {"vocab_size": n_words, "max_position_embeddings": n_tokens, **ends}
    crop = {"crop_size": {"height": CLIP_PX, "width": CLIP_PX}, "do_center_crop": True}
    images = {"size": {"shortest_edge": CLIP_PX}, "image_mean": CLIP_MEAN, "image_std": CLIP_STD, **crop}
    return _write_encoder(folder, seed, "CLIP", words, images, projection_dim=CLIP_DIM)


def write_tiny_siglip(folder: Path, seed: int = 0) -> Path:
    """A two-layer SigLIP as saved by transformers, with a ``tokenizer.json`` of whole words."""
    tokenizers = require("tokenizers", "a stand-in of SigLIP")
    folder.mkdir(parents=True, exist_ok=True)
    known = {word: k for k, word in enumerate(["<unk>", "</s>", *CLIP_WORDS])}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel(known, unk_token="<unk>"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))
    words = {"vocab_size": len(known), "max_position_embeddings": N_TOKENS, "pad_token_id": 1}
    half = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "image_processor_type": "SiglipImageProcessor"}
    return _write_encoder(folder, seed, "Siglip", words, {"size": {"height": CLIP_PX, "width": CLIP_PX}, **half})


def _write_encoder(
    folder: Path, seed: int, kind: str, words: dict[str, Any], images: dict[str, Any], **more: int
) -> Path:
    """An encoder with larger random weights than initially, so that features of different inputs differ."""
    import torch

    transformers = require_transformers("a stand-in of an encoder")
    torch.manual_seed(seed)
    config = getattr(transformers, f"{kind}Config")(
        vision_config={**_LAYERS, "image_size": CLIP_PX, "patch_size": 8}, text_config={**_LAYERS, **words}, **more
    )
    model: Any = getattr(transformers, f"{kind}Model")(config)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.normal_(0.0, 0.2)
    model.save_pretrained(str(folder))
    (folder / "preprocessor_config.json").write_text(json.dumps({"resample": 3, "do_resize": True, **images}))
    return folder


def write_clip_tokenizer(folder: Path) -> int:
    """``vocab.json`` and ``merges.txt`` of letters and ``CLIP_WORDS``; returns the number of words."""
    folder.mkdir(parents=True, exist_ok=True)
    letters = string.ascii_lowercase + string.digits + "-"
    vocabulary = [*letters, *(f"{letter}</w>" for letter in letters)]
    merges: list[str] = []
    for word in CLIP_WORDS:
        left = word[0] if len(word) > 1 else ""
        for place, letter in enumerate(word[1:], start=1):
            right = f"{letter}</w>" if place == len(word) - 1 else letter
            merges.append(f"{left} {right}")
            left += right
            vocabulary.append(left)
    vocabulary = list(dict.fromkeys(vocabulary))
    vocabulary += ["<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(dict.fromkeys(merges)) + "\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer"}))
    return len(vocabulary)


# ---- RAM++ as exported

_N_SEEN = 3 * 4**2  # mean colours of 4 x 4 cells of 96 px
_RAM_PLUS = """
<ir_version: 8, opset_import: ["": 17]>
ram_plus (float[1, 3, {px}, {px}] image) => (float[1, {n}] tag) {{
    cells = AveragePool <kernel_shape = [96, 96], strides = [96, 96]> (image)
    seen = Flatten (cells)
    logits = Gemm (seen, weight, bias)
    is_there = Greater (logits, zero)
    tag = Cast <to = 1> (is_there)
}}
"""


def write_tagger(folder: Path, tags: Sequence[str], seed: int = 0) -> Path:
    """A network that maps ``image`` (1, 3, 384, 384) to ``tag`` (1, T): 1 for some of ``tags``, by colours."""
    onnx = require("onnx", "a stand-in of RAM++")
    random = np.random.default_rng(seed)
    weight = (random.normal(size=(_N_SEEN, len(tags))) / _N_SEEN**0.5).astype(np.float32)
    bias = (random.normal(size=len(tags)) * 0.5).astype(np.float32)
    model = onnx.parser.parse_model(_RAM_PLUS.format(px=RAM_PX, n=len(tags)))
    for name, value in {"weight": weight, "bias": bias, "zero": np.zeros(1, np.float32)}.items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    onnx.checker.check_model(model)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RAM_MODEL).write_bytes(model.SerializeToString())
    (folder / RAM_TAG_LIST).write_text("\n".join(tags) + "\n")
    return folder
