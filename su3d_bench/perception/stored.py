"""Precomputed detections: the profile ``stored`` and its format of one npz file per frame.

``<folder>/<dataset>.<scene>/frame000040.npz`` contains the K regions of the frame with index 40:

- ``image_size`` (2,) integers: height, width of the masks, which must be the frame's
- ``masks`` (K, ceil(height * width / 8)) uint8: ``numpy.packbits`` of each mask, row by row
- ``boxes`` (K, 4) numbers: x0 y0 x1 y1 in pixels, right and bottom exclusive. As with detectors, they may extend
  beyond the image by at most its own size; as with SAM, the box of a mask one pixel wide has no width
- ``scores`` (K,) numbers in 0..1;  ``names`` (K,) texts, none empty;  ``captions`` (K,) texts, optional
- optional, all four together: ``crop_ratios`` (R,), ``crop_features`` (K, R, D), ``global_feature`` (D,) and
  ``encoder`` (), the digest of the encoder that computed them, which must be the encoder of the run

Files are plain arrays; nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, model_validator

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.files.atomic import DAMAGE, read_arrays
from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Detections, Float32Array, Frame, PerceptionNeeds, Regions, SceneInfo
from su3d_bench.perception.cache import FrameCache, RegionsOnDemand, content_key
from su3d_bench.perception.detections import Assembler, captioned_by_colour
from su3d_bench.perception.embedded.lexicon import Namer

INDEX = "{index}"
MAX_REGIONS = 2_000  # per image; SAM returns a few hundred
MAX_MASK_BYTES = 512 << 20  # of all masks of an image, one byte per pixel: 400 of 1296x968, 1,700 of 640x480


def check_masks(n: int, shape: tuple[int, ...], where: str) -> None:
    """Reject more masks (H, W) than any image has before they are unpacked and use far more memory than their file."""
    if n > MAX_REGIONS or n * shape[0] * shape[1] > MAX_MASK_BYTES:
        raise DataError(f"{where}: has {n} regions of {shape[1]}x{shape[0]} pixels; expected one region per object")


class StoredConfig(BaseModel):
    """Where the detections of the profile ``stored`` are: npz files, unless one of the two patterns is set.

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
            raise ValueError("stored.names needs label images; set stored.images too")
        if self.images is not None and self.detections is not None:
            raise ValueError("stored.images and stored.detections are mutually exclusive; set one of them")
        return self


@dataclass(frozen=True)
class StoredFrame:
    """The named regions of a frame, and the features stored with them.

    ``features`` (K, D) by crop ratio; ``global_feature`` (D,) of the image. They are valid for the encoder ``made_by``
    and for crops with ``made_at_px`` pixels around the box; None: for any encoder or padding.
    """

    regions: Regions
    features: Mapping[float, Float32Array] = field(default_factory=dict)
    global_feature: Float32Array | None = None
    made_by: str | None = None
    made_at_px: int | None = None

    def features_for(self, needs: PerceptionNeeds, encoder: Encoder) -> Mapping[float, Float32Array]:
        """Those of ``features`` that are valid for ``encoder`` and ``needs``."""
        is_same = self.made_by in (None, encoder.name) and self.made_at_px in (None, needs.crop_padding_px)
        return {ratio: rows for ratio, rows in self.features.items() if is_same and rows.shape[1] == encoder.dim}


class StoredSource(Protocol):
    """The detections of a scene in the format ``name``; ``files`` are those that a run may read."""

    name: str

    @property
    def files(self) -> Sequence[Path]: ...

    def frame(self, frame: Frame) -> StoredFrame: ...


def _inside(folder: Path, name: str, where: str, key: str) -> Path:
    """``folder / name``; ``ConfigError`` if that is not a box in the folder."""
    path = folder / name
    is_plain = name.isprintable() and bool(name) and not name.startswith("/") and ".." not in PurePosixPath(name).parts
    try:
        if is_plain and path.resolve().is_relative_to(folder.resolve()):
            return path
    except (OSError, RuntimeError):  # a name too long for the file system, or links in a circle
        pass
    raise ConfigError(f"{where}: {key}: {name[:80]!r} is outside {folder}; use files inside it")


def numbered_files(
    folder: Path, pattern: str, scene: SceneInfo, where: str, what: str = "label image", key: str = "images"
) -> dict[int, Path]:
    """Frame number -> file; ``what`` describes such a file, ``key`` is the configuration key of ``pattern``."""
    key = f"perception.stored.{key}"
    filled = pattern.replace("{dataset}", scene.dataset).replace("{scene}", scene.scene)
    directory, _, name_pattern = filled.rpartition("/")
    if INDEX not in name_pattern or filled.count(INDEX) > 1 or "{" in filled.replace(INDEX, ""):
        raise ConfigError(
            f"{key} = {pattern[:80]!r}: expected one {{index}} in the file's name, such as 'frame{{index}}.png', and "
            "no other braces except {dataset} and {scene}"
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
                        f"{where}: {files[number].name} and {path.name} belong to the same frame; expected one file"
                    )
                files[number] = _inside(folder, path.relative_to(folder).as_posix(), where, key)
    except OSError as error:
        raise DataError(f"{where}: {parent}: cannot be read: {error.strerror}; it should contain {what}s") from error
    if not files:
        raise DataError(f"{where}: no {what} in {parent} matches {pattern!r}")
    return dict(sorted(files.items()))


_REQUIRED = ("image_size", "masks", "boxes", "scores", "names")
_FEATURES = ("crop_ratios", "crop_features", "global_feature", "encoder")
_OPTIONAL = ("captions", *_FEATURES)


def stored_path(folder: Path, dataset: str, scene: str, frame_index: int) -> Path:
    """The file with the detections of a frame."""
    return folder / f"{dataset}.{scene}" / f"frame{frame_index:06d}.npz"


class NpzFiles:
    """The files of a scene, whose features must be of the run's ``encoder``."""

    name = "npz"

    def __init__(self, folder: Path, scene: SceneInfo, encoder: Encoder) -> None:
        self._folder = folder
        self._scene = scene
        self._encoder = encoder
        self.files = tuple(sorted((folder / f"{scene.dataset}.{scene.scene}").glob("*.npz")))

    def frame(self, frame: Frame) -> StoredFrame:
        """The detections of ``frame``; raises ``DataError``."""
        path = stored_path(self._folder, self._scene.dataset, self._scene.scene, frame.index)
        return read_stored(path, frame, self._encoder)


def read_stored(path: Path, frame: Frame, encoder: Encoder) -> StoredFrame:
    """The detections in ``path``, checked against ``frame`` and the run's ``encoder``; raises ``DataError``."""
    where = f"stored detections of frame {frame.index}"
    arrays = _load(path, where)
    _check_keys(arrays, where)
    n = _check_rows(arrays, where)
    regions = Regions(
        masks=_masks(arrays, frame, n, where),
        boxes=_boxes(arrays, frame, where),
        scores=_scores(arrays, where),
        names=_texts(arrays, "names", where),
        captions=_texts(arrays, "captions", where) if "captions" in arrays else None,
    )
    return StoredFrame(regions, *_features(arrays, encoder, n, where))


def _load(path: Path, where: str) -> dict[str, NDArray[Any]]:
    try:
        return read_arrays(path)
    except FileNotFoundError:
        raise DataError(f"{where}: missing file {path}; a frame without detections needs a file with 0 rows") from None
    except DAMAGE as error:
        raise DataError(f"{where}: {path} is not an npz file of plain arrays ({error})") from error


def _check_keys(arrays: Mapping[str, NDArray[Any]], where: str) -> None:
    n_features = len(set(_FEATURES) & set(arrays))
    if not {*_REQUIRED} <= set(arrays) <= {*_REQUIRED, *_OPTIONAL} or n_features not in (0, len(_FEATURES)):
        raise DataError(
            f"{where}: has {', '.join(arrays)}; expected {', '.join(_REQUIRED)}, optional captions, all or none of "
            f"{', '.join(_FEATURES)}"
        )


def _check_rows(arrays: Mapping[str, NDArray[Any]], where: str) -> int:
    shapes = {"masks": 2, "boxes": 2, "scores": 1, "names": 1, "captions": 1}
    n = len(arrays["scores"]) if arrays["scores"].ndim else -1
    for key, n_axes in shapes.items():
        if key in arrays and (arrays[key].ndim != n_axes or len(arrays[key]) != n):
            raise DataError(f"{where}: '{key}' has shape {arrays[key].shape}; expected {n_axes} axes and {n} rows")
    for key in ("masks", "boxes", "scores", "image_size"):
        if arrays[key].dtype.kind not in "biuf":
            raise DataError(f"{where}: '{key}' has type {arrays[key].dtype}; expected numbers")
    return n


def _masks(arrays: Mapping[str, NDArray[Any]], frame: Frame, n: int, where: str) -> NDArray[np.bool_]:
    size, height, width = arrays["image_size"], *frame.depth_m.shape
    if size.shape != (2,) or (int(size[0]), int(size[1])) != (height, width):
        raise DataError(f"{where}: image_size is {size.tolist()}, the frame has height {height} and width {width}")
    check_masks(n, (height, width), where)
    packed, n_bytes = arrays["masks"], -(-height * width // 8)
    if packed.dtype != np.uint8 or packed.shape[1] != n_bytes:
        raise DataError(f"{where}: 'masks' is {packed.shape} {packed.dtype}; expected ({n}, {n_bytes}) uint8")
    masks = np.unpackbits(packed, axis=1, count=height * width).view(bool).reshape(n, height, width)
    empty = np.flatnonzero(~masks.any(axis=(1, 2)))
    if len(empty):
        raise DataError(f"{where}, region {int(empty[0])}: the mask is empty; remove the region")
    return masks


def _boxes(arrays: Mapping[str, NDArray[Any]], frame: Frame, where: str) -> Float32Array:
    boxes = arrays["boxes"].astype(np.float32)
    if boxes.shape[1] != 4:
        raise DataError(f"{where}: 'boxes' has shape {boxes.shape}; expected four columns x0 y0 x1 y1")
    height, width = frame.depth_m.shape
    x0, y0, x1, y1 = boxes.T
    is_near = (x0 >= -width) & (y0 >= -height) & (x1 <= 2 * width) & (y1 <= 2 * height)
    is_seen = (x0 < width) & (y0 < height) & (x1 >= 0) & (y1 >= 0)
    bad = ~(is_near & is_seen & (x0 <= x1) & (y0 <= y1))
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise DataError(f"{where}, region {k}: box {boxes[k].tolist()} is not a box in the {width}x{height} image")
    return boxes


def _scores(arrays: Mapping[str, NDArray[Any]], where: str) -> Float32Array:
    scores = arrays["scores"].astype(np.float32)
    bad = np.flatnonzero(~((scores >= 0) & (scores <= 1)))
    if len(bad):
        raise DataError(f"{where}, region {int(bad[0])}: score {float(scores[bad[0]])} is not in 0..1")
    return scores


def _texts(arrays: Mapping[str, NDArray[Any]], key: str, where: str) -> tuple[str, ...]:
    values = arrays[key]
    if values.dtype.kind != "U" and len(values):
        raise DataError(f"{where}: '{key}' has type {values.dtype}; expected texts (numpy type U)")
    texts = tuple(str(value) for value in values)
    for k, text in enumerate(texts):
        if not text.strip():
            raise DataError(f"{where}, region {k}: '{key}' is an empty text")
    return texts


def _features(
    arrays: Mapping[str, NDArray[Any]], encoder: Encoder, n: int, where: str
) -> tuple[dict[float, Float32Array], Float32Array | None]:
    """Features (K, D) of crops by ratio, and the feature of the image."""
    if "encoder" not in arrays:
        return {}, None
    made_by = str(arrays["encoder"])
    if made_by != encoder.digest:
        raise DataError(
            f"{where}: features were made by encoder {made_by[:12]}, the run uses {encoder.name} "
            f"{encoder.digest[:12]}; remove the features to recompute them"
        )
    ratios, crops, whole = (arrays[key] for key in ("crop_ratios", "crop_features", "global_feature"))
    expected = (n, ratios.size, encoder.dim)
    if ratios.ndim != 1 or crops.shape != expected or whole.shape != (encoder.dim,):
        raise DataError(
            f"{where}: crop_features {crops.shape} and global_feature {whole.shape}; expected {expected} and "
            f"({encoder.dim},)"
        )
    rows = np.concatenate([crops.reshape(-1, encoder.dim), whole[None]]).astype(np.float64)
    lengths = np.linalg.norm(rows, axis=1)
    if not (np.abs(lengths - 1) < 1e-3).all():
        worst = lengths[np.argmax(np.abs(lengths - 1))]
        raise DataError(f"{where}: crop_features or global_feature has a row of length {worst:.4g}, not 1")
    of_ratio = {float(ratio): crops[:, column].astype(np.float32) for column, ratio in enumerate(ratios)}
    return of_ratio, whole.astype(np.float32)


STORED_CAVEAT = "stored perception: masks and names are precomputed and used unchanged"


class StoredPerception:
    """Detections from files; features missing in the files are computed.

    With a ``namer``, regions without a name get a name and confidence from it, and captions include the colour.
    """

    profile = "stored"
    caveat: str | None = STORED_CAVEAT

    def __init__(self, source: StoredSource, encoder: Encoder, cache: FrameCache, namer: Namer | None = None) -> None:
        self.encoder = encoder
        self._source = source
        self._namer = namer
        self._assembler = Assembler(encoder, cache, "published" if namer is None else "own")
        names = "" if namer is None else namer.digest
        self.digest = content_key(self.profile, source.name, content_digest(source.files), names, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("cache"):
            stored = self._source.frame(frame)
        if self._namer is not None:
            regions, known = self._assembler.named(frame, stored.regions, self._namer, needs, timer)
            return self._assembler.assemble(frame, regions, needs, timer, describe=captioned_by_colour, known=known)
        known = stored.features_for(needs, self.encoder)
        whole = stored.global_feature
        return self._assembler.assemble(frame, stored.regions, needs, timer, known=known, global_feature=whole)

    def regions(self) -> RegionPerception:
        """Perception on demand over the masks from the files; the score is the share of the points in the mask."""
        return RegionsOnDemand(self._regions_of, self.encoder)

    def _regions_of(self, frame: Frame) -> Regions:
        regions = self._source.frame(frame).regions
        return replace(regions, scores=np.ones(len(regions.masks), np.float32))


def content_digest(files: Iterable[Path]) -> str:
    """A digest of the names and contents of ``files``, in their order."""
    hasher = hashlib.sha256()
    for path in files:
        hasher.update(path.name.encode() + b"\0" + hashlib.sha256(file_bytes(path)).digest())
    return hasher.hexdigest()
