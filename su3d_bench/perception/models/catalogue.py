"""Every model by its short name, from ``catalogue.toml``: its files, their source, and its licence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.system.files import file_text, parse_toml

Kind = Literal["encoder", "segmenter", "detector", "tagger"]
FormName = Literal["transformers", "original", "onnx"]

ONNX_MANIFEST = "manifest.json"


@dataclass(frozen=True)
class ModelForm:
    """One set of files of a model; the first of ``files`` is the weights.

    ``repository`` is its name on the Hugging Face hub, ``source`` the address for a manual download; ``sha256`` by file
    name; ``is_read`` false: only recognised, not loaded.
    """

    form: FormName
    files: tuple[str, ...]
    source: str
    size_mb: int
    repository: str | None = None
    sha256: Mapping[str, str] = field(default_factory=dict, hash=False)
    is_read: bool = True


@dataclass(frozen=True)
class ModelEntry:
    """One model: ``n_parameters_million`` determines its memory; ``forms`` are in the order in which they are tried.

    ``known_as``: architecture and training as named by open_clip, which protocols and run records use for encoders.
    ``trained_on``: its training data, as named by the publisher.
    """

    name: str
    kind: Kind
    summary: str
    licence: str
    n_parameters_million: int
    forms: tuple[ModelForm, ...]
    remark: str = ""
    known_as: str = ""
    trained_on: str = ""

    def memory_mb(self, bytes_a_weight: int) -> int:
        """The memory of the weights on the device, in MB, without activations."""
        return self.n_parameters_million * bytes_a_weight

    @property
    def fetched(self) -> ModelForm:
        """The form that ``su3d-bench models fetch`` downloads: the publisher's file if supported, else the hub's."""
        originals = [form for form in self.forms if form.form == "original" and form.is_read]
        return originals[0] if originals else self.forms[0]

    def form(self, name: FormName) -> ModelForm:
        """The form ``name``; raises ``ConfigError`` if the model is not available in it."""
        for form in self.forms:
            if form.form == name:
                return form
        known = ", ".join(form.form for form in self.forms)
        raise ConfigError(f"model '{self.name}': not available in the form '{name}'; known: {known}")


def _entry(name: str, row: Mapping[str, Any]) -> ModelEntry:
    forms = tuple(_form(name, form) for form in row["forms"])
    return ModelEntry(**{**row, "name": name, "forms": forms, "trained_on": _TABLE["trained_on"][row["trained_on"]]})


def _form(name: str, row: Mapping[str, Any]) -> ModelForm:
    hub = f"https://huggingface.co/{row.get('repository')}"
    source = f"python tools/export_onnx.py {name} --out DIR" if row["form"] == "onnx" else hub
    listed = row["files"] if isinstance(row["files"], list) else _TABLE["files"][row["files"]]
    return ModelForm(**{"source": source, **row, "files": tuple(listed)})


_TABLE = parse_toml(file_text(Path(__file__).with_name("catalogue.toml")))
MODELS: Mapping[str, ModelEntry] = MappingProxyType({name: _entry(name, row) for name, row in _TABLE["models"].items()})
SETTINGS: tuple[str, ...] = tuple(_TABLE["settings"])
# Models that a profile loads by default; other profiles load no model of this table.
PROFILE_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"paper": ("clip-vit-h-14", "sam-vit-h", "grounding-dino", "ram-plus")}
)
# Additional models for the papers' experiments: OpenMask3D's set-up uses this encoder.
PAPERS_ENCODERS = ("clip-vit-l-14-336",)


def model_entry(name: str, kind: Kind | None = None) -> ModelEntry:
    """The model ``name``, of ``kind`` if given; raises ``ConfigError`` for any other name."""
    known = [entry.name for entry in MODELS.values() if kind is None or entry.kind == kind]
    if name not in known:
        what = kind or "model"
        raise ConfigError(f"unknown {what} '{name}'{suggest(name, known)}")
    return MODELS[name]


def encoder_known_as(name: str | None) -> ModelEntry | None:
    """The encoder named ``name`` in protocols and run records."""
    return next(
        (entry for entry in MODELS.values() if name and entry.known_as == name and entry.kind == "encoder"), None
    )
