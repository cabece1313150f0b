"""SAM as two ONNX files: their export with a report of parity, their manifest, and how they are run.

A folder holds ``encoder.onnx``, ``decoder.onnx`` (and ``.data`` files beside large ones) and ``manifest.json``: the
size of the network's image, the SHA-256 of every file, the digests of the weights they were made from, the parity.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import CheckFailed, DataError
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.perception.models.files import ModelFiles
from su3d_bench.perception.models.masks.sam import Prompts
from su3d_bench.perception.models.onnx.export import Parity, as_module, export_onnx, measure_parity
from su3d_bench.perception.models.onnx.manifest import OnnxManifest, wrong_files
from su3d_bench.perception.models.onnx.session import Provider, open_session
from su3d_bench.perception.models.pretrained import load_sam

ENCODER_FILE, DECODER_FILE = "encoder.onnx", "decoder.onnx"
# Labels of points in the exported decoder, those of the original's own export: 0 background, 1 object, and these.
NO_POINT, TOP_LEFT, BOTTOM_RIGHT = -1, 2, 3
# Of an output's largest value. Random weights agree to 1e-5; a wrong operator shows in the second decimal.
LARGEST_DIFFERENCE = 1e-3


class SamManifest(OnnxManifest):
    """The manifest of an exported SAM; ``image_px`` is the side of its network's image."""

    FORMAT = "su3d-bench onnx segmenter 1"
    IS_OF = "a segmenter"
    REQUIRES = (ENCODER_FILE, DECODER_FILE)

    image_px: int


class OnnxSam:
    """``SamNetwork`` of the exported encoder and decoder; what follows them is computed in torch on the CPU."""

    def __init__(self, encoder: Any, decoder: Any, image_px: int) -> None:
        self._encoder = encoder
        self._decoder = decoder
        self.image_px = image_px

    def embed(self, pixels: Float32Array) -> Any:
        return self._encoder.run(["embedding"], {"pixels": pixels[None]})[0]

    def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
        import torch

        points, labels = exported_points(prompts)
        fed = {"embedding": embedding, "points": points, "labels": labels}
        logits, predicted = (torch.from_numpy(part) for part in self._decoder.run(["logits", "iou"], fed))
        chosen = slice(0, 1) if is_single else slice(1, None)
        return logits[:, chosen], predicted[:, chosen]


def exported_points(prompts: Prompts) -> tuple[Float32Array, Int64Array]:
    """Points (B, P, 2) and labels (B, P) as the exported decoder takes them: a box is its corners.

    Points without a box are followed by one that is no point, as the network was trained.
    """
    if prompts.boxes is not None:
        labels = np.tile(np.array([TOP_LEFT, BOTTOM_RIGHT], np.int64), (len(prompts), 1))
        return prompts.boxes.reshape(-1, 2, 2).astype(np.float32), labels
    assert prompts.points is not None and prompts.labels is not None
    points = np.pad(prompts.points.astype(np.float32), ((0, 0), (0, 1), (0, 0)))
    return points, np.pad(prompts.labels, ((0, 0), (0, 1)), constant_values=NO_POINT)


def export_sam(files: ModelFiles, folder: Path) -> SamManifest:
    """Write SAM's encoder and decoder into ``folder``; ``CheckFailed`` where ONNX Runtime disagrees with torch."""
    import torch

    model = load_sam(files, "cpu", "float32").model
    make_folder(folder)
    encoder, decoder = modules_to_export(model)
    side = model.config.vision_config.image_size
    random = np.random.default_rng(0)
    pixels = torch.from_numpy(random.normal(size=(1, 3, side, side)).astype(np.float32))
    written = export_onnx(encoder, {"pixels": pixels}, folder / ENCODER_FILE, ["embedding"])
    with torch.inference_mode():
        embedding = encoder(pixels).clone()
    # Two prompts of three points are traced, five of two compared: neither number must be part of the file.
    traced = {"embedding": embedding, **_probes(random, side, 2, 3)}
    axes = {name: {0: "n_prompts", 1: "n_points"} for name in ("points", "labels")}
    outputs = {name: {0: "n_prompts"} for name in ("logits", "iou")}
    written += export_onnx(decoder, traced, folder / DECODER_FILE, ["logits", "iou"], {**axes, **outputs})
    compared = {"embedding": embedding, **_probes(random, side, 5, 2)}
    parity = (
        *measure_parity(encoder, open_session(folder / ENCODER_FILE), {"pixels": pixels}, ["embedding"]),
        *measure_parity(decoder, open_session(folder / DECODER_FILE), compared, ["logits", "iou"]),
    )
    with torch.inference_mode():
        largest = [float(values.abs().max()) for values in (embedding, *decoder(*compared.values()))]
    manifest = SamManifest.of_export(files, written, parity, str(torch.__version__), image_px=side)
    for part, value in zip(parity, largest, strict=True):
        _check(manifest.name, part, value)
    return manifest


def _probes(random: np.random.Generator, side: int, n_prompts: int, n_points: int) -> dict[str, Any]:
    """Prompts of points on the object and beside it, of corners, and of no point."""
    import torch

    points = random.uniform(0, side, (n_prompts, n_points, 2)).astype(np.float32)
    labels = np.resize(np.array([1, NO_POINT, 0, TOP_LEFT, BOTTOM_RIGHT], np.int64), (n_prompts, n_points))
    return {"points": torch.from_numpy(points), "labels": torch.from_numpy(labels)}


def _check(name: str, parity: Parity, largest: float) -> None:
    if parity.max_abs_difference > LARGEST_DIFFERENCE * max(largest, 1e-6):
        raise CheckFailed(
            f"{name}: {parity.output} differs between torch and ONNX Runtime by {parity.max_abs_difference:.2e} of "
            f"at most {largest:.2e}; tolerance {LARGEST_DIFFERENCE:.0e} of the largest value"
        )


def read_sam_manifest(path: Path) -> SamManifest:
    """The manifest of an exported SAM; raises ``DataError`` for anything else."""
    manifest = SamManifest.read(path)
    if not 16 <= manifest.image_px <= 4096:
        raise DataError(f"{path}: image_px is {manifest.image_px}; expected 16 to 4096")
    return manifest


def load_onnx_sam(files: ModelFiles, provider: Provider = "cpu", device_index: int = 0) -> OnnxSam:
    """An exported SAM ready to run; raises ``DataError`` where a file is not the one that was written."""
    manifest = read_sam_manifest(files.weights)
    if wrong := wrong_files(manifest, files.folder):
        raise DataError(wrong[0])
    sessions = [open_session(files.folder / name, provider, device_index) for name in (ENCODER_FILE, DECODER_FILE)]
    return OnnxSam(sessions[0], sessions[1], manifest.image_px)


def modules_to_export(model: Any) -> tuple[Any, Any]:
    """SAM's encoder (pixels -> embedding) and decoder (embedding, points, labels -> logits, iou) as torch modules.

    The decoder gives all four masks: the single one first, then the three of which a caller takes the best.
    """
    import torch

    positions = model.get_image_wide_positional_embeddings().detach()

    def decode(embedding: Any, points: Any, labels: Any) -> tuple[Any, Any]:
        sparse, dense = embedded_points(model.prompt_encoder, points, labels)
        answers = [
            model.mask_decoder(
                image_embeddings=embedding,
                image_positional_embeddings=positions,
                sparse_prompt_embeddings=sparse,
                dense_prompt_embeddings=dense,
                multimask_output=is_multiple,
            )
            for is_multiple in (False, True)
        ]
        logits, scores = (torch.cat(parts, dim=2)[0] for parts in zip(*answers, strict=True))
        return logits, scores

    encoder = as_module(lambda pixels: model.vision_encoder(pixels).last_hidden_state, model.vision_encoder)
    return encoder, as_module(decode, torch.nn.ModuleList([model.prompt_encoder, model.mask_decoder]))


def embedded_points(prompt_encoder: Any, points: Any, labels: Any) -> tuple[Any, Any]:
    """What ``transformers``' prompt encoder makes of points and boxes, from labels alone; sparse and dense."""
    import torch

    side, cells = prompt_encoder.input_image_size, prompt_encoder.image_embedding_size
    # 0.5: from the corner of a pixel to its centre, as in the original.
    sparse = prompt_encoder.shared_embedding((points + 0.5)[None], (side, side))
    kind = labels[None, ..., None]
    sparse = torch.where(kind == NO_POINT, prompt_encoder.not_a_point_embed.weight, sparse)
    for label, embed in enumerate(prompt_encoder.point_embed):
        sparse = sparse + embed.weight * (kind == label)
    dense = prompt_encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(1, -1, cells[0], cells[1])
    return sparse, dense
