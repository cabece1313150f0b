"""Export CLIP and SigLIP encoders, SAM and RAM++ as ONNX files with a manifest, compared with torch.

    python tools/export_onnx.py clip-vit-h-14 --out DIR
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
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from su3d_bench.core.system.devices import CPU
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import BoolArray, Float32Array, Int64Array
from su3d_bench.perception.models.catalogue import ONNX_MANIFEST, model_entry
from su3d_bench.perception.models.encoders import encoder as towers
from su3d_bench.perception.models.encoders.encoder import EncoderSpec, unit_rows
from su3d_bench.perception.models.encoders.texts import read_tokeniser
from su3d_bench.perception.models.files import ModelFiles, bounded, locate, read_weights
from su3d_bench.perception.models.masks.grounded_sam import (
    RAM_MODEL,
    RAM_TAG_LIST,
    RamManifest,
    ram_pixels,
    read_word_list,
)
from su3d_bench.perception.models.masks.sam import (
    BOTTOM_RIGHT,
    DECODER_FILE,
    ENCODER_FILE,
    NO_POINT,
    TOP_LEFT,
    SamManifest,
    load_sam,
)
from su3d_bench.perception.models.onnx import OnnxManifest, open_session

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


def as_module(compute: Callable[..., Any], model: Any) -> Any:
    """``compute``, which runs parts of ``model``, as a torch module in evaluation mode for the exporter."""
    import torch

    class Computing(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, *values: Any) -> Any:
            return compute(*values)

    return Computing().eval()


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


def measure_parity(
    module: Any, session: Any, inputs: Mapping[str, Any], output_names: Sequence[str]
) -> tuple[Parity, ...]:
    """Torch's and ONNX Runtime's outputs on ``inputs``, compared one by one."""
    import torch

    with torch.no_grad():
        answer = module(*inputs.values())
    ours = [answer] if isinstance(answer, torch.Tensor) else list(answer)
    feed = {name: value.detach().cpu().numpy() for name, value in inputs.items()}
    theirs = session.run(list(output_names), feed)
    return tuple(
        compare_outputs(name, mine.detach().float().cpu().numpy(), np.asarray(other))
        for name, mine, other in zip(output_names, ours, theirs, strict=True)
    )


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


def write_manifest(
    kind: type[OnnxManifest], files: ModelFiles, written: Sequence[Path], parity: Sequence[Parity], **own: Any
) -> None:
    """Write the manifest of the files ``written`` from ``files`` next to them, with the fields of its kind."""
    content = {
        "format": kind.FORMAT,
        "name": files.entry.name,
        "files": {path.name: digest_file(path) for path in written},
        "source": {"form": files.form.form, "files": files.digests()},
        "opset": OPSET,
        "parity": [asdict(part) for part in parity],
        **own,
    }
    write_json(written[0].parent / ONNX_MANIFEST, content)


# ---- encoders

TOKENIZER_FILES = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json", "vocab.json", "merges.txt")
# Of unit features. ViT-H-14 in float32 agrees to 2e-7; a wrong operator shows in the second decimal.
LARGEST_OF_FEATURES = 1e-4
SMALLEST_COSINE = 0.99999
PROBES = ("chair", "an image of a tv-screen", "a red cup on the table in a scene")


def export_encoder(files: ModelFiles, folder: Path) -> None:
    """Write the two towers of a transformers model into ``folder``; ``CheckFailed`` if ONNX Runtime disagrees."""
    import torch

    spec = towers.transformers_spec(files, "original")
    model = towers.load_transformers(files)
    both = towers.TransformersTowers(model, CPU, "float32", 1)
    make_folder(folder)
    pixels, tokens = _encoder_probes(files, spec)
    written = []
    parity = []
    for name, tower, values in (
        (towers.IMAGE_FILE, as_module(both.encode_image, model), torch.from_numpy(pixels)),
        (towers.TEXT_FILE, as_module(both.encode_text, model), torch.from_numpy(tokens)),
    ):
        kind = name.partition(".")[0]
        inputs = {"pixels" if kind == "image" else "tokens": values}
        axes = {key: {0: "n"} for key in (*inputs, "features")}
        # two rows are traced and three compared: the number of rows must not be fixed in the file
        traced = {key: value[:2] for key, value in inputs.items()}
        written += export_onnx(tower, traced, folder / name, ["features"], axes)
        with torch.inference_mode():
            mine = tower(values).numpy()
        other = open_session(folder / name).run(["features"], {key: value.numpy() for key, value in inputs.items()})[0]
        parity.append(compare_outputs(kind, unit_rows(mine, kind), unit_rows(other, kind)))
    written += _copy_tokenizer(files.folder, folder)
    write_manifest(
        towers.EncoderManifest, files, written, parity, spec=asdict(spec), made_with={"torch": str(torch.__version__)}
    )
    check_parity(files.entry.name, parity)


def check_parity(name: str, parts: Sequence[Parity]) -> None:
    """Raises ``CheckFailed`` if a tower's features differ by more than the tolerance."""
    for parity in parts:
        if parity.max_abs_difference > LARGEST_OF_FEATURES or parity.min_cosine < SMALLEST_COSINE:
            raise CheckFailed(
                f"{name}: the {parity.output} tower differs between torch and ONNX Runtime by "
                f"{parity.max_abs_difference:.2e} (cosine {parity.min_cosine:.6f}); tolerance {LARGEST_OF_FEATURES:.0e}"
            )


def _encoder_probes(files: ModelFiles, spec: EncoderSpec) -> tuple[Float32Array, Int64Array]:
    """Fixed inputs: three images of noise in blocks, three texts."""
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (8, 12, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1) for _ in PROBES]
    tokenise = read_tokeniser(files.folder, spec.tokens, spec.n_tokens, spec.pad_id, spec.n_words)
    return spec.transform.pixels(images), tokenise(PROBES)


def _copy_tokenizer(source: Path, folder: Path) -> list[Path]:
    try:
        return [
            Path(shutil.copyfile(source / name, folder / name)) for name in TOKENIZER_FILES if (source / name).is_file()
        ]
    except (OSError, shutil.SameFileError) as error:
        raise StoreError(f"{folder}: the tokenizer cannot be copied from {source}: {bounded(error)}") from error


# ---- SAM

# Of an output's largest value. Random weights agree to 1e-5; a wrong operator shows in the second decimal.
LARGEST_OF_MASKS = 1e-3


def export_sam(files: ModelFiles, folder: Path) -> None:
    """Write SAM's encoder and decoder into ``folder``; ``CheckFailed`` if ONNX Runtime disagrees with torch."""
    import torch

    model = load_sam(files, "cpu", "float32").model
    make_folder(folder)
    encoder, decoder = modules_to_export(model)
    side = model.config.vision_config.image_size
    random = np.random.default_rng(0)
    pixels = torch.from_numpy(random.normal(size=(1, 3, side, side)).astype(np.float32))
    written = export_onnx(encoder, {"pixels": pixels}, folder / ENCODER_FILE, ["embedding"])
    with torch.inference_mode():
        embedding = encoder(pixels).clone()
    # Two prompts of three points are traced, five of two compared: neither number must be fixed in the file.
    traced = {"embedding": embedding, **_prompt_probes(random, side, 2, 3)}
    axes = {name: {0: "n_prompts", 1: "n_points"} for name in ("points", "labels")}
    outputs = {name: {0: "n_prompts"} for name in ("logits", "iou")}
    written += export_onnx(decoder, traced, folder / DECODER_FILE, ["logits", "iou"], {**axes, **outputs})
    compared = {"embedding": embedding, **_prompt_probes(random, side, 5, 2)}
    parity = (
        *measure_parity(encoder, open_session(folder / ENCODER_FILE), {"pixels": pixels}, ["embedding"]),
        *measure_parity(decoder, open_session(folder / DECODER_FILE), compared, ["logits", "iou"]),
    )
    with torch.inference_mode():
        largest = [float(values.abs().max()) for values in (embedding, *decoder(*compared.values()))]
    write_manifest(SamManifest, files, written, parity, image_px=side, made_with={"torch": str(torch.__version__)})
    for part, value in zip(parity, largest, strict=True):
        _check_sam(files.entry.name, part, value)


def _prompt_probes(random: np.random.Generator, side: int, n_prompts: int, n_points: int) -> dict[str, Any]:
    """Prompts with points on and off the object, with corners, and without points."""
    import torch

    points = random.uniform(0, side, (n_prompts, n_points, 2)).astype(np.float32)
    labels = np.resize(np.array([1, NO_POINT, 0, TOP_LEFT, BOTTOM_RIGHT], np.int64), (n_prompts, n_points))
    return {"points": torch.from_numpy(points), "labels": torch.from_numpy(labels)}


def _check_sam(name: str, parity: Parity, largest: float) -> None:
    if parity.max_abs_difference > LARGEST_OF_MASKS * max(largest, 1e-6):
        raise CheckFailed(
            f"{name}: {parity.output} differs between torch and ONNX Runtime by {parity.max_abs_difference:.2e} of "
            f"at most {largest:.2e}; tolerance {LARGEST_OF_MASKS:.0e} of the largest value"
        )


def modules_to_export(model: Any) -> tuple[Any, Any]:
    """SAM's encoder (pixels -> embedding) and decoder (embedding, points, labels -> logits, iou) as torch modules.

    The decoder returns all four masks: the single one first, then the three from which a caller picks the best.
    """
    import torch

    positions = model.get_image_wide_positional_embeddings().detach()

    def decode(embedding: Any, points: Any, labels: Any) -> tuple[Any, Any]:
        sparse, dense = embedded_points(model.prompt_encoder, points, labels)
        answers = [
            model.mask_decoder(
                image_embeddings=embedding,
                image_positional_embeddings=positions,
                sparse_prompt_embeddings=sparse,
                dense_prompt_embeddings=dense,
                multimask_output=is_multiple,
            )
            for is_multiple in (False, True)
        ]
        logits, scores = (torch.cat(parts, dim=2)[0] for parts in zip(*answers, strict=True))
        return logits, scores

    encoder = as_module(lambda pixels: model.vision_encoder(pixels).last_hidden_state, model.vision_encoder)
    return encoder, as_module(decode, torch.nn.ModuleList([model.prompt_encoder, model.mask_decoder]))


def embedded_points(prompt_encoder: Any, points: Any, labels: Any) -> tuple[Any, Any]:
    """Output of ``transformers``' prompt encoder for points and boxes, from labels only; sparse and dense."""
    import torch

    side, cells = prompt_encoder.input_image_size, prompt_encoder.image_embedding_size
    # 0.5: from the corner of a pixel to its centre, as in the original.
    sparse = prompt_encoder.shared_embedding((points + 0.5)[None], (side, side))
    kind = labels[None, ..., None]
    sparse = torch.where(kind == NO_POINT, prompt_encoder.not_a_point_embed.weight, sparse)
    for label, embed in enumerate(prompt_encoder.point_embed):
        sparse = sparse + embed.weight * (kind == label)
    dense = prompt_encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(1, -1, cells[0], cells[1])
    return sparse, dense


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
        RamManifest,
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
    parser.add_argument("name", metavar="MODEL", help="short name, such as clip-vit-h-14")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    parser.add_argument("--weights", type=Path, metavar="PATH", help="model path (default: the models folder)")
    parser.add_argument("--checkout", type=Path, metavar="DIR", help=f"ram-plus: a clone of {REPOSITORY}")
    parser.add_argument("--python", type=Path, metavar="PYTHON", help="ram-plus: Python to run the clone's code")
    asked = parser.parse_args(arguments)
    try:
        entry = model_entry(asked.name)
        if entry.kind == "encoder":
            export_encoder(locate(entry.name, ("transformers",), path=asked.weights), asked.out)
        elif entry.kind == "segmenter":
            export_sam(locate(entry.name, ("transformers", "original"), path=asked.weights), asked.out)
        elif entry.kind == "tagger" and asked.checkout and asked.python:
            files = locate(entry.name, ("original",), path=asked.weights)
            export_ram_plus(files, asked.out, asked.checkout, asked.python)
        else:
            parser.error(f"{entry.name}: detectors cannot be exported; ram-plus needs --checkout and --python")
    except Su3dError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
