"""``manifest.json`` of a model exported to ONNX: which files it has, what they were made from, how far they agree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import write_json
from su3d_bench.perception.models.catalogue import ONNX_MANIFEST
from su3d_bench.perception.models.files import ModelFiles, bounded, file_sha256, read_settings
from su3d_bench.perception.models.onnx.export import OPSET, Parity


class OnnxManifest(BaseModel):
    """What every manifest says: ``files`` name -> SHA-256, ``source`` what the export was made from.

    Of each kind: ``FORMAT`` of its file, what it ``IS_OF``, and the files that it ``REQUIRES``.
    """

    model_config = ConfigDict(strict=True, frozen=True)
    FORMAT: ClassVar[str]
    IS_OF: ClassVar[str]
    REQUIRES: ClassVar[tuple[str, ...]]

    name: str
    files: dict[str, str]
    source: dict[str, Any]
    opset: int
    parity: tuple[Parity, ...]

    @classmethod
    def of_export(
        cls, files: ModelFiles, written: Sequence[Path], parity: Sequence[Parity], torch_version: str, **own: Any
    ) -> Self:
        """The manifest of the files ``written`` from ``files``, put beside them, with the fields of its kind."""
        manifest = cls(
            name=files.entry.name,
            files={path.name: digest_file(path) for path in written},
            source={"form": files.form.form, "files": files.digests(), "torch": torch_version},
            opset=OPSET,
            parity=tuple(parity),
            **own,
        )
        write_json(written[0].parent / ONNX_MANIFEST, {"format": cls.FORMAT, **manifest.model_dump(mode="json")})
        return manifest

    @classmethod
    def read(cls, path: Path) -> Self:
        """The manifest at ``path``; raises ``DataError`` for anything else, and where a required file is not named."""
        content = read_settings(path)
        layout = content.get("format")
        if layout != cls.FORMAT:
            raise DataError(f"{path}: format is {str(layout)[:60]!r}; expected {cls.FORMAT!r}; export it anew")
        try:
            manifest = cls.model_validate_json(json.dumps(content))
        except ValidationError as error:
            raise DataError(f"{path}: is no manifest of {cls.IS_OF} ({bounded(error, 80)}); export it anew") from error
        if any(Path(name).name != name for name in manifest.files) or not {*cls.REQUIRES} <= set(manifest.files):
            needed = " and ".join(cls.REQUIRES)
            raise DataError(f"{path}: files must be names inside the folder, {needed} among them; export it anew")
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
