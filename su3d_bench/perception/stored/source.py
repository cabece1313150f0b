"""Where stored detections come from: their configuration, the files of a scene, and what one file says of a frame."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Protocol

from pydantic import BaseModel, ConfigDict, model_validator

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import Float32Array, Frame, PerceptionNeeds, Regions, SceneInfo

INDEX = "{index}"
MOST_REGIONS = 2_000  # of one image; SAM gives some hundred
MOST_MASK_BYTES = 512 << 20  # of all masks of an image, a byte a pixel: 400 of 1296x968, 1,700 of 640x480


def check_masks(n: int, shape: tuple[int, ...], where: str) -> None:
    """Refuses more masks (H, W) than any image has, which take far more memory than their file, before they do."""
    if n > MOST_REGIONS or n * shape[0] * shape[1] > MOST_MASK_BYTES:
        raise DataError(f"{where}: has {n} regions of {shape[1]}x{shape[0]} pixels; expected one a thing in the image")


class StoredConfig(BaseModel):
    """Where the detections of the profile ``stored`` lie: npz files, unless one of the two patterns is set.

    ``images`` (``frame-{index}.segm.png``) names label images, ``detections``
    (``{scene}/gsa_detections_none/frame{index}.pkl.gz``) ConceptGraphs' files, both relative to ``folder``; ``names``
    is a TOML or JSON file of names for the values of label images.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    folder: Path | None = None
    images: str | None = None
    detections: str | None = None
    names: Path | None = None

    @model_validator(mode="after")
    def _names_are_of_images(self) -> StoredConfig:
        if self.names is not None and self.images is None:
            raise ValueError("names are given to the values of label images; set stored.images too")
        if self.images is not None and self.detections is not None:
            raise ValueError("stored.images and stored.detections name two makers of masks; set one of them")
        return self


@dataclass(frozen=True)
class StoredFrame:
    """The named regions of a frame, and the features that came with them.

    ``features`` (K, D) by crop ratio; ``global_feature`` (D,) of the image. They count for the encoder called
    ``made_by`` and for crops with ``made_at_px`` around the box; None: for whatever the run asks.
    """

    regions: Regions
    features: Mapping[float, Float32Array] = field(default_factory=dict)
    global_feature: Float32Array | None = None
    made_by: str | None = None
    made_at_px: int | None = None

    def features_for(self, needs: PerceptionNeeds, encoder: Encoder) -> Mapping[float, Float32Array]:
        """Those of ``features`` that ``needs`` would have ``encoder`` make."""
        is_same = self.made_by in (None, encoder.name) and self.made_at_px in (None, needs.crop_padding_px)
        return {ratio: rows for ratio, rows in self.features.items() if is_same and rows.shape[1] == encoder.dim}


class StoredSource(Protocol):
    """The detections of a scene in one format, called ``name``; ``files`` are those that a run may read."""

    name: str

    @property
    def files(self) -> Sequence[Path]: ...

    def frame(self, frame: Frame) -> StoredFrame: ...


def _inside(folder: Path, name: str, where: str, key: str) -> Path:
    """``folder / name``, unless that leads out of the folder."""
    path = folder / name
    is_plain = name.isprintable() and bool(name) and not name.startswith("/") and ".." not in PurePosixPath(name).parts
    try:
        if is_plain and path.resolve().is_relative_to(folder.resolve()):
            return path
    except (OSError, RuntimeError):  # a name too long for the file system, or links in a circle
        pass
    raise ConfigError(f"{where}: {key}: {name[:80]!r} leads out of {folder}; name files inside it")


def numbered_files(
    folder: Path, pattern: str, scene: SceneInfo, where: str, what: str = "label image", key: str = "images"
) -> dict[int, Path]:
    """Frame number -> file; ``what`` such a file is, and the ``key`` of the configuration that holds ``pattern``."""
    key = f"perception.stored.{key}"
    filled = pattern.replace("{dataset}", scene.dataset).replace("{scene}", scene.scene)
    directory, _, name_pattern = filled.rpartition("/")
    if INDEX not in name_pattern or filled.count(INDEX) > 1 or "{" in filled.replace(INDEX, ""):
        raise ConfigError(
            f"{key} = {pattern[:80]!r}: expected one {{index}} in the file's name, such as 'frame{{index}}.png', and "
            "no other braces but {dataset} and {scene}"
        )
    parent = _inside(folder, directory or ".", where, key)
    before, _, behind = name_pattern.partition(INDEX)
    form = re.compile(re.escape(before) + r"(\d{1,18})" + re.escape(behind), re.ASCII)
    files: dict[int, Path] = {}
    try:
        for path in sorted(parent.iterdir()):
            if match := form.fullmatch(path.name):
                number = int(match[1])
                if number in files:
                    raise DataError(
                        f"{where}: {files[number].name} and {path.name} are of one frame; expected one file"
                    )
                files[number] = _inside(folder, path.relative_to(folder).as_posix(), where, key)
    except OSError as error:
        raise DataError(f"{where}: {parent}: cannot be read: {error.strerror}; it should hold {what}s") from error
    if not files:
        raise DataError(f"{where}: no {what} in {parent} matches {pattern!r}")
    return dict(sorted(files.items()))
