"""OpenScan's attributes: for each object of a scan, or class of the rooms, one attribute in each of eight aspects.

``openscan_val_raw.json`` is a list of records with ``scene_id``, ``object_id`` (ScanNet's own) and a word or two under
each aspect. Which class a word is says the list of its aspect, whose sentences hold the words ("This term is used for
sit"). Source: README.md and Evaluation/MaskClustering/preprocess/scannet/prepare_gt.py of YoujunZhao/OpenScan at
0df39dd.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.types import LabelSet
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import read_bytes
from su3d_bench.metrics.protocols.loading import load_protocol

# By its protocol, whose label space and ground truth bear the same name: what records call the aspect.
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
FURTHER_TRUTHS: Mapping[str, str] = {name: name for name in KEYS}  # as datasets say it: label space -> ground truth
RAW_NAME = "openscan_val_raw.json"
PAGE = "https://github.com/YoujunZhao/OpenScan"
MOST_RECORDS = 1_000_000  # the validation set has 10,388
MOST_CHARACTERS = 200
SPELT_TWICE = {"\u00a0hang clothes": "hang clothes (34)"}  # in the lists with a blank of another kind
WITHOUT = frozenset(("", "none", "other"))  # an object has no attribute of the aspect

Attributes = Mapping[int, Mapping[str, str]]  # object id -> aspect's key -> word


@cache
def label_set(variant: str) -> LabelSet:
    """The attributes of an aspect, as its protocol lists them."""
    classes = load_protocol(variant).classes
    return LabelSet(variant, tuple(entry.id for entry in classes), tuple(entry.name for entry in classes))


@cache
def attribute_id(variant: str, words: str) -> int | None:
    """The id of an attribute by its ``words``, those at an end of its sentence; None for what is none of the aspect.

    Where several sentences end so it is the shortest: a container is no garbage container.

    >>> attribute_id("openscan-affordance", "sit"), attribute_id("openscan-type", "container")
    (4, 22)
    """
    words = words.replace("_", " ")
    words = SPELT_TWICE.get(words, words)
    found = [
        (len(name), class_id)
        for class_id, name in zip(label_set(variant).ids, label_set(variant).names, strict=True)
        if name == words or name.endswith(f" {words}") or name.startswith(f"{words} ")
    ]
    return min(found)[1] if found else None


def read_attributes(path: Path) -> Mapping[str, Attributes]:
    """The words of every object of each scan, by its id there; a ``DataError`` where the file is damaged."""
    where = f"openscan: {path.name}"
    content = parsed_json(read_bytes(path, where), where)
    if not isinstance(content, list) or not 1 <= len(content) <= MOST_RECORDS:
        raise DataError(f"{where}: holds no list of 1 to {MOST_RECORDS} records; download it again, see {PAGE}")
    scenes: dict[str, dict[int, Mapping[str, str]]] = {}
    for number, record in enumerate(content, 1):
        at = f"{where}: record {number}"
        if not isinstance(record, dict):
            raise DataError(f"{at} is no table; expected scene_id, object_id and the aspects")
        scene, object_id = _text(record, "scene_id", at), _object_id(record, at)
        objects = scenes.setdefault(scene, {})
        if object_id in objects:
            raise DataError(f"{at}: object {object_id} of {printable(scene, 40)} has a record already")
        objects[object_id] = {key: _text(record, key, at) for key in KEYS.values()}
    return scenes


def attribute_ids(attributes: Attributes, variant: str, where: str) -> dict[int, int]:
    """The class of each object in an aspect, 0 for none; ``where`` begins the message on a word that is unknown."""
    key, ids = KEYS[variant], dict[int, int]()
    for object_id, words in attributes.items():
        known = None if words[key].strip().lower() in WITHOUT else attribute_id(variant, words[key])
        if known is None and words[key].strip().lower() not in WITHOUT:
            raise DataError(
                f"{where}: object {object_id} has the {key} '{printable(words[key], 60)}', which is none of the "
                f"{len(label_set(variant).ids)} of OpenScan; score its prepared texts with --ground-truth instead"
            )
        ids[object_id] = known or 0
    return ids


def _text(record: Mapping[str, Any], key: str, at: str) -> str:
    """The words under ``key``; an aspect may be absent, a scan may not."""
    value = record.get(key, None if key == "scene_id" else "")
    if value is None and key != "scene_id":
        return ""
    if not isinstance(value, str) or len(value) > MOST_CHARACTERS or (key == "scene_id" and not value):
        raise DataError(f"{at}: '{key}' must be a few words; found {printable(repr(value), 40)}")
    return value


def _object_id(record: Mapping[str, Any], at: str) -> int:
    text = str(record.get("object_id"))
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise DataError(f"{at}: 'object_id' must be a whole number; found {printable(text, 40)}")
    return int(text)
