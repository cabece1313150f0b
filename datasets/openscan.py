"""OpenScan's attributes: one attribute per aspect (of eight) for each object of a scan or class of the rooms.

``openscan_val_raw.json`` is a list of records with ``scene_id``, ``object_id`` (ScanNet's) and one or two words for
each aspect. The list of an aspect maps words to classes: its sentences contain the words ("This term is used for
sit"). Source: README.md and Evaluation/MaskClustering/preprocess/scannet/prepare_gt.py of YoujunZhao/OpenScan at
0df39dd.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import FailFast, Field

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.types import LabelSet
from su3d_bench.formats.json_models import FileModel, WholeNumber, read_json

# Protocol name (also of its label space and ground truth) -> name of the aspect in the records.
KEYS = {
    "openscan-affordance": "affordance",
    "openscan-property": "property",
    "openscan-type": "type",
    "openscan-manner": "manner",
    "openscan-synonym": "synonyms",
    "openscan-requirement": "requirement",
    "openscan-element": "element",
    "openscan-material": "material",
}
EXTRA_GROUND_TRUTHS: Mapping[str, str] = {name: name for name in KEYS}  # label space -> ground truth
RAW_NAME = "openscan_val_raw.json"
PAGE = "https://github.com/YoujunZhao/OpenScan"
MAX_RECORDS = 1_000_000  # the validation set has 10,388
MAX_CHARACTERS = 200
SPELLING_VARIANTS = {"\u00a0hang clothes": "hang clothes (34)"}  # the lists use a different kind of space
WITHOUT = frozenset(("", "none", "other"))  # values for "no attribute"

Attributes = Mapping[int, Mapping[str, str]]  # object id -> aspect's key -> word


@cache
def label_set(variant: str) -> LabelSet:
    """The attributes of an aspect, as listed by its protocol."""
    from su3d_bench.metrics.protocols.loading import load_protocol  # slow to import

    classes = load_protocol(variant).classes
    return LabelSet(variant, tuple(entry.id for entry in classes), tuple(entry.name for entry in classes))


@cache
def attribute_id(variant: str, words: str) -> int | None:
    """The id of the attribute whose sentence ends with ``words``; None if there is none.

    If several sentences match, the shortest counts: a container is not a garbage container.

    >>> attribute_id("openscan-affordance", "sit"), attribute_id("openscan-type", "container")
    (4, 22)
    """
    words = words.replace("_", " ")
    words = SPELLING_VARIANTS.get(words, words)
    found = [
        (len(name), class_id)
        for class_id, name in zip(label_set(variant).ids, label_set(variant).names, strict=True)
        if name == words or name.endswith(f" {words}") or name.startswith(f"{words} ")
    ]
    return min(found)[1] if found else None


Words = Annotated[str, Field(max_length=MAX_CHARACTERS)]


class Record(FileModel):
    """The attribute words of an object; aspects may be missing."""

    scene_id: Annotated[Words, Field(min_length=1)]
    object_id: WholeNumber
    affordance: Words | None = None
    property: Words | None = None
    type: Words | None = None
    manner: Words | None = None
    synonyms: Words | None = None
    requirement: Words | None = None
    element: Words | None = None
    material: Words | None = None


Records = Annotated[list[Record], Field(min_length=1, max_length=MAX_RECORDS), FailFast()]


def read_attributes(path: Path) -> Mapping[str, Attributes]:
    """The words of every object of each scan, by object id; a ``DataError`` if the file is damaged."""
    where = f"openscan: {path.name}"
    scenes: dict[str, dict[int, Mapping[str, str]]] = {}
    for number, record in enumerate(read_json(path, where, Records, f"download it again, see {PAGE}"), 1):
        objects = scenes.setdefault(record.scene_id, {})
        if record.object_id in objects:
            scan = printable(record.scene_id, 40)
            raise DataError(f"{where}: record {number}: object {record.object_id} of {scan} has a record already")
        objects[record.object_id] = {key: getattr(record, key) or "" for key in KEYS.values()}
    return scenes


def attribute_ids(attributes: Attributes, variant: str, where: str) -> dict[int, int]:
    """The class of each object in an aspect, 0 for none; ``where`` begins the message on an unknown word."""
    key, ids = KEYS[variant], dict[int, int]()
    for object_id, words in attributes.items():
        known = None if words[key].strip().lower() in WITHOUT else attribute_id(variant, words[key])
        if known is None and words[key].strip().lower() not in WITHOUT:
            raise DataError(
                f"{where}: object {object_id} has the {key} '{printable(words[key], 60)}', which is not one of the "
                f"{len(label_set(variant).ids)} OpenScan attributes; score its texts with --ground-truth instead"
            )
        ids[object_id] = known or 0
    return ids
