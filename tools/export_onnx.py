"""Export RAM++ as an ONNX file with a manifest, compared with torch.

    python tools/export_onnx.py ram-plus --checkout recognize-anything --python ENVIRONMENT/bin/python --out DIR

Needs the models extra. RAM++ is exported by its authors' code, which ``--python`` runs in an environment with
torch 2.13.0, transformers 4.46.3 (5 lacks functions that it imports), onnx 1.18.0 and NumPy 2.2.6.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ram_plus_program
from numpy.typing import NDArray

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import CheckFailed, ConfigError, StoreError, Su3dError, printable, shown
from su3d_bench.core.files.atomic import is_file, make_folder, read_json, read_npz, write_json, write_npz, write_text
from su3d_bench.core.files.locks import sync_to_disk, unfinished_folder
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import BoolArray, Float32Array
from su3d_bench.perception.models.catalogue import ONNX_MANIFEST
from su3d_bench.perception.models.files import ModelFiles, locate, read_weights
from su3d_bench.perception.models.masks.grounded_sam import (
    RAM_FORMAT,
    RAM_MODEL,
    RAM_TAG_LIST,
    ram_pixels,
    read_word_list,
)
from su3d_bench.perception.models.onnx import open_session

# 17 has LayerNormalization as one operator; newer ones add nothing that our towers use.
OPSET = 17
# A protobuf message is limited to 2 GiB; larger models keep their weights in a separate file.
LARGEST_SINGLE_FILE = 2**31 - 2**24


@dataclass(frozen=True)
class Parity:
    """Difference of one output of ONNX Runtime from torch's on fixed inputs.

    ``max_abs_difference`` over all values; ``min_cosine`` over the rows along the last axis; rows that are zero in
    both agree.
    """

    output: str
    n_values: int
    max_abs_difference: float
    min_cosine: float


def export_onnx(
    module: Any,
    inputs: Mapping[str, Any],
    path: Path,
    output_names: Sequence[str],
    dynamic_axes: Mapping[str, Mapping[int, str]] | None = None,
) -> list[Path]:
    """Write ``module`` to ``path`` and return the files created: large weights are in ``<path>.data``.

    ``inputs`` are the module's positional arguments in order, with their input names. ``dynamic_axes`` names, for
    inputs and outputs, the axes whose size may differ from that of ``inputs``. The module's mode is kept; pass it
    in evaluation mode.
    """
    import torch

    make_folder(path.parent)
    with unfinished_folder(path) as folder:
        draft = folder / path.name
        with _slow_attention(torch), torch.no_grad(), warnings.catch_warnings():
            # The exporter warns about its age and every shape that it treats as constant; only parity matters.
            warnings.simplefilter("ignore")
            # dynamo=False: the newer exporter needs another package and always splits the file.
            torch.onnx.export(
                module,
                tuple(inputs.values()),
                str(draft),
                input_names=list(inputs),
                output_names=list(output_names),
                dynamic_axes={name: dict(axes) for name, axes in (dynamic_axes or {}).items()},
                opset_version=OPSET,
                do_constant_folding=True,
                dynamo=False,
            )
        return settle(draft, path)


def settle(draft: Path, path: Path) -> list[Path]:
    """Move the exporter's files to their destination, merging the many files of a large model's weights."""
    import onnx

    # The weights refer to their file relative to the model's folder, so the final name is used from the start.
    data = path.with_name(f"{path.name}.data")
    size = sum(file.stat().st_size for file in draft.parent.iterdir())
    try:
        if size < LARGEST_SINGLE_FILE:
            sync_to_disk(draft)
            os.replace(draft, path)
            data.unlink(missing_ok=True)
            return [path]
        model = onnx.load(str(draft))
        settled = draft.parent / "settled"
        settled.mkdir()
        onnx.save_model(
            model, str(settled / path.name), save_as_external_data=True, location=data.name, size_threshold=1024
        )
        for file in (settled / data.name, settled / path.name):
            sync_to_disk(file)
        os.replace(settled / data.name, data)
        os.replace(settled / path.name, path)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    return [path, data]


@contextmanager
def _slow_attention(torch: Any) -> Iterator[None]:
    """Disable the fused kernel of ``nn.MultiheadAttention``, for which the exporter has no operator."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(before)


def compare_outputs(name: str, mine: NDArray[Any], other: NDArray[Any]) -> Parity:
    """The ``Parity`` of two arrays of the same shape."""
    assert mine.shape == other.shape, f"{name}: {mine.shape} and {other.shape}"
    a, b = mine.astype(np.float64), other.astype(np.float64)
    rows_a, rows_b = (array.reshape(-1, array.shape[-1] if array.ndim else 1) for array in (a, b))
    norms = np.linalg.norm(rows_a, axis=1) * np.linalg.norm(rows_b, axis=1)
    products = (rows_a * rows_b).sum(axis=1)
    both_zero = ~rows_a.any(axis=1) & ~rows_b.any(axis=1)
    cosines = np.where(both_zero, 1.0, products / np.where(norms > 0, norms, 1.0))
    return Parity(name, a.size, float(np.abs(a - b).max(initial=0.0)), float(min(cosines.min(initial=1.0), 1.0)))


def write_manifest(files: ModelFiles, written: Sequence[Path], parity: Sequence[Parity], **own: Any) -> None:
    """Write the manifest of the files ``written`` from ``files`` next to them, with the fields ``own``."""
    content = {
        "format": RAM_FORMAT,
        "name": files.entry.name,
        "files": {path.name: digest_file(path) for path in written},
        "source": {"form": files.form.form, "files": files.digests()},
        "opset": OPSET,
        "parity": [asdict(part) for part in parity],
        **own,
    }
    write_json(written[0].parent / ONNX_MANIFEST, content)


# ---- RAM++

REPOSITORY = "https://github.com/xinyu1205/recognize-anything"
# Files of a checkout that define the network; recognize-anything 7cb804a.
CODE = (
    *(f"ram/models/{name}.py" for name in ("ram_plus", "bert", "swin_transformer", "utils")),
    "ram/configs/q2l_config.json",
    "ram/configs/swin/config_swinL_384.json",
    *(f"ram/data/ram_tag_list{kind}.txt" for kind in ("", "_chinese", "_threshold")),
)
# Of a tag's logit: at most a quarter of that in probability, whose thresholds have two decimals.
LARGEST_OF_LOGITS = 1e-3


def export_ram_plus(files: ModelFiles, folder: Path, checkout: Path, python: Path) -> None:
    """Write ``ram_plus.onnx``, its list of tags and the manifest into ``folder``.

    ``checkout``: a clone of recognize-anything, whose code ``python`` runs. Raises ``ConfigError`` if it is not one,
    ``DataError`` for weights that are not a table of tensors, and ``CheckFailed`` if the code fails or ONNX Runtime's
    results differ from the authors' ``generate_tag``; then nothing is left in ``folder``.
    """
    check_checkout(checkout)
    read_weights(files.weights, "meta")  # reports faults of the file with our messages
    make_folder(folder)
    images = made_images()
    with unfinished_folder(folder / RAM_MODEL) as place:
        write_npz(place / "images.npz", {"images": images})
        words = [str(path.absolute()) for path in (checkout, files.weights, place)]
        _run_program(python, [*words, "--opset", str(OPSET)], place)
        tags = read_word_list(place / RAM_TAG_LIST)
        answers = read_npz(place / "answers.npz")
        expected = tuple(answers[name] for name in ("logit", "tag", "threshold"))
        if expected[0].shape != (len(images), len(tags)):
            raise CheckFailed(f"ram-plus: {len(tags)} tags are listed, but the network returns {expected[0].shape[1:]}")
        parity, n_undecided = compared(open_session(place / RAM_MODEL), images, *expected)
        made_with = read_json(place / "versions.json")
        text = file_text(place / RAM_TAG_LIST)
        for name in ("images.npz", "answers.npz", "versions.json", RAM_TAG_LIST):
            (place / name).unlink()  # what remains is the model and, if large, its weights
        written = settle(place / RAM_MODEL, folder / RAM_MODEL)
    write_text(folder / RAM_TAG_LIST, text)
    write_manifest(
        files,
        [*written, folder / RAM_TAG_LIST],
        [parity],
        n_tags=len(tags),
        code={name: digest_file(checkout / name) for name in CODE},
        made_with=made_with,
        n_undecided=n_undecided,
    )


def _run_program(python: Path, words: Sequence[str], folder: Path) -> None:
    """Run the authors' code with ``python`` in ``folder``, without this project's modules and without hub access."""
    # Links are not resolved: Python finds its environment by the location of the link.
    found = str(Path(shutil.which(python) or python).absolute())
    offline = {"HF_HUB_OFFLINE": "1", "TRANSFORMERS_OFFLINE": "1"}
    command = [found, "-I", "-B", str(Path(ram_plus_program.__file__).absolute()), *words]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=os.environ | offline,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            check=False,
        )
    except OSError as error:
        raise ConfigError(f"{printable(found)}: cannot be started ({error.strerror}); fix --python") from error
    if done.returncode:
        lines = done.stderr.decode(errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), f"exit code {done.returncode}")
        raise CheckFailed(f"ram_plus_program.py failed: {printable(last)}")


def check_checkout(checkout: Path) -> None:
    """Raises ``ConfigError`` for a folder that lacks a file of the network."""
    lacking = [name for name in CODE if not is_file(checkout / name)]
    if lacking:
        raise ConfigError(
            f"--checkout {shown(checkout)}: has no {lacking[0]}; expected a clone of recognize-anything: "
            f"git clone {REPOSITORY}"
        )


def made_images() -> Float32Array:
    """Blocks of noise, preprocessed as in a run: (N, 3, 384, 384)."""
    random = np.random.default_rng(0)
    sizes = ((8, 12), (24, 24), (96, 128))
    noise = [random.integers(0, 256, (*size, 3), dtype=np.uint8) for size in sizes]
    return np.stack([ram_pixels(np.kron(image, np.ones((8, 8, 1), np.uint8))) for image in noise])


def compared(
    session: Any, images: Float32Array, logit: Float32Array, tag: BoolArray, threshold: Float32Array
) -> tuple[Parity, int]:
    """Difference of ``session`` from ``logit`` (N, T), and how many of ``tag`` (N, T) are too near ``threshold`` (T,).

    Too near means within the tolerance, where the last bit decides. Raises ``CheckFailed`` if the logits differ by more
    than the tolerance, or other tags differ.
    """
    tags, theirs = zip(*(session.run(["tag", "logit"], {"image": image[None]}) for image in images), strict=True)
    parity = compare_outputs("logit", logit, np.concatenate(theirs))
    if not parity.max_abs_difference <= LARGEST_OF_LOGITS:  # also fails for NaN
        raise CheckFailed(
            f"ram-plus: logits differ between torch and ONNX Runtime by {parity.max_abs_difference:.2e}; "
            f"tolerance {LARGEST_OF_LOGITS:.0e}"
        )
    with np.errstate(divide="ignore"):  # a threshold of 1
        bound = np.log(threshold) - np.log1p(-threshold)
    is_undecided: BoolArray = np.abs(logit - bound) <= LARGEST_OF_LOGITS
    differs = ((np.concatenate(tags) > 0.5) != tag) & ~is_undecided
    if differs.any():
        raise CheckFailed(f"ram-plus: {int(differs.sum())} tags differ between torch and ONNX Runtime; none may")
    return parity, int(is_undecided.sum())


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=["ram-plus"])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    parser.add_argument("--weights", type=Path, metavar="PATH", help="model path (default: the models folder)")
    parser.add_argument("--checkout", type=Path, required=True, metavar="DIR", help=f"a clone of {REPOSITORY}")
    parser.add_argument("--python", type=Path, required=True, metavar="PYTHON", help="Python to run the clone's code")
    asked = parser.parse_args(arguments)
    try:
        files = locate(asked.name, ("original",), path=asked.weights)
        export_ram_plus(files, asked.out, asked.checkout, asked.python)
    except Su3dError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
