"""Frames per second of each stage of the profile ``paper`` at full size, with random weights, which suffice for speed.

``python benchmarks paper_profile_speed --device cuda`` builds SAM ViT-H, GroundingDINO Swin-T and CLIP ViT-H-14 from
their configurations, and runs them on one image of a room. RAM++ is not built: its architecture is in its own package.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.system.devices import make_deterministic, precision_for, require_transformers
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.perception.models.encoders.encoder import TransformersTowers
from su3d_bench.perception.models.masks.automatic_masks import AUTOMATIC_MASKS, AutomaticMasks
from su3d_bench.perception.models.masks.grounding_dino import BoxConfig, GroundingDino
from su3d_bench.perception.models.masks.sam import Sam, TorchSam, sam_config
from su3d_bench.runs.scenes import data_root

N_BOXES, N_RATIOS = 15, 3  # named objects in an image of a room, and the paper's crops of each
N_TAGS = 20


def device_model(model: Any, device: str, precision: str) -> Any:
    """``model`` in the form used by the profile."""
    import torch

    return model.eval().to(device=device, dtype=getattr(torch, precision))


def tokenizer() -> Any:
    """A BERT tokenizer of single-token words, with BERT's special tokens at their ids."""
    transformers = require_transformers("this benchmark")
    marks = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
    words = marks | {2000 + k: f"tag{k}" for k in range(N_TAGS)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vocab.txt"
        path.write_text("\n".join(words.get(k, f"[unused{k}]") for k in range(30522)) + "\n")
        return transformers.BertTokenizer(vocab=str(path))


def grounding_dino(device: str, precision: str) -> GroundingDino:
    """The published configuration of grounding-dino-tiny."""
    transformers = require_transformers("this benchmark")
    swin = transformers.SwinConfig(
        embed_dim=96, depths=[2, 2, 6, 2], num_heads=[3, 6, 12, 24], window_size=7, image_size=224,
        out_features=["stage2", "stage3", "stage4"],
    )  # fmt: skip
    config = transformers.GroundingDinoConfig(backbone_config=swin, text_config=transformers.BertConfig())
    model = transformers.GroundingDinoForObjectDetection(config)
    return GroundingDino(device_model(model, device, precision), tokenizer())


def clip(device: str, precision: str, batch: int) -> TransformersTowers:
    """The image tower of CLIP ViT-H-14, with the smallest text tower."""
    transformers = require_transformers("this benchmark")
    vision = {
        "hidden_size": 1280, "intermediate_size": 5120, "num_hidden_layers": 32, "num_attention_heads": 16,
        "patch_size": 14, "image_size": 224, "projection_dim": 1024,
    }  # fmt: skip
    text = {"hidden_size": 64, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 1}
    model = transformers.CLIPModel(transformers.CLIPConfig(vision_config=vision, text_config=text, projection_dim=1024))
    return TransformersTowers(model.eval(), device, precision, batch)


def seconds(work: Callable[[], object], device: str, repeats: int) -> float:
    """The median time of ``work``; on a GPU after one warm-up run."""
    import torch

    def wait() -> None:
        if device != "cpu":
            torch.cuda.synchronize(device)

    if device != "cpu":
        work()
    times = []
    for _ in range(repeats):
        wait()
        start = time.perf_counter()
        work()
        wait()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


Stage = tuple[str, Callable[[], object]]


def detector_stages(device: str, precision: str, rgb: UInt8Array) -> list[Stage]:
    """Boxes of twenty tags."""
    detector, tags = grounding_dino(device, precision), [f"tag{k}" for k in range(N_TAGS)]
    return [(f"GroundingDINO, boxes of {N_TAGS} tags", lambda: detector.detect(rgb, tags, BoxConfig()))]


def segmenter_stages(device: str, precision: str, rgb: UInt8Array) -> list[Stage]:
    """The image embedding, masks of boxes, and masks of everything."""
    transformers = require_transformers("this benchmark")
    sam = Sam(TorchSam(device_model(transformers.SamModel(sam_config("sam-vit-h")), device, precision)))
    image = sam.look(rgb)
    height, width = rgb.shape[:2]
    corners = np.sort(np.random.default_rng(0).uniform(0, 1, (N_BOXES, 2, 2)), axis=1).reshape(-1, 4)
    boxes: Float32Array = (corners * [width, height, width, height]).astype(np.float32)
    # Random weights are sure of nothing: without this filter every mask grows to full size, the worst case.
    settings = AUTOMATIC_MASKS["conceptgraphs"].model_copy(update={"pred_iou_thresh": 0.0})
    automatic = AutomaticMasks(sam, settings)
    return [
        ("SAM ViT-H, image embedding", lambda: sam.look(rgb)),
        (f"SAM ViT-H, masks of {N_BOXES} boxes", lambda: sam.from_boxes(image, boxes, is_single=False)),
        ("SAM ViT-H, automatic masks of 12 x 12 points", lambda: automatic.regions(rgb)),
    ]


def encoder_stages(device: str, precision: str, rgb: UInt8Array) -> list[Stage]:
    """The image and three crops of every object in it."""
    towers = clip(device, precision, 0)
    n_crops = N_BOXES * N_RATIOS + 1
    pixels = np.random.default_rng(0).normal(size=(n_crops, 3, 224, 224)).astype(np.float32)

    def encode() -> None:
        for start in range(0, n_crops, towers.batch):
            towers.image_features(pixels[start : start + towers.batch])

    return [(f"CLIP ViT-H-14, {n_crops} crops in batches of {towers.batch}", encode)]


PARTS = {"detector": detector_stages, "segmenter": segmenter_stages, "encoder": encoder_stages}


def main() -> int:
    parser = argparse.ArgumentParser(description="Frames per second of each stage of the profile 'paper'.")
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:1")
    parser.add_argument("--precision", default="auto", help="auto, float32, float16 or bfloat16")
    parser.add_argument("--repeats", type=int, default=0, help="runs of each stage; 0: 1 on the CPU, 5 on a GPU")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS, help="which networks")
    wanted = parser.parse_args()
    import torch

    torch.manual_seed(0)
    make_deterministic(wanted.device)
    precision = precision_for(wanted.precision, wanted.device)
    repeats = wanted.repeats or (1 if wanted.device == "cpu" else 5)
    rgb = Rooms(data_root()).frames("living0", 40)[0].rgb
    what = (
        torch.cuda.get_device_name(wanted.device)
        if wanted.device != "cpu"
        else f"cpu, {torch.get_num_threads()} threads"
    )
    print(f"{what}, {precision}, image {rgb.shape[1]}x{rgb.shape[0]}, median of {repeats}\n")
    print("| stage | s per frame | frames per second |\n|---|---|---|")
    for part in wanted.parts:  # one network is in memory at a time
        for name, work in PARTS[part](wanted.device, precision, rgb):
            taken = seconds(work, wanted.device, repeats)
            print(f"| {name} | {taken:.3f} | {1 / taken:.2f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
