"""RAM++ exported by its authors' own code in an environment of its own, and how far ONNX Runtime is from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import CheckFailed, ConfigError, shown
from su3d_bench.core.files.atomic import is_file, make_folder, read_json, read_npz, write_npz, write_text
from su3d_bench.core.files.locks import unfinished_folder
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import BoolArray, Float32Array
from su3d_bench.perception.models.files import ModelFiles, read_weights
from su3d_bench.perception.models.masks.tagging import RAM_MODEL, RAM_TAG_LIST, RamManifest, ram_pixels, read_word_list
from su3d_bench.perception.models.onnx import ram_plus_program
from su3d_bench.perception.models.onnx.export import OPSET, Parity, compare_outputs, settle
from su3d_bench.perception.models.onnx.isolated import run_program
from su3d_bench.perception.models.onnx.session import open_session

REPOSITORY = "https://github.com/xinyu1205/recognize-anything"
# What of a checkout makes the network; recognize-anything 7cb804a.
CODE = (
    *(f"ram/models/{name}.py" for name in ("ram_plus", "bert", "swin_transformer", "utils")),
    "ram/configs/q2l_config.json",
    "ram/configs/swin/config_swinL_384.json",
    *(f"ram/data/ram_tag_list{kind}.txt" for kind in ("", "_chinese", "_threshold")),
)
# Of a tag's logit: of its probability a quarter at most, whose thresholds have two decimals.
LARGEST_DIFFERENCE = 1e-3
N_IMAGES = 3


def export_ram_plus(files: ModelFiles, folder: Path, checkout: Path, python: Path) -> RamManifest:
    """Write ``ram_plus.onnx``, its list of tags and the manifest into ``folder``.

    ``checkout``: a clone of recognize-anything, whose code ``python`` runs. Raises ``ConfigError`` where it is none,
    ``DataError`` for weights that are no table of tensors, and ``CheckFailed`` where the code fails or ONNX Runtime's
    answers are not those of the authors' ``generate_tag``; then nothing is left in ``folder``.
    """
    check_checkout(checkout)
    read_weights(files.weights, "meta")  # says in our words what is wrong with the file
    make_folder(folder)
    images = made_images()
    with unfinished_folder(folder / RAM_MODEL) as place:
        write_npz(place / "images.npz", {"images": images})
        words = [str(path.absolute()) for path in (checkout, files.weights, place)]
        run_program(python, Path(ram_plus_program.__file__), [*words, "--opset", str(OPSET)], place)
        tags = read_word_list(place / RAM_TAG_LIST)
        answers = read_npz(place / "answers.npz")
        expected = tuple(answers[name] for name in ("logit", "tag", "threshold"))
        if expected[0].shape != (len(images), len(tags)):
            raise CheckFailed(f"ram-plus: {len(tags)} tags are listed, the network answers {expected[0].shape[1:]}")
        parity, n_undecided = compared(open_session(place / RAM_MODEL), images, *expected)
        made_with = read_json(place / "versions.json")
        text = file_text(place / RAM_TAG_LIST)
        for name in ("images.npz", "answers.npz", "versions.json", RAM_TAG_LIST):
            (place / name).unlink()  # what is left is the model and, of a large one, its weights
        written = settle(place / RAM_MODEL, folder / RAM_MODEL)
    write_text(folder / RAM_TAG_LIST, text)
    return RamManifest.of_export(
        files,
        [*written, folder / RAM_TAG_LIST],
        [parity],
        str(made_with["torch"]),
        n_tags=len(tags),
        code={name: digest_file(checkout / name) for name in CODE},
        made_with=made_with,
        n_undecided=n_undecided,
    )


def check_checkout(checkout: Path) -> None:
    """Raises ``ConfigError`` for a folder that lacks what makes the network."""
    lacking = [name for name in CODE if not is_file(checkout / name)]
    if lacking:
        raise ConfigError(
            f"--checkout {shown(checkout)}: has no {lacking[0]}; expected a clone of recognize-anything: "
            f"git clone {REPOSITORY}"
        )


def made_images() -> Float32Array:
    """Noise in blocks, prepared as a run prepares images: (N, 3, 384, 384)."""
    random = np.random.default_rng(0)
    sizes = ((8, 12), (24, 24), (96, 128))
    noise = [random.integers(0, 256, (*size, 3), dtype=np.uint8) for size in sizes[:N_IMAGES]]
    return np.stack([ram_pixels(np.kron(image, np.ones((8, 8, 1), np.uint8))) for image in noise])


def compared(
    session: Any, images: Float32Array, logit: Float32Array, tag: BoolArray, threshold: Float32Array
) -> tuple[Parity, int]:
    """How far ``session`` is from ``logit`` (N, T), and how many of ``tag`` (N, T) are too near ``threshold`` (T,).

    Too near is: within the tolerance, where a last bit decides. Raises ``CheckFailed`` where the logits differ by more
    than the tolerance, or other tags hold.
    """
    tags, theirs = zip(*(session.run(["tag", "logit"], {"image": image[None]}) for image in images), strict=True)
    parity = compare_outputs("logit", logit, np.concatenate(theirs))
    if not parity.max_abs_difference <= LARGEST_DIFFERENCE:  # not a number is no agreement either
        raise CheckFailed(
            f"ram-plus: logits differ between torch and ONNX Runtime by {parity.max_abs_difference:.2e}; "
            f"tolerance {LARGEST_DIFFERENCE:.0e}"
        )
    with np.errstate(divide="ignore"):  # a threshold of 1
        bound = np.log(threshold) - np.log1p(-threshold)
    is_undecided: BoolArray = np.abs(logit - bound) <= LARGEST_DIFFERENCE
    differs = ((np.concatenate(tags) > 0.5) != tag) & ~is_undecided
    if differs.any():
        raise CheckFailed(f"ram-plus: {int(differs.sum())} tags differ between torch and ONNX Runtime; none may")
    return parity, int(is_undecided.sum())
