"""Any model of the catalogue that can be exported, written as ONNX files."""

from __future__ import annotations

from pathlib import Path

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.devices import require
from su3d_bench.perception.models.catalogue import MODELS, ModelEntry
from su3d_bench.perception.models.encoders.towers_onnx import export_encoder
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.masks.sam_onnx import export_sam
from su3d_bench.perception.models.onnx.manifest import OnnxManifest

EXPORTED_KINDS = ("encoder", "segmenter")


def export_model(entry: ModelEntry, out: Path, *, path: Path | None = None, folder: Path | None = None) -> OnnxManifest:
    """Write ``entry`` as ONNX files into ``out``; raises ``CheckFailed`` where they do not agree with torch."""
    if entry.kind not in EXPORTED_KINDS:
        known = ", ".join(model.name for model in MODELS.values() if model.kind in EXPORTED_KINDS)
        raise ConfigError(f"models export: '{entry.name}' is not exported by this program; known: {known}")
    for package in ("torch", "transformers", "onnx"):
        require(package, f"models export {entry.name}")
    if entry.kind == "encoder":
        return export_encoder(locate(entry.name, ("transformers",), path=path, folder=folder), out)
    return export_sam(locate(entry.name, ("transformers", "original"), path=path, folder=folder), out)
