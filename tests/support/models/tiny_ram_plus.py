"""A checkout with the files that make RAM++, by their names and interface, around a network of a few hundred weights.

It is ours, not recognize-anything's: nothing of that is part of this project.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

TAGS = ("armchair", "bed", "café table", "lamp", "3D glasses")
THRESHOLDS = (0.5, 0.5, 0.5, 1.0, 0.0)  # one that nothing reaches, one that everything does
N_DESCRIPTIONS, WIDTH = 3, 8

NETWORK = f"""
import numpy as np
import torch
from torch import nn

from .bert import Head
from .swin_transformer import Seeing
from .utils import *


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        assert len(init_tokenizer("bert-base-uncased")) == 30524
        self.visual_encoder = Seeing()
        self.image_proj = nn.Linear(6, {WIDTH})
        self.tag_list = np.array(read_lines("ram_tag_list"))
        self.tag_list_chinese = np.array(read_lines("ram_tag_list_chinese"))
        self.class_threshold = torch.tensor([float(line) for line in read_lines("ram_tag_list_threshold")])
        self.label_embed = nn.Parameter(torch.zeros(len(self.tag_list) * {N_DESCRIPTIONS}, {WIDTH}))
        self.reweight_scale = nn.Parameter(torch.ones([]))
        self.wordvec_proj = nn.Linear({WIDTH}, {WIDTH})
        self.tagging_head = Head({WIDTH})
        self.fc = nn.Linear({WIDTH}, 1)
        self.register_buffer("relative_position_index", torch.arange(4))

    def generate_tag(self, image):
        seen = self.image_proj(self.visual_encoder(image))
        whole = seen[:, 0] / seen[:, 0].norm(dim=-1, keepdim=True)
        likeness = (self.reweight_scale.exp() * whole @ self.label_embed.t()).view(len(self.tag_list), -1)
        table = self.label_embed.view(len(self.tag_list), -1, {WIDTH})
        labels = (torch.softmax(likeness, dim=1)[..., None] * table).sum(dim=1)
        found = self.tagging_head(
            encoder_embeds=torch.relu(self.wordvec_proj(labels))[None],
            encoder_hidden_states=seen,
            encoder_attention_mask=torch.ones(seen.shape[:2], dtype=torch.long),
            return_dict=False,
            mode="tagging",
        )
        holds = (torch.sigmoid(self.fc(found[0]).squeeze(-1)) > self.class_threshold)[0].numpy()
        return [" | ".join(self.tag_list[holds])], [" | ".join(self.tag_list_chinese[holds])]


def ram_plus(pretrained="", image_size=0, vit=""):
    assert (pretrained, image_size, vit) == ("", 384, "swin_l")
    return Network()
"""
SEEING = """
import torch
from scipy import interpolate
from timm.models.layers import DropPath, to_2tuple, trunc_normal_
from torch import nn


class Seeing(nn.Module):
    def __init__(self):
        super().__init__()
        self.parts = nn.Conv2d(3, 6, to_2tuple(96), 96)
        self.drop = DropPath(0.9)

    def forward(self, image):
        parts = self.drop(self.parts(image).flatten(2).transpose(1, 2))
        return torch.cat([parts.mean(dim=1, keepdim=True), parts], dim=1)
"""
HEAD = """
import torch
from torch import nn


class Head(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.asks = nn.Linear(width, width)

    def forward(self, encoder_embeds, encoder_hidden_states, encoder_attention_mask, return_dict, mode):
        assert mode == "tagging" and not return_dict
        likeness = self.asks(encoder_embeds) @ encoder_hidden_states.transpose(1, 2)
        return (encoder_embeds + torch.softmax(likeness, dim=-1) @ encoder_hidden_states,)
"""
SHARED = """
from pathlib import Path

from timm.models.hub import download_cached_file

from .vit import VisionTransformer, interpolate_pos_embed


def read_lines(name):
    return (Path(__file__).parents[1] / "data" / f"{name}.txt").read_text(encoding="utf-8").splitlines()


def init_tokenizer(name):
    raise OSError("the hub would be asked for bert-base-uncased")
"""


def write_checkout(folder: Path) -> Path:
    """The checkout in ``folder``, which it returns."""
    files = {
        "ram/__init__.py": "raise ImportError('needs torchvision')\n",
        "ram/models/__init__.py": "raise ImportError('needs fairscale')\n",
        "ram/models/ram_plus.py": NETWORK,
        "ram/models/bert.py": HEAD,
        "ram/models/swin_transformer.py": SEEING,
        "ram/models/utils.py": SHARED,
        "ram/configs/q2l_config.json": "{}",
        "ram/configs/swin/config_swinL_384.json": "{}",
        "ram/data/ram_tag_list.txt": "\n".join(TAGS),
        "ram/data/ram_tag_list_chinese.txt": "\n".join("一二三四五"),
        "ram/data/ram_tag_list_threshold.txt": "\n".join(map(str, THRESHOLDS)),
    }
    for name, text in files.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
    return folder


def tiny_tensors() -> dict[str, Any]:
    """Weights for the network of ``write_checkout``, the head under its older name and a buffer of another window."""
    import torch

    random = torch.Generator().manual_seed(3)
    shapes = {
        "visual_encoder.parts.weight": (6, 3, 96, 96),
        "visual_encoder.parts.bias": (6,),
        "image_proj.weight": (WIDTH, 6),
        "image_proj.bias": (WIDTH,),
        "label_embed": (len(TAGS) * N_DESCRIPTIONS, WIDTH),
        "reweight_scale": (),
        "wordvec_proj.weight": (WIDTH, WIDTH),
        "wordvec_proj.bias": (WIDTH,),
        "vision_multi.asks.weight": (WIDTH, WIDTH),
        "vision_multi.asks.bias": (WIDTH,),
        "fc.weight": (1, WIDTH),
        "fc.bias": (1,),
    }
    drawn = {name: torch.randn(shape, generator=random) for name, shape in shapes.items()}
    drawn["visual_encoder.parts.weight"] /= 100
    drawn["fc.weight"] /= 50  # a sigmoid of less than float32 holds is another with every runtime
    return {**drawn, "layers.0.attn.relative_position_index": torch.arange(9)}
