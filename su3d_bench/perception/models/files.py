"""The location of a model's files on this machine, their digests, and reading them; nothing is ever downloaded.

A model is searched in this order: at the path named in the configuration; below the configured folder or
``$SU3D_MODELS`` (default ``~/.cache/su3d-bench/models``); in the Hugging Face cache (``$HF_HUB_CACHE``,
``$HF_HOME/hub``, ``~/.cache/huggingface/hub``).
"""

from __future__ import annotations

import json
import os
import pickle
import stat
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from su3d_bench.core.digests import digest_bytes, digest_file
from su3d_bench.core.errors import (
    ConfigError,
    DataError,
    ModelMissing,
    PredictionError,
    StoreError,
    converted,
    printable,
)
from su3d_bench.core.files.atomic import make_folder, read_json, write_json
from su3d_bench.core.system.devices import make_deterministic, require, require_transformers
from su3d_bench.core.system.files import file_text, regular
from su3d_bench.formats.torch_files import check_stored
from su3d_bench.perception.models.catalogue import SETTINGS, FormName, ModelEntry, ModelForm, model_entry

DEFAULT_FOLDER = "~/.cache/su3d-bench/models"
DIGEST_FOLDER = "model-digests"
Checked = TypeVar("Checked")
Loaded = TypeVar("Loaded")
MAX_SETTINGS_BYTES = 2**24  # bytes; a tokenizer.json of 256,000 words has 2**23
PICKLED = {".bin", ".pt", ".pth", ".ckpt"}


@dataclass(frozen=True)
class ModelFiles:
    """The files of one model on this machine; ``weights`` is its weights file, or the manifest of an exported model."""

    entry: ModelEntry
    form: ModelForm
    folder: Path
    weights: Path

    def _own(self) -> list[Path]:
        """The weights and every settings file next to them."""
        names = dict.fromkeys((self.weights.name, *SETTINGS))
        return [path for name in names if (path := self.folder / name).is_file()]

    def digests(self) -> dict[str, str]:
        """SHA-256 by file name of the weights and of every settings file next to them."""
        return {path.name: file_sha256(path) for path in self._own()}

    @property
    def state(self) -> tuple[tuple[str, int, int], ...]:
        """Name, size and modification time of these files, for whatever keeps their content in memory."""
        states = [(path.name, path.stat()) for path in self._own()]
        return tuple((name, status.st_size, status.st_mtime_ns) for name, status in states)

    def wrong_digests(self) -> list[str]:
        """One line per file whose digest differs from the published one."""
        digests = self.digests()
        advice = what_to_fetch(self.entry, (self.form,))
        return [
            f"{self.folder / name}: sha256 is {digests[name]}, but the published one is {known}; {advice}"
            for name, known in self.form.sha256.items()
            if name in digests and digests[name] != known
        ]


def models_folder(configured: Path | None = None) -> Path:
    """Where models are stored: ``configured``, otherwise ``$SU3D_MODELS``, otherwise the user's cache."""
    return (configured or Path(os.environ.get("SU3D_MODELS") or DEFAULT_FOLDER)).expanduser().absolute()


def hub_cache() -> Path:
    """The cache folder of the Hugging Face libraries."""
    if folder := os.environ.get("HF_HUB_CACHE"):
        return Path(folder).expanduser()
    return Path(os.environ.get("HF_HOME") or "~/.cache/huggingface").expanduser() / "hub"


def locate(
    name: str,
    forms: Sequence[FormName] | None = None,
    *,
    path: Path | None = None,
    folder: Path | None = None,
) -> ModelFiles:
    """The files of model ``name`` in the first of ``forms`` (default: all supported) that is complete.

    ``path``: the configured file or folder, the only one searched if given; ``folder``: searched instead of
    ``$SU3D_MODELS``. Raises ``ModelMissing`` with what to download, and ``ConfigError`` for an unknown name.
    """
    entry = model_entry(name)
    read = tuple(form for form in entry.forms if form.is_read)
    wanted = read if forms is None else tuple(entry.form(form) for form in forms)
    if path is not None:
        return _at(entry, wanted, path.expanduser().absolute())
    for form in wanted:
        for candidate in _folders(entry, form, folder):
            if (found := _whole(entry, form, candidate)) is not None:
                return found
    place = models_folder(folder)
    raise ModelMissing(f"model '{entry.name}': not found below {place}; {what_to_fetch(entry, wanted)}")


def _at(entry: ModelEntry, forms: Sequence[ModelForm], path: Path) -> ModelFiles:
    if path.is_file():
        for form in forms:
            if path.name in _names(form.files[0]) and not _lacking(form, path.parent):
                return ModelFiles(entry, form, path.parent, path)
        if originals := [form for form in forms if form.form == "original"]:  # the one form that is a single file
            return ModelFiles(entry, originals[0], path.parent, path)
        known = " or ".join(name for form in forms for name in _names(form.files[0]))
        raise ConfigError(f"model '{entry.name}': {path} is not a supported file; use a folder with {known}")
    if not path.is_dir():
        raise ModelMissing(f"model '{entry.name}': missing {path}; correct the path, or {what_to_fetch(entry, forms)}")
    for form in forms:
        if (found := _whole(entry, form, path)) is not None:
            return found
    nearest = min((_lacking(form, path) for form in forms), key=len)
    raise ModelMissing(f"model '{entry.name}': {path} lacks {', '.join(nearest)}; {what_to_fetch(entry, forms)}")


def _folders(entry: ModelEntry, form: ModelForm, configured: Path | None) -> Iterator[Path]:
    """Where a form may be stored, the most specific place first."""
    root = models_folder(configured)
    if form.form == "onnx":
        yield root / f"{entry.name}-onnx"
        return
    yield root / entry.name
    if form.repository is not None:
        yield root / form.repository
        yield root / form.repository.rpartition("/")[2]
        for cache in (root, hub_cache()):
            yield from _snapshots(cache / f"models--{form.repository.replace('/', '--')}")
    if form.form == "original":
        yield root


def _snapshots(folder: Path) -> Iterator[Path]:
    """The snapshot of ``main``; if that is unknown, the only one."""
    snapshots = folder / "snapshots"
    try:
        revision = file_text(folder / "refs" / "main").strip()
    except (OSError, UnicodeDecodeError):
        revision = ""
    if revision.isalnum() and (snapshots / revision).is_dir():
        yield snapshots / revision
        return
    folders = sorted(path for path in snapshots.glob("*") if path.is_dir())
    if len(folders) > 1:
        raise ConfigError(f"{snapshots}: has {len(folders)} snapshots but no refs/main; select one with models.paths")
    yield from folders


def _names(requirement: str) -> list[str]:
    return [name.strip() for alternative in requirement.split("|") for name in alternative.split("+")]


def _whole(entry: ModelEntry, form: ModelForm, folder: Path) -> ModelFiles | None:
    """The files of ``form`` in ``folder``; None if one is missing."""
    if _lacking(form, folder):
        return None
    weights = next(folder / name for name in _names(form.files[0]) if (folder / name).is_file())
    return ModelFiles(entry, form, folder, weights)


def _lacking(form: ModelForm, folder: Path) -> list[str]:
    """The requirements for which no alternative is complete in ``folder``."""
    return [
        requirement.replace(" | ", " or ").replace(" + ", " and ")
        for requirement in form.files
        if not any(all((folder / name).is_file() for name in _names(part)) for part in requirement.split("|"))
    ]


def what_to_fetch(entry: ModelEntry, forms: Sequence[ModelForm]) -> str:
    """How to get one of ``forms`` of ``entry``: the command to download or export it, else its files and address."""
    if entry.fetched in forms:
        return f"run: su3d-bench models fetch {entry.name} ({entry.fetched.size_mb / 1000:.1f} GB)"
    if forms[0].form == "onnx":
        return f"run: {forms[0].source}"
    names = ", ".join(_names(requirement)[0] for requirement in forms[0].files)
    return f"put {names} of {forms[0].source} ({forms[0].size_mb / 1000:.1f} GB) there"


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, cached in ``$SU3D_CACHE`` by path, size and modification time, since weights are large."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(f"{path}: is not a regular file")
    if status.st_size < 2**20:
        return digest_file(path)
    key = f"{path.resolve()}\n{status.st_size}\n{status.st_mtime_ns}"
    note = digest_cache() / f"{digest_bytes(key.encode())[:32]}.json"
    with suppress(StoreError, KeyError, TypeError):  # a damaged note counts as absent
        content = read_json(note)
        if content == _note(key, content["sha256"]):
            return str(content["sha256"])
    digest = digest_file(path)
    with suppress(StoreError):  # it is only computed again
        make_folder(note.parent)
        write_json(note, _note(key, digest))
    return digest


def digest_cache() -> Path:
    """The folder of cached digests, in the perception cache."""
    root = Path(os.environ.get("SU3D_CACHE") or "~/.cache/su3d-bench/cache").expanduser()
    return root / DIGEST_FOLDER


def _note(key: str, digest: str) -> dict[str, str]:
    """The cache entry of a digest, with a digest of the entry itself, so that a damaged one counts as absent."""
    return {"of": key, "sha256": digest, "check": digest_bytes(f"{key}\n{digest}".encode())}


def read_weights(path: Path, device: str = "cpu") -> dict[str, Any]:
    """The tensors of a ``.safetensors`` file, or of a torch file read with ``weights_only=True``.

    ``device`` ``meta`` reads only names, shapes and types. If a torch file has another level under ``model`` or
    ``state_dict``, that level is returned. Raises ``DataError`` for any other content.
    """
    if path.suffix == ".safetensors":
        content = _read_safetensors(path, device)
    elif path.suffix in PICKLED:
        content = _read_pickled(path, device)
    else:
        raise DataError(f"{path}: weights are read from .safetensors, .bin, .pt or .pth, not '{path.suffix}'")
    torch = require("torch", f"{path.name}:")
    for level in ("model", "state_dict"):
        inner = content.get(level) if isinstance(content, dict) else None
        if isinstance(inner, dict):
            content = inner
            break
    if not isinstance(content, dict) or not content or not all(isinstance(v, torch.Tensor) for v in content.values()):
        raise DataError(f"{path}: is not a dict of tensors; download the file again from its source")
    return {str(name): tensor for name, tensor in content.items()}


def _read_safetensors(path: Path, device: str) -> Any:
    safetensors, torch = (require(package, f"{path.name}:") for package in ("safetensors", "torch"))
    try:
        if device != "meta":
            return require("safetensors.torch", f"{path.name}:").load_file(str(regular(path)), device=device)
        with safetensors.safe_open(str(regular(path)), framework="pt") as file:
            return {name: torch.empty(file.get_slice(name).get_shape(), device="meta") for name in file.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise DataError(f"{path}: not readable as safetensors: {bounded(error)}; download it again") from error


def _read_pickled(path: Path, device: str) -> Any:
    torch = require("torch", f"{path.name}:")
    with converted(PredictionError, DataError):
        check_stored(path)
    try:
        return torch.load(regular(path), map_location=device, weights_only=True)
    except pickle.UnpicklingError as error:
        raise DataError(
            f"{path}: contains more than plain tensors and could run code; use the model's safetensors file"
        ) from error
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, AttributeError, IndexError, TypeError) as error:
        raise DataError(f"{path}: not readable as torch weights: {bounded(error)}; download it again") from error


def check_settings_size(path: Path) -> None:
    """Reject a file of settings or words that is far larger than any model's; a missing one is accepted."""
    if path.is_file() and path.stat().st_size > MAX_SETTINGS_BYTES:
        raise DataError(f"{path}: has {path.stat().st_size} bytes; settings have at most {MAX_SETTINGS_BYTES}")


def read_settings(path: Path) -> dict[str, Any]:
    """The table in a JSON file of a model's folder, of bounded size; raises ``DataError`` for anything else."""
    check_settings_size(path)
    try:
        content = json.loads(file_text(path))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); download it with the weights") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as JSON ({bounded(error, 80)}); download it again") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: contains a {type(content).__name__}, expected a table")
    return content


def checked(kind: type[Checked], values: Mapping[str, Any], where: object) -> Checked:
    """``values`` from a file as ``kind``; raises ``DataError`` with the first invalid one."""
    try:
        return TypeAdapter(kind).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(str(part) for part in fault["loc"])
        raise DataError(f"{where}: {place} is {bounded(str(fault['input']), 40)}: {fault['msg']}") from error


def bounded(error: object, limit: int = 160) -> str:
    """The message of ``error`` as one printable line of at most ``limit`` characters."""
    return printable(str(error), limit)


# A worker processes one scene after another; a segmenter, a detector and a tagger stay in memory.
MAX_KEPT = 3
_kept: OrderedDict[tuple[object, ...], object] = OrderedDict()


def kept(files: ModelFiles, place: tuple[str, ...], load: Callable[[], Loaded]) -> Loaded:
    """The result of ``load`` for ``files`` at ``place``, from memory if they are unchanged since the last call."""
    key = (files.entry.name, str(files.weights), files.state, *place)
    if key not in _kept:
        while len(_kept) >= MAX_KEPT:
            _kept.popitem(last=False)
        _kept[key] = load()
    _kept.move_to_end(key)
    return cast("Loaded", _kept[key])


def load_pretrained(files: ModelFiles, model_class: Any, **more: Any) -> Any:
    """A transformers model in float32 on the CPU from local files; missing weights are an error, never random.

    ``more`` is passed to ``from_pretrained``.
    """
    from safetensors import SafetensorError

    if files.weights.suffix in PICKLED:
        read_weights(files.weights, "meta")  # raises our own error for an invalid file
    try:
        model, info = model_class.from_pretrained(
            str(files.folder),
            local_files_only=True,
            use_safetensors=files.weights.suffix == ".safetensors",
            weights_only=True,
            dtype=require("torch", f"model '{files.entry.name}'").float32,
            output_loading_info=True,
            **more,
        )
    except (OSError, ValueError, RuntimeError, KeyError, ImportError, SafetensorError) as error:
        raise DataError(f"{files.weights}: cannot be loaded: {bounded(error)}; download the folder again") from error
    if missing := sorted(info["missing_keys"]):
        raise DataError(
            f"{files.weights}: lacks {len(missing)} tensors, such as {missing[0][:80]}; it is not "
            f"{files.entry.name}; {what_to_fetch(files.entry, (files.form,))}"
        )
    return model


def load_class(files: ModelFiles, class_name: str) -> Any:
    """The model of transformers' class ``class_name``; a ``DataError`` if the folder contains a different one."""
    transformers = require_transformers(f"model '{files.entry.name}'")
    model_class = getattr(transformers, class_name)
    model_type = read_settings(files.folder / "config.json").get("model_type")
    if model_type != model_class.config_class.model_type:
        wanted = model_class.config_class.model_type
        raise DataError(f"{files.folder}: model_type is {str(model_type)[:40]!r}; '{files.entry.name}' is {wanted!r}")
    return load_pretrained(files, model_class)


def on_device(model: Any, device: str, precision: str) -> Any:
    """``model`` in evaluation mode on ``device`` in ``precision``."""
    torch = require("torch", f"device '{device}'")
    make_deterministic(device)
    return model.eval().to(device=device, dtype=getattr(torch, precision))
