"""GroundedSAM: tags of the image, boxes of the tagged objects, masks in the boxes; and SAM without tags.

Tags come from RAM++, or are the words of a list that are most likely according to an encoder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Int64Array, Regions, UInt8Array
from su3d_bench.perception.cache import CropsOnDemand, LastFrameCache, content_key, mask_boxes
from su3d_bench.perception.embedded.lexicon import PromptedWords, listed_words, vocabulary
from su3d_bench.perception.models.catalogue import ONNX_MANIFEST
from su3d_bench.perception.models.encoders.images import Resample, normalised, resized
from su3d_bench.perception.models.files import (
    ModelFiles,
    checked,
    file_sha256,
    read_settings,
)
from su3d_bench.perception.models.masks.automatic_masks import AutomaticMaskConfig, AutomaticMasks
from su3d_bench.perception.models.masks.grounding_dino import CONCEPTGRAPHS_BOXES, BoxConfig, GroundingDino
from su3d_bench.perception.models.masks.sam import Sam

RAM_PX = 384
RAM_MODEL, RAM_TAG_LIST = "ram_plus.onnx", "ram_tag_list.txt"
RAM_FORMAT = "su3d-bench onnx tagger 1"  # of the manifest
WORDS_CAVEAT = "tags: RAM++ is not installed; using the most probable words of a list by the encoder instead"
MAX_WORDS, MAX_WORD_LENGTH = 20_000, 100
MAX_LIST_BYTES = 1 << 21
# Words of taggers that name no object, as listed by ConceptGraphs (generate_gsa_results.py, 5c4da70): a tag that
# contains one of these is dropped.
STOP_WORDS = (
    "room", "kitchen", "office", "house", "home", "building", "corner", "shadow", "carpet", "photo", "shade", "stall",
    "space", "aquarium", "apartment", "image", "city", "blue", "skylight", "hallway", "bureau", "modern", "salon",
    "doorway", "wall lamp", "wood floor",
)  # fmt: skip
# Added to the tags of every image.
ADDED_TAGS = ("other item",)
# Added with --add_bg_classes.
BACKGROUND_TAGS = ("wall", "floor", "ceiling")


class Tagger(Protocol):
    """Words for what an image shows; ``caveat`` is a note to be shown with them.

    ``resample``: the filter of a tagger that downscales the whole image.
    """

    name: str
    digest: str
    caveat: str | None

    def tags(self, rgb: UInt8Array, resample: Resample = "bilinear") -> tuple[str, ...]: ...


class OnnxRamTagger:
    """Exported RAM++: ``image`` (1, 3, 384, 384) to its first output ``tag`` (1, T), 1 for present tags.

    As written by ``tools/export_onnx.py`` and by the script of recognize-anything's pull request 204.
    """

    name = "ram-onnx"
    caveat: str | None = None

    def __init__(self, load: Callable[[], Any], tag_list: Sequence[str], digest: str) -> None:
        self._session = cache(load)
        self._tag_list = tuple(tag_list)
        self.digest = content_key("ram-onnx", digest, *self._tag_list)

    def tags(self, rgb: UInt8Array, resample: Resample = "bilinear") -> tuple[str, ...]:
        """The tags of ``rgb`` (H, W, 3) in the order of the list."""
        session = self._session()
        is_there = session.run(None, {session.get_inputs()[0].name: ram_pixels(rgb, resample)[None]})[0]
        if is_there.shape != (1, len(self._tag_list)):
            raise DataError(
                f"tagger 'ram-onnx': the model returns {is_there.shape}, but {RAM_TAG_LIST} has {len(self._tag_list)} "
                "tags; both must come from the same version of the package"
            )
        return tuple(self._tag_list[index] for index in np.flatnonzero(is_there[0] > 0.5))


def exported_files(manifest: Path) -> dict[str, str]:
    """SHA-256 by file name, from the manifest of an exported RAM++; raises ``DataError`` for anything else."""
    content = read_settings(manifest)
    if (layout := content.get("format")) != RAM_FORMAT:
        raise DataError(f"{manifest}: format is {str(layout)[:60]!r}; expected {RAM_FORMAT!r}; export it again")
    files = checked(dict[str, str], content.get("files") or {}, f"{manifest}: files")
    if any(Path(name).name != name for name in files) or not {RAM_MODEL, RAM_TAG_LIST} <= set(files):
        needed = f"{RAM_MODEL} and {RAM_TAG_LIST}"
        raise DataError(f"{manifest}: files must be names inside the folder, including {needed}; export it again")
    return files


def wrong_tagger(files: ModelFiles) -> list[str]:
    """One line per file of an exported RAM++ that is missing or differs from the exported one; an export without a
    manifest cannot be checked."""
    path = files.folder / ONNX_MANIFEST
    wrong = []
    for name, digest in exported_files(path).items() if is_file(path) else ():
        if not (place := files.folder / name).is_file():
            wrong.append(f"{place}: is missing; export it again")
        elif file_sha256(place) != digest:
            wrong.append(f"{place}: does not match the manifest; export it again")
    return wrong


class WordTagger:
    """The ``n_tags`` words of a list that are most likely in the image, in decreasing order.

    The score of a word is its similarity in the best of six views: the image, its quarters, and its middle.
    """

    name = "words"
    caveat: str | None = WORDS_CAVEAT

    def __init__(self, encoder: Encoder, words: Sequence[str], n_tags: int, prompt: str = "{} in a scene") -> None:
        self._encoder = encoder
        self._words = PromptedWords(encoder, words, prompt)
        self._n_tags = n_tags
        self.digest = content_key("words", encoder.digest, str(n_tags), prompt, *self._words.words)

    def tags(self, rgb: UInt8Array, resample: Resample = "bilinear") -> tuple[str, ...]:
        """At most ``n_tags`` words for ``rgb`` (H, W, 3); the encoder preprocesses each view itself."""
        similarity = self._words.similarity(self._encoder.encode_images(_views(rgb)))
        order = np.argsort(-similarity.max(axis=0), kind="stable")
        return tuple(self._words.words[index] for index in order[: self._n_tags])


def _views(rgb: UInt8Array) -> list[UInt8Array]:
    height, width = rgb.shape[:2]
    half_height, half_width = max(height // 2, 1), max(width // 2, 1)
    below, beside = height - half_height, width - half_width
    corners = ((0, 0), (0, beside), (below, 0), (below, beside), (below // 2, beside // 2))
    parts = [np.ascontiguousarray(rgb[top : top + half_height, left : left + half_width]) for top, left in corners]
    return [rgb, *parts]


def ram_pixels(rgb: UInt8Array, resample: Resample = "bilinear") -> Float32Array:
    """``rgb`` (H, W, 3) as input for RAM++, (3, 384, 384): resized to a square regardless of the aspect ratio.

    Its own transform is bilinear (recognize-anything 7cb804a, ram/transform.py).
    """
    return normalised(resized(rgb, RAM_PX, RAM_PX, resample))


def chosen_tags(tags: Iterable[str], stop_words: Sequence[str], added: Sequence[str]) -> tuple[str, ...]:
    """Distinct ``tags`` and ``added``, without those that contain a stop word; ConceptGraphs' order of steps.

    >>> chosen_tags(["bed", "bedroom", "lamp"], ["room"], ["other item"])
    ('bed', 'lamp', 'other item')
    """
    named = dict.fromkeys([*(tag.strip() for tag in tags if tag.strip()), *added])
    return tuple(tag for tag in named if not any(word in tag.lower() for word in stop_words))


def read_word_list(path: Path | None) -> tuple[str, ...]:
    """The words of a text file, one per line, ignoring empty lines and those that begin with #; None: our own list."""
    if path is None:
        return vocabulary()
    try:
        if path.stat().st_size > MAX_LIST_BYTES:
            raise DataError(f"{path}: has {path.stat().st_size} bytes; expected a list of words, one per line")
        words = listed_words(file_text(path))
    except OSError as error:
        raise DataError(f"{path}: cannot read the list of words ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is not UTF-8 text; expected a list of words, one per line") from error
    if not 1 <= len(words) <= MAX_WORDS:
        raise DataError(f"{path}: has {len(words)} words; expected 1 to {MAX_WORDS}")
    for word in words:
        if len(word) > MAX_WORD_LENGTH or not word.isprintable():
            raise DataError(f"{path}: {word[:40]!r} is not a word; expected short printable texts")
    return words


# ---- named regions

# Part of the digest: increment it when the code between the networks changes.
FRONT_END_VERSION = "2"
# ConceptGraphs' name for regions without one; a method that needs better names requests grounded masks.
UNNAMED = "item"


class GroundedConfig(BaseModel):
    """Settings of named regions; the defaults are OpenSU3D's.

    ``masks``: SAM's best of three in each box by predicted IoU, or its single mask, as in the Grounded-SAM
    demonstrations. ``region_boxes``: the mask's, or the detector's, which may extend beyond the image. Tags that
    contain one of ``stop_words`` are dropped, ``added_tags`` are added for every image. ``ram_resample``: the filter
    for downscaling RAM++'s input; its own package uses bilinear.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    boxes: BoxConfig = BoxConfig()
    stop_words: tuple[str, ...] = ()
    added_tags: tuple[str, ...] = ()
    masks: Literal["best-of-three", "single"] = "best-of-three"
    region_boxes: Literal["mask", "detector"] = "mask"
    ram_resample: Resample = "bilinear"


# generate_gsa_results.py --class_set ram --add_bg_classes (5c4da70); its --accumu_classes carries tags over from frame
# to frame in an order that changes from run to run, and is not used. Its input for RAM is Pillow's resize, whose
# default is bicubic. The tagger is the run's: its README names RAM (ram_swin_large_14m.pth), not RAM++.
_CONCEPTGRAPHS = GroundedConfig(
    boxes=CONCEPTGRAPHS_BOXES,
    stop_words=STOP_WORDS,
    added_tags=(*ADDED_TAGS, *BACKGROUND_TAGS),
    region_boxes="detector",
    ram_resample="bicubic",
)
# Values of PerceptionNeeds.grounding; "paper" is configured.
GROUNDED_MASKS: Mapping[str, GroundedConfig] = MappingProxyType(
    {
        "conceptgraphs": _CONCEPTGRAPHS,
        "conceptgraphs-whole-tags": _CONCEPTGRAPHS.model_copy(
            update={"boxes": CONCEPTGRAPHS_BOXES.model_copy(update={"names": "tag"})}
        ),
    }
)


@dataclass(frozen=True)
class Networks:
    """The networks of the segmenters, read from disk at first use; ``digest`` covers weights and precision."""

    tagger: Tagger
    load_detector: Callable[[], GroundingDino]
    load_sam: Callable[[], Sam]
    digest: str


class GroundedSam:
    """``Segmenter`` of named regions."""

    name = "grounded-sam"

    def __init__(self, networks: Networks, config: GroundedConfig) -> None:
        self._networks = networks
        self._config = config
        settings = config.model_dump_json()
        self.digest = content_key(self.name, FRONT_END_VERSION, settings, networks.tagger.digest, networks.digest)

    def segment(self, frame: Frame) -> Regions:
        """Named regions, the detector's best first; empty if no tag is found."""
        config = self._config
        found = self._networks.tagger.tags(frame.rgb, config.ram_resample)
        tags = chosen_tags(found, config.stop_words, config.added_tags)
        named = self._networks.load_detector().detect(frame.rgb, tags, config.boxes)
        height, width = frame.rgb.shape[:2]
        if not len(named.names):
            return Regions(np.zeros((0, height, width), bool), named.boxes, named.scores, ())
        sam = self._networks.load_sam()
        image = sam.look(frame.rgb)
        masks, _ = sam.from_boxes(image, named.boxes, is_single=config.masks == "single")
        kept = np.flatnonzero(masks.any(axis=(1, 2)))
        masks, named = masks[kept], named.at(kept)
        boxes = mask_boxes(masks) if config.region_boxes == "mask" else named.boxes
        return Regions(masks, boxes, named.scores, named.names)


class SamRegions(CropsOnDemand):
    """``RegionPerception``: one mask at points chosen by a method; SAM embeds each frame once."""

    def __init__(self, networks: Networks, encoder: Encoder) -> None:
        super().__init__(encoder)
        self._networks = networks
        self._seen = LastFrameCache(lambda frame: networks.load_sam().look(frame.rgb))

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """SAM's single mask (H, W) of the object at all ``points`` and its predicted IoU; empty and 0 for no points."""
        if not len(points):
            return np.zeros(frame.depth_m.shape, np.bool_), 0.0
        return self._networks.load_sam().from_points(self._seen(frame), points.astype(np.float32))


class AutomaticSam:
    """``Segmenter`` of every region, without names."""

    name = "sam-automatic"

    def __init__(self, networks: Networks, config: AutomaticMaskConfig) -> None:
        self._networks = networks
        self._config = config
        self.digest = content_key(self.name, FRONT_END_VERSION, config.model_dump_json(), networks.digest)

    def segment(self, frame: Frame) -> Regions:
        """The regions that SAM finds without prompts, each named "item"."""
        regions = AutomaticMasks(self._networks.load_sam(), self._config).regions(frame.rgb)
        return Regions(regions.masks, regions.boxes, regions.scores, (UNNAMED,) * len(regions.scores))
