"""Any model of the catalogue that can be exported, written as ONNX files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.devices import require
from su3d_bench.perception.models.catalogue import MODELS, ModelEntry
from su3d_bench.perception.models.encoders.towers_onnx import export_encoder
from su3d_bench.perception.models.files import locate
from su3d_bench.perception.models.masks.sam_onnx import export_sam
from su3d_bench.perception.models.onnx.isolated import RAM_PLUS_PACKAGES, made_environment
from su3d_bench.perception.models.onnx.manifest import OnnxManifest
from su3d_bench.perception.models.onnx.ram_plus import REPOSITORY, check_checkout, export_ram_plus

EXPORTED_KINDS = ("encoder", "segmenter", "tagger")


@dataclass(frozen=True)
class OwnCode:
    """Where a model's authors' code lies and what runs it: ``python``, or an environment that is made in a folder."""

    checkout: Path | None = None
    python: Path | None = None
    environment: Path | None = None


def export_model(
    entry: ModelEntry, out: Path, *, path: Path | None = None, folder: Path | None = None, own: OwnCode | None = None
) -> OnnxManifest:
    """Write ``entry`` as ONNX files into ``out``; raises ``CheckFailed`` where they do not agree with torch."""
    if entry.kind not in EXPORTED_KINDS:
        known = ", ".join(model.name for model in MODELS.values() if model.kind in EXPORTED_KINDS)
        raise ConfigError(f"models export: '{entry.name}' is not exported by this program; known: {known}")
    if own not in (None, OwnCode()) and entry.kind != "tagger":
        raise ConfigError(
            f"models export {entry.name}: needs no code but ours; leave --checkout, --python and --environment out"
        )
    for package in ("torch", "transformers", "onnx"):
        require(package, f"models export {entry.name}")
    if entry.kind == "encoder":
        return export_encoder(locate(entry.name, ("transformers",), path=path, folder=folder), out)
    if entry.kind == "segmenter":
        return export_sam(locate(entry.name, ("transformers", "original"), path=path, folder=folder), out)
    return _export_ram_plus(entry, out, path, folder, own or OwnCode())


def _export_ram_plus(
    entry: ModelEntry, out: Path, path: Path | None, folder: Path | None, own: OwnCode
) -> OnnxManifest:
    if own.checkout is None:
        raise ConfigError(
            f"models export {entry.name}: its authors' code is run; git clone {REPOSITORY} and name the folder "
            "with --checkout"
        )
    if (own.python is None) == (own.environment is None):
        raise ConfigError(
            f"models export {entry.name}: give --environment DIR, and pip installs {', '.join(RAM_PLUS_PACKAGES)} "
            "there, or --python PYTHON of an environment that has them"
        )
    files = locate(entry.name, ("original",), path=path, folder=folder)
    check_checkout(own.checkout)
    python = own.python or made_environment((own.environment or out).absolute(), RAM_PLUS_PACKAGES)
    return export_ram_plus(files, out, own.checkout, python)
