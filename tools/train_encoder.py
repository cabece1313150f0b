"""Train the embedded encoder on homes for training, without held-out models and classes; export and measure it.

    python tools/train_encoder.py --out DIR --homes 150 --minutes 40 --seed 0

Needs the models extra (torch, onnx). The number of steps depends on time, so two trainings differ in their weights.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from export_onnx import export_onnx
from numpy.typing import NDArray
from training_captions import Caption, CropTruth, fill, fixed_captions
from training_crops import (
    FIRST_MEASURED_NUMBER,
    MEASURED,
    TRAINING,
    CropSet,
    home_names,
    make_crops,
)

from su3d_bench.core.errors import Su3dError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.safe_output import doors
from su3d_bench.core.system.devices import require
from su3d_bench.core.system.files import file_bytes, file_text
from su3d_bench.core.types import BoolArray, Float32Array, Int64Array
from su3d_bench.datasets.homes.catalogue import catalogue
from su3d_bench.perception.embedded.encoder import IMAGE_FILE, IMAGE_SIZE, TEXT_FILE, EmbeddedEncoder
from su3d_bench.perception.embedded.lexicon import DIM, N_IDS, N_WORDS, ROOM_NAMES, SURFACES, class_words, token_ids

PROMPTS = ("an image of {a}", "{a} in a scene", "{}")
MIN_POSITIVES = 3


@dataclass(frozen=True)
class Figure:
    """One measured value: ``value`` over ``n`` trials, with ``chance`` level; 95 % interval over homes, if measured."""

    name: str
    value: float
    chance: float
    n: int
    interval: tuple[float, float] | None = None


def measure(encoder: Encoder, crops: CropSet, features: Float32Array, class_names: Sequence[str]) -> tuple[Figure, ...]:
    """Every value of the model card, for crops (N) with their ``features`` (N, D) and the classes of the prompts."""
    has_class = np.array([truth.class_name in set(class_names) for truth in crops.truths])
    tight = (crops.ratios > 0) & (crops.ratios <= 1.2)
    exact = has_class & tight & crops.is_exact
    groups = (
        ("exact boxes, ratio 0.8 to 1.2", exact),
        ("careless boxes and parts, ratio 0.8 to 1.2", has_class & tight & ~crops.is_exact),
        ("ratio 2", has_class & (crops.ratios == 2.0)),
        ("ratio 4", has_class & (crops.ratios == 4.0)),
    )
    held_out = _HeldOut(encoder, crops, features, class_names)
    figures: list[Figure] = held_out.split_figures(exact)
    for prompt in PROMPTS:
        figures += held_out.class_figures(exact, prompt, groups[0][0])
    for label, chosen in groups[1:]:
        figures += held_out.class_figures(chosen, PROMPTS[1], label)
    figures += held_out.colour_figures(exact)
    figures += held_out.retrieval_figures(exact, has_class & (crops.ratios > 0))
    figures.append(held_out.room_figure())
    return tuple(figure for figure in figures if figure.n)


@dataclass(frozen=True)
class _HeldOut:
    """Crops with their features, and the classes of the prompts."""

    encoder: Encoder
    crops: CropSet
    features: Float32Array
    class_names: Sequence[str]

    def similarity(self, rows: NDArray[np.intp], texts: Sequence[str]) -> Float32Array:
        """Cosines (R, T) of crops ``rows`` with texts."""
        return self.features[rows] @ self.encoder.encode_texts(texts).T

    def places(self, rows: NDArray[np.intp], names: Sequence[str], field: str) -> Int64Array:
        """Where among ``names`` the ground truths of crops ``rows`` stand."""
        return np.array([names.index(getattr(self.crops.truths[row], field)) for row in rows], np.int64)

    def class_figures(self, chosen: BoolArray, prompt: str, label: str) -> list[Figure]:
        rows, names = np.flatnonzero(chosen), self.class_names
        truth = self.places(rows, names, "class_name")
        rank = _ranks(self.similarity(rows, [fill(prompt, name) for name in names]), truth)
        by_class = [float((rank[truth == name] == 0).mean()) for name in np.unique(truth)]
        what = f"class of {len(names)}, prompt '{prompt.replace('{a}', 'a {}')}', {label}"
        mean = f"mean over classes of top-1: {what}"
        return [
            *_tops(what, rank, len(names), (1, 5)),
            Figure(mean, float(np.mean(by_class or [0.0])), 1.0 / len(names), len(rows)),
        ]

    def split_figures(self, chosen: BoolArray) -> list[Figure]:
        """Classification of what training has shown and of what it has not, with intervals over homes."""
        rows, names = np.flatnonzero(chosen), self.class_names
        rank = _ranks(
            self.similarity(rows, [fill(PROMPTS[0], name) for name in names]), self.places(rows, names, "class_name")
        )
        known = catalogue()
        held_out = {model.name for name in names for model in known.classes[name].models if model.is_held_out}
        is_novel = np.array([known.classes[self.crops.truths[row].class_name].is_novel for row in rows], bool)
        is_unseen = np.array([self.crops.truths[row].model in held_out for row in rows], bool)
        splits = (
            ("models seen in training", ~is_unseen),
            ("unseen models of base classes", is_unseen & ~is_novel),
            ("novel classes", is_novel),
        )
        return [
            Figure(f"top-{k}: {label}, class of {len(names)}", _mean(rank[split] < k), k / len(names), int(split.sum()),
                   _interval_over(self.crops.homes[rows[split]], rank[split] < k))
            for label, split in splits for k in (1, 5)
        ]  # fmt: skip

    def colour_figures(self, chosen: BoolArray) -> list[Figure]:
        rows, names = np.flatnonzero(chosen), self.class_names
        colours = sorted({truth.colour for truth in self.crops.truths} - {""})
        pairs = [(colour, name) for name in names for colour in colours]
        similarity = self.similarity(rows, [f"a {colour} {name.replace('-', ' ')}" for colour, name in pairs])
        colour, name = self.places(rows, colours, "colour"), self.places(rows, names, "class_name")
        of_own_class = similarity.reshape(len(rows), len(names), len(colours))[np.arange(len(rows)), name]
        of_anything = self.similarity(rows, [f"a {word} object" for word in colours])
        of_pair = _ranks(similarity, name * len(colours) + colour)
        what = f"colour of {len(colours)}, 'a {{colour}} "
        return [
            *_tops(f"{what}{{class}}' with the true class, exact boxes", _ranks(of_own_class, colour), len(colours)),
            *_tops(f"{what}object', exact boxes", _ranks(of_anything, colour), len(colours)),
            *_tops(f"colour and class of {len(pairs)}, exact boxes", of_pair, len(pairs), (1, 5)),
        ]

    def room_figure(self) -> Figure:
        rows = np.flatnonzero(self.crops.ratios == 0)
        kinds = sorted({self.crops.truths[row].room for row in rows})
        texts = [fill("an image of {a}", ROOM_NAMES.get(kind, (kind,))[0]) for kind in kinds]
        rank = _ranks(self.similarity(rows, texts), self.places(rows, kinds, "room"))
        return _tops(f"room of {len(kinds)}, whole image", rank, len(kinds))[0]

    def retrieval_figures(self, exact: BoolArray, shown: BoolArray) -> list[Figure]:
        names = {truth.class_name for truth in self.crops.truths} - {""}
        everything = fixed_captions(frozenset(names))
        classes = [Caption(word, classes=(name,)) for name in sorted(names) for word in class_words(name)]
        colours = sorted({(truth.colour, truth.class_name) for truth in self.crops.truths if truth.class_name})
        properties = [
            Caption(f"{colour} {class_words(name)[0]}", classes=(name,), colour=colour) for colour, name in colours
        ]
        relative = _relative_captions([self.crops.truths[row] for row in np.flatnonzero(shown)])
        return [
            self.average_precision("instance words", classes, exact),
            self.average_precision("affordances and group words", everything, exact),
            self.average_precision("colour and class", properties, exact),
            self.average_precision("relations", relative, shown),
            self.relation_choice(shown),
        ]

    def average_precision(self, label: str, captions: Sequence[Caption], chosen: BoolArray) -> Figure:
        """Mean average precision of crops ranked by each caption; chance is the mean share of matching crops."""
        rows = np.flatnonzero(chosen)
        similarity = self.similarity(rows, [caption.text for caption in captions])
        precisions, shares = [], []
        for caption, of_caption in zip(captions, similarity.T, strict=True):
            is_true = np.array([caption.is_true_of(self.crops.truths[row]) for row in rows])
            if is_true.sum() >= MIN_POSITIVES:
                hits = is_true[np.argsort(-of_caption, kind="stable")]
                precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
                precisions.append(float(precision[hits].mean()))
                shares.append(float(is_true.mean()))
        name = f"mean average precision: text to crop, {label}"
        return Figure(name, _mean(np.array(precisions)), _mean(np.array(shares)), len(precisions))

    def relation_choice(self, shown: BoolArray) -> Figure:
        """How often the true neighbour's caption scores above that of a neighbour that the same class has elsewhere."""
        rows = [row for row in np.flatnonzero(shown) if self.crops.truths[row].neighbours]
        captions = _relative_captions([self.crops.truths[row] for row in rows])
        texts = self.encoder.encode_texts([caption.text for caption in captions])
        by_subject: dict[tuple[str, str], list[int]] = {}
        for index, caption in enumerate(captions):
            by_subject.setdefault((caption.classes[0], caption.relation), []).append(index)
        wins = []
        for row in rows:
            truth = self.crops.truths[row]
            for relation in sorted({near.relation for near in truth.neighbours}):
                candidates = by_subject.get((truth.class_name, relation), [])
                is_true = np.array([captions[index].is_true_of(truth) for index in candidates], bool)
                if is_true.any() and not is_true.all():
                    scores = texts[candidates] @ self.features[row]
                    wins.append(float((scores[is_true][:, None] > scores[~is_true][None]).mean()))
        return Figure("pairwise: true neighbour before a false one", _mean(np.array(wins)), 0.5, len(wins))


def _relative_captions(truths: Sequence[CropTruth]) -> list[Caption]:
    relations = {
        (truth.class_name, near.relation, near.class_name)
        for truth in truths
        for near in truth.neighbours
        if near.class_name not in SURFACES
    }
    return [
        Caption(
            f"{class_words(name)[0]} {relation} {class_words(other)[0]}", (name,), relation=relation, others=(other,)
        )
        for name, relation, other in sorted(relations)
    ]


def _tops(what: str, rank: Int64Array, n_candidates: int, places: Sequence[int] = (1,)) -> list[Figure]:
    """How often the true one of ``n_candidates`` is among the first of each of ``places``."""
    n_candidates = max(1, n_candidates)
    return [Figure(f"top-{k}: {what}", _mean(rank < k), k / n_candidates, len(rank)) for k in places]


def _ranks(similarity: Float32Array, truth: Int64Array) -> Int64Array:
    """Number of candidates ranked before the true one in each row."""
    own = similarity[np.arange(len(truth)), truth]
    return np.asarray((similarity > own[:, None]).sum(axis=1), np.int64)


def _interval_over(homes: Int64Array, is_right: BoolArray) -> tuple[float, float] | None:
    """The 95 % interval of a share by drawing homes with replacement 2000 times."""
    n, right = np.bincount(homes), np.bincount(homes, is_right)
    n, right = n[n > 0], right[n > 0]
    if len(n) < 2:
        return None
    drawn = np.random.default_rng(0).integers(0, len(n), (2000, len(n)))
    low, high = np.percentile(right[drawn].sum(axis=1) / n[drawn].sum(axis=1), (2.5, 97.5))
    return float(low), float(high)


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values, dtype=np.float64)) if len(values) else 0.0


if TYPE_CHECKING:
    from training_loop import Towers, TrainingPlan

logger = logging.getLogger(__name__)

PROGRAM = "tools/train_encoder.py"
CARD_JSON, CARD_TEXT = "model_card.json", "model_card.md"


@dataclass(frozen=True)
class Order:
    """What to train on and for how long."""

    out: Path
    cache: Path
    homes: int
    measured_homes: int
    frames_per_home: int
    minutes: float
    seed: int
    jobs: int
    max_steps: int | None
    snapshot_minutes: float | None


def run(order: Order) -> tuple[Figure, ...]:
    """Renders, trains, exports and measures; writes the two ONNX files and the model card into ``order.out``."""
    for package in ("torch", "onnx"):
        require(package, "training")
    from training_loop import TrainingPlan, train

    names = home_names(TRAINING, order.homes)
    crops = make_crops(names, order.frames_per_home, order.seed, order.cache, order.jobs)
    other_names = home_names(MEASURED, order.measured_homes, FIRST_MEASURED_NUMBER)
    others = make_crops(other_names, order.frames_per_home, order.seed, order.cache, order.jobs)
    logger.info("%d crops to train on, %d to measure on", len(crops), len(others))
    plan = TrainingPlan(
        order.minutes,
        order.seed,
        max_steps=order.max_steps,
        threads=order.jobs,
        snapshot_minutes=order.snapshot_minutes,
    )
    towers = train(crops, plan, keep=lambda snapshot: export(snapshot, order.out))
    export(towers, order.out)
    encoder = EmbeddedEncoder(order.out)
    trained = sorted({truth.class_name for truth in crops.truths} - {""})
    class_names = sorted({*trained, *(truth.class_name for truth in others.truths)} - {""})
    features = encoder.encode_shrunk(others.pixels, others.log_sizes)
    figures = measure(encoder, others, features, class_names)
    difference = largest_difference(towers, order.out, others.first(256), [*class_names, "plant on a shelf"])
    models = sorted({truth.model for truth in crops.truths} - {""})
    _write_card(order, plan, towers, (len(crops), len(others)), (trained, models), figures, difference)
    return figures


def export(towers: Towers, folder: Path) -> None:
    """Write the two ONNX files to ``folder``, each to a temporary name first and then moved."""
    import torch

    pixels = torch.zeros(1, IMAGE_SIZE, IMAGE_SIZE, 3, dtype=torch.uint8)
    inputs_of_image = {"pixels": pixels, "log_size": torch.zeros(1, 2)}
    inputs_of_text = {"ids": torch.zeros(1, N_WORDS, N_IDS, dtype=torch.int64)}
    for tower, inputs, name in ((towers.image, inputs_of_image, IMAGE_FILE), (towers.text, inputs_of_text, TEXT_FILE)):
        tower = tower.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        axes = {axis: {0: "n"} for axis in (*inputs, "features")}
        export_onnx(tower, inputs, folder / name, ["features"], axes)


def largest_difference(towers: Towers, folder: Path, crops: CropSet, texts: list[str]) -> float:
    """The largest absolute difference of any feature between torch and ONNX Runtime, over ``crops`` and ``texts``."""
    import torch

    encoder = EmbeddedEncoder(folder)
    with torch.inference_mode():
        images = towers.image(torch.from_numpy(crops.pixels), torch.from_numpy(crops.log_sizes)).numpy()
        captions = towers.text(torch.from_numpy(token_ids(texts))).numpy()
    of_images = np.abs(images - encoder.encode_shrunk(crops.pixels, crops.log_sizes)).max()
    of_texts = np.abs(captions - encoder.encode_texts(texts)).max()
    return float(max(of_images, of_texts))


def _write_card(
    order: Order,
    plan: TrainingPlan,
    towers: Towers,
    n_crops: tuple[int, int],
    trained_on: tuple[Sequence[str], Sequence[str]],
    figures: Sequence[Figure],
    difference: float,
) -> None:
    files = {name: file_bytes(order.out / name) for name in (IMAGE_FILE, TEXT_FILE)}
    card = {
        "name": EmbeddedEncoder.name,
        "digest": EmbeddedEncoder(order.out).digest,
        "dimensions": DIM,
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()
        },
        "training": {
            "homes": order.homes,
            "frames_per_home": order.frames_per_home,
            "crops": n_crops[0],
            "seed": order.seed,
            "batch_size": plan.batch_size,
            "learning_rate": plan.learning_rate,
            "weight_decay": plan.weight_decay,
            "steps": towers.n_steps,
            "crops_seen": towers.n_crops_seen,
            "minutes": round(towers.minutes, 1),
            "threads": plan.threads,
            "classes": list(trained_on[0]),
            "models": list(trained_on[1]),
        },
        "measured": {
            "homes": order.measured_homes,
            "first_home": f"{MEASURED}{FIRST_MEASURED_NUMBER}",
            "crops": n_crops[1],
            "figures": [asdict(figure) for figure in figures],
        },
        "largest_difference_from_torch": difference,
    }
    (order.out / CARD_JSON).write_text(json.dumps(card, indent=1) + "\n")
    header = "# The classes that the encoder was trained on, which are the names that regions can get.\n"
    (order.out / "vocabulary.txt").write_text(header + "".join(f"{name}\n" for name in trained_on[0]))
    template = file_text(Path(__file__).parent / "model_card.md.j2")
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    text = environment.from_string(template).render(card, program=PROGRAM, card_json=CARD_JSON)
    (order.out / CARD_TEXT).write_text(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; prints the table of values."""
    parser = argparse.ArgumentParser(prog=f"python {PROGRAM}", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for the two ONNX files and the model card")
    parser.add_argument("--cache", type=Path, help="folder for rendered crops; default: OUT/crops")
    parser.add_argument("--homes", type=int, default=150)
    parser.add_argument("--measured-homes", type=int, default=24)
    parser.add_argument("--frames-per-home", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--max-steps", type=int, help="maximum number of steps")
    parser.add_argument("--snapshot-minutes", type=float, help="export a snapshot every N minutes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="rendering processes and training threads")
    given = parser.parse_args(arguments)
    values = {**vars(given), "cache": given.cache or given.out / "crops"}
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
    try:
        figures = run(Order(**values))
    except Su3dError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    for figure in figures:
        sys.stdout.write(
            f"{100 * figure.value:6.1f} %  (chance {100 * figure.chance:.2f} %, n {figure.n})  {figure.name}\n"
        )
    return 0


if __name__ == "__main__":
    with doors():
        status = main()
    sys.exit(status)
