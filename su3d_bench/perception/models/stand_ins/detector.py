"""A tiny GroundingDINO with random weights, and a tokenizer that knows BERT's marks and the words of a few things."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.system.devices import require_transformers

# Where transformers' GroundingDINO expects its marks, those of bert-base-uncased.
_MARKS = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
_N_WORDS, _FIRST_WORD = 1100, 200
WORDS = (
    "cat", "dog", "table", "coffee", "chair", "lamp", "sofa", "book", "##s", "wall", "floor", "window", "a", "item",
)  # fmt: skip


@cache
def tiny_dino(n_queries: int = 10, n_tokens: int = 32) -> Any:
    """``transformers``' GroundingDINO with small towers; texts of at most ``n_tokens`` tokens."""
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
            max_position_embeddings=max(64, n_tokens),
        ),
        num_queries=n_queries, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=32, decoder_ffn_dim=32, d_model=32,
        encoder_attention_heads=4, decoder_attention_heads=4, encoder_n_points=2, decoder_n_points=2,
        max_text_len=n_tokens,
    )  # fmt: skip
    model = transformers.GroundingDinoForObjectDetection(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
    return model.eval()


def write_vocabulary(folder: Path, words: Sequence[str] = WORDS) -> Path:
    """``vocab.txt`` of the tiny tokenizer: bert's marks in their places, some words, and nothing else of use."""
    named = {_FIRST_WORD + k: word for k, word in enumerate(words)} | _MARKS
    lines = [named.get(k, f"[unused{k}]") for k in range(_N_WORDS)]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "vocab.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def tiny_tokenizer(folder: Path, words: Sequence[str] = WORDS) -> Any:
    transformers = require_transformers("a stand-in of GroundingDINO")
    return transformers.BertTokenizer(vocab=str(write_vocabulary(folder, words)))


def write_detector(folder: Path, model: Any = None, words: Sequence[str] = WORDS) -> Path:
    """``model`` (``tiny_dino()``) with its tokenizer as the hub's repository has them."""
    (model or tiny_dino()).save_pretrained(str(folder))
    (folder / "preprocessor_config.json").write_text("{}")
    tiny_tokenizer(folder, words).save_pretrained(str(folder))
    write_vocabulary(folder, words)
    return folder


# Words of rooms, so that a text is words and not unknown ones alone.
ROOM_WORDS = (
    "wall", "floor", "ceiling", "chair", "table", "lamp", "bed", "cabinet", "door", "window", "picture", "plant",
    "vase", "desk", "rug", "pillow", "blanket", "shelf", "sofa", "curtain", "book", "monitor", "stool", "bin", "other",
    "item", "a", "##s",
)  # fmt: skip
_UNSURE = -3.0  # what every logit begins at; words take it up or down from there
_SPREAD = 0.28
_LARGER = 1.0  # of a box's sides, a layer: the network's own are a twentieth of the image


@cache
def sparing_dino() -> Any:
    """``tiny_dino`` with the published length of texts, whose boxes are large enough to hold things and have few names.

    As random as it comes, every box goes by all words of the text, which no threshold can part.
    """
    import torch

    model = tiny_dino.__wrapped__(n_queries=24, n_tokens=256)
    with torch.no_grad():
        words = model.model.text_backbone.embeddings
        words.word_embeddings.weight.normal_(0.0, 1.0)
        words.position_embeddings.weight.mul_(0.1)
        words.token_type_embeddings.weight.zero_()
        said = model.model.encoder.layers[-1].text_enhancer_layer.layer_norm_after
        seen = model.model.decoder.layer_norm
        for norm, scale in ((said, 1.0), (seen, _SPREAD)):
            norm.weight.fill_(scale)
            norm.bias.zero_()
            norm.weight[0] = 0.0
        said.bias[0], seen.bias[0] = 1.0, _UNSURE
        for heads in (model.bbox_embed, model.model.decoder.bbox_embed):
            for head in heads:
                last = head.layers[-1]
                last.weight[2:].normal_(0.0, 0.25)
                last.bias[2:] = _LARGER
    return model
