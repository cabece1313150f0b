"""Tags of an image: RAM++ as exported, and the words of a list most likely to an encoder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_models import blocks

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.perception.models.masks.grounded_sam import (
    ADDED_TAGS,
    BACKGROUND_TAGS,
    RAM_PX,
    STOP_WORDS,
    OnnxRamTagger,
    WordTagger,
    chosen_tags,
    read_word_list,
)

RGB = blocks(40, 60)


class ByColour:
    """An encoder with the directions red, green and blue: the mean colour of an image, the word in a text."""

    name = digest = "colours"
    dim = 3

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        means = np.array([image.reshape(-1, 3).mean(axis=0) for image in images])
        return np.asarray(means / np.linalg.norm(means, axis=1, keepdims=True), np.float32)

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.array([[word in text for word in ("red", "green", "blue")] for text in texts], np.float32)


def test_most_probable_words_are_taken_over_image_parts() -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, :, 0] = 200
    image[20:, 30:] = 0, 0, 255
    tagger = WordTagger(ByColour(), ("green", "blue", "red"), n_tags=2)
    # Most of the image is red, three quarters entirely; one is blue: both score 1, in the order of the list.
    assert tagger.tags(image) == ("blue", "red")
    assert WordTagger(ByColour(), ("green", "blue", "red"), n_tags=9).tags(image) == ("blue", "red", "green")
    assert tagger.caveat is not None and "RAM++ is not installed" in tagger.caveat


def test_stop_word_tags_are_removed_and_added_tags_come_last() -> None:
    found = ["bed", " lamp ", "bedroom", "Blue", "wall lamp", "bed", ""]
    expected = ("bed", "lamp", "other item", "wall", "floor", "ceiling")
    assert chosen_tags(found, STOP_WORDS, (*ADDED_TAGS, *BACKGROUND_TAGS)) == expected
    assert chosen_tags(found, (), ()) == ("bed", "lamp", "bedroom", "Blue", "wall lamp")
    assert len(STOP_WORDS) == 26


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe", "is not UTF-8 text"),
        (b"a" * 101, "is not a word"),
        (b"ab\n" * 20_001, "has 20001 words"),
        (b"a" * (2**21 + 1), "bytes; expected a list of words"),
    ],
)
def test_invalid_word_list_gives_one_line_error(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "words.txt"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        read_word_list(path)
    assert str(caught.value).isprintable()
    with pytest.raises(DataError, match="cannot read the list of words"):
        read_word_list(tmp_path / "absent.txt")


def test_exported_tagger_uses_names_of_its_list() -> None:
    shapes: list[tuple[int, ...]] = []

    def run(_: None, fed: dict[str, Float32Array]) -> list[Float32Array]:
        shapes.append(fed["image"].shape)
        return [np.array([[0, 1, 0, 1]], np.float32)]

    session = SimpleNamespace(get_inputs=lambda: [SimpleNamespace(name="image")], run=run)
    tagger = OnnxRamTagger(lambda: session, ("bed", "lamp", "room", "sofa"), "digest")
    assert tagger.tags(RGB) == ("lamp", "sofa")
    assert shapes == [(1, 3, RAM_PX, RAM_PX)] and tagger.caveat is None
    with pytest.raises(DataError, match=r"returns \(1, 4\), but ram_tag_list.txt has 3 tags"):
        OnnxRamTagger(lambda: session, ("bed", "lamp", "room"), "digest").tags(RGB)
