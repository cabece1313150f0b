"""Train the embedded encoder on rendered rooms that no benchmark uses, export it and measure it.

    python -m su3d_bench.perception.embedded.training.train --out DIR --rooms 360 --minutes 30 --seed 0

Needs the models extra (torch, onnx). Time decides how many steps are made, so two trainings differ in their weights.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2
import numpy as np

from su3d_bench.core.errors import ModelMissing, Su3dError
from su3d_bench.core.printing import doors
from su3d_bench.core.system.files import file_bytes, file_text
from su3d_bench.perception.embedded.encoder import DIM, IMAGE_FILE, IMAGE_SIZE, TEXT_FILE, EmbeddedEncoder
from su3d_bench.perception.embedded.text import N_IDS, N_WORDS, token_ids
from su3d_bench.perception.embedded.training.crops import (
    FIRST_HELD_OUT_NUMBER,
    FIRST_TRAINING_NUMBER,
    CropSet,
    make_crops,
    room_names,
)
from su3d_bench.perception.embedded.training.evaluation import Figure, measure
from su3d_bench.perception.models.onnx.export import export_onnx

if TYPE_CHECKING:
    from su3d_bench.perception.embedded.training.loop import Towers, TrainingPlan

logger = logging.getLogger(__name__)

PROGRAM = "su3d_bench.perception.embedded.training.train"
CARD_JSON, CARD_TEXT = "model_card.json", "model_card.md"


@dataclass(frozen=True)
class Order:
    """What to train on and for how long."""

    out: Path
    cache: Path
    rooms: int
    held_out_rooms: int
    frames_per_room: int
    minutes: float
    seed: int
    jobs: int
    max_steps: int | None
    snapshot_minutes: float | None


def run(order: Order) -> tuple[Figure, ...]:
    """Renders, trains, exports and measures; writes the two ONNX files and the model card into ``order.out``."""
    for package in ("torch", "onnx"):
        if importlib.util.find_spec(package) is None:
            raise ModelMissing(f"training needs {package}: pip install 'su3d-bench[models]'")
    from su3d_bench.perception.embedded.training.loop import TrainingPlan, train

    names = room_names(order.rooms, FIRST_TRAINING_NUMBER)
    crops = make_crops(names, order.frames_per_room, order.seed, order.cache, order.jobs)
    held_names = room_names(order.held_out_rooms, FIRST_HELD_OUT_NUMBER)
    held_out = make_crops(held_names, order.frames_per_room, order.seed, order.cache, order.jobs)
    logger.info("%d crops to train on, %d held out", len(crops), len(held_out))
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
    class_names = sorted({truth.class_name for truth in crops.truths} - {""})
    features = encoder.encode_shrunk(held_out.pixels, held_out.log_sizes)
    figures = measure(encoder, held_out, features, class_names)
    difference = largest_difference(towers, order.out, held_out.first(256), [*class_names, "plant on a shelf"])
    _write_card(order, plan, towers, (len(crops), len(held_out)), class_names, figures, difference)
    return figures


def export(towers: Towers, folder: Path) -> None:
    """The two ONNX files in ``folder``, each written beside its place first and then moved there."""
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
    class_names: Sequence[str],
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
            "rooms": order.rooms,
            "first_room_number": FIRST_TRAINING_NUMBER,
            "frames_per_room": order.frames_per_room,
            "crops": n_crops[0],
            "seed": order.seed,
            "batch_size": plan.batch_size,
            "learning_rate": plan.learning_rate,
            "weight_decay": plan.weight_decay,
            "steps": towers.n_steps,
            "crops_seen": towers.n_crops_seen,
            "minutes": round(towers.minutes, 1),
            "threads": plan.threads,
            "classes": list(class_names),
        },
        "held_out": {
            "rooms": order.held_out_rooms,
            "first_room_number": FIRST_HELD_OUT_NUMBER,
            "crops": n_crops[1],
            "figures": [asdict(figure) for figure in figures],
        },
        "largest_difference_from_torch": difference,
    }
    (order.out / CARD_JSON).write_text(json.dumps(card, indent=1) + "\n")
    template = file_text(Path(__file__).parent / "model_card.md.j2")
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    text = environment.from_string(template).render(card, program=PROGRAM, card_json=CARD_JSON)
    (order.out / CARD_TEXT).write_text(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; the answer is the table of figures."""
    parser = argparse.ArgumentParser(prog=f"python -m {PROGRAM}", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for the two ONNX files and the model card")
    parser.add_argument("--cache", type=Path, help="folder for rendered crops; default: OUT/crops")
    parser.add_argument("--rooms", type=int, default=360)
    parser.add_argument("--held-out-rooms", type=int, default=24)
    parser.add_argument("--frames-per-room", type=int, default=6)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--max-steps", type=int, help="end earlier, after this many steps")
    parser.add_argument("--snapshot-minutes", type=float, help="also export what there is, every so many minutes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="processes that render, threads that train")
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
