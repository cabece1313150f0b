"""``manifest.json`` of a model exported to ONNX: which files it has, what they were made from, how far they agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError
from su3d_bench.perception.models.files import ModelFiles, bounded, file_sha256, read_settings
from su3d_bench.perception.models.onnx.export import OPSET, Parity


@dataclass(frozen=True)
class OnnxManifest:
    """What every manifest says: ``files`` name -> SHA-256, ``source`` what the export was made from."""

    name: str
    files: Mapping[str, str]
    source: Mapping[str, Any]
    opset: int
    parity: tuple[Parity, ...]


M = TypeVar("M", bound=OnnxManifest)


def described(files: ModelFiles, written: Sequence[Path], parity: Sequence[Parity], torch_version: str) -> OnnxManifest:
    """The manifest of the files ``written`` from ``files``."""
    return OnnxManifest(
        name=files.entry.name,
        files={path.name: digest_file(path) for path in written},
        source={"form": files.form.form, "files": files.digests(), "torch": torch_version},
        opset=OPSET,
        parity=tuple(parity),
    )


def common_fields(manifest: OnnxManifest) -> dict[str, Any]:
    """What every manifest says, as the JSON holds it."""
    return {
        "name": manifest.name,
        "files": dict(manifest.files),
        "source": dict(manifest.source),
        "opset": manifest.opset,
        "parity": [asdict(one) for one in manifest.parity],
    }


def read_common(
    path: Path, layout: str, required: Sequence[str], what: str, own: Callable[[OnnxManifest, Mapping[str, Any]], M]
) -> M:
    """The manifest at ``path``, of ``what`` in the format ``layout``; ``own`` adds the fields of its kind.

    Raises ``DataError`` for anything else, and where a file of ``required`` is not among its files.
    """
    content = read_settings(path)
    if content.get("format") != layout:
        raise DataError(f"{path}: format is {str(content.get('format'))[:60]!r}; expected {layout!r}; export it anew")
    try:
        known = OnnxManifest(
            name=str(content["name"]),
            files={str(name): str(digest) for name, digest in content["files"].items()},
            source=content["source"],
            opset=int(content["opset"]),
            parity=tuple(Parity(**one) for one in content["parity"]),
        )
        manifest = own(known, content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{path}: is no manifest of {what} ({bounded(error, 80)}); export it anew") from error
    if any(Path(name).name != name for name in known.files) or not {*required} <= set(known.files):
        raise DataError(
            f"{path}: files must be names inside the folder, {' and '.join(required)} among them; export it anew"
        )
    return manifest


def wrong_files(manifest: OnnxManifest, folder: Path) -> list[str]:
    """A line for each file of the exported model in ``folder`` that is missing or not the one that was written."""
    wrong = []
    for name, digest in manifest.files.items():
        path = folder / name
        if not path.is_file():
            wrong.append(f"{path}: is missing; export it anew")
        elif file_sha256(path) != digest:
            wrong.append(f"{path}: is not the file that the manifest describes; export it anew")
    return wrong
