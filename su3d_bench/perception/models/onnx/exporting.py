"""Any model of the catalogue that comes as ONNX: what its export wrote, and how far it is from torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.devices import require
from su3d_bench.core.errors import ConfigError
from su3d_bench.perception.models.catalogue import MODELS, ModelEntry
from su3d_bench.perception.models.encoders.towers_onnx import Manifest as EncoderManifest
from su3d_bench.perception.models.encoders.towers_onnx import export_encoder
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.masks.sam_onnx import SamManifest, export_sam
from su3d_bench.perception.models.onnx.export import Parity

EXPORTED_KINDS = ("encoder", "segmenter")


@dataclass(frozen=True)
class Export:
    """``files`` name -> SHA-256, and the ``parity`` of every part."""

    files: Mapping[str, str]
    parity: tuple[Parity, ...]


def export_model(entry: ModelEntry, out: Path, *, path: Path | None = None, folder: Path | None = None) -> Export:
    """Write ``entry`` as ONNX files into ``out``; raises ``CheckFailed`` where they do not agree with torch."""
    if entry.kind not in EXPORTED_KINDS:
        known = ", ".join(one.name for one in MODELS.values() if one.kind in EXPORTED_KINDS)
        raise ConfigError(f"models export: '{entry.name}' is not exported by this program; known: {known}")
    for package in ("torch", "transformers", "onnx"):
        require(package, f"models export {entry.name}")
    manifest: EncoderManifest | SamManifest
    if entry.kind == "encoder":
        manifest = export_encoder(locate(entry.name, ("transformers",), path=path, folder=folder), out)
    else:
        manifest = export_sam(locate(entry.name, ("transformers", "original"), path=path, folder=folder), out)
    return Export(manifest.files, manifest.parity)
