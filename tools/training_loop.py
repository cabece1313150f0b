"""Contrastive training of the two towers on the CPU."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch_towers import ImageTower, TextTower
from training_captions import (
    Caption,
    TruthTable,
    class_caption,
    draw_caption,
    fixed_captions,
    room_caption,
    wrong_relation,
)
from training_crops import CropSet

from su3d_bench.core.types import Float32Array, Int64Array, UInt8Array
from su3d_bench.perception.embedded.lexicon import PADDING, token_ids

logger = logging.getLogger(__name__)

# Cosines are compared at this scale in training and, as temperature 1 / 20, when naming regions.
LOGIT_SCALE = 20.0
CAPTIONS_PER_CROP = 1
FIXED_CAPTIONS = 40
WRONG_RELATIONS = 32
UNKNOWN_WORDS = 0.06


@dataclass(frozen=True)
class TrainingPlan:
    """Duration and learning rate, which rises for ``warm_up`` of the time and falls as a cosine to 1 %.

    ``batch_size`` is the number of crops of a step over all ``threads``.
    """

    minutes: float
    seed: int
    batch_size: int = 256
    learning_rate: float = 3e-3
    weight_decay: float = 0.05
    warm_up: float = 0.04
    max_steps: int | None = None
    threads: int = 2
    snapshot_minutes: float | None = None


@dataclass(frozen=True)
class Towers:
    """Both towers in evaluation mode, and how they were trained."""

    image: ImageTower
    text: TextTower
    n_steps: int
    n_crops_seen: int
    minutes: float


def train(crops: CropSet, plan: TrainingPlan, keep: Callable[[Towers], None]) -> Towers:
    """Train towers on ``crops`` until the time or steps of ``plan`` are over; ``keep`` receives the snapshots.

    Each thread works on a separate batch and the gradients are averaged: threads then synchronize once per step, while
    torch's own threads would synchronize in every operation and wait for each other on a busy machine.
    """
    torch.manual_seed(plan.seed)
    image, text = ImageTower(), TextTower()
    image.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    parameters = [*image.parameters(), *text.parameters()]
    optimizer = torch.optim.AdamW(parameters, plan.learning_rate, weight_decay=plan.weight_decay, fused=True)
    sources = [Batches(crops, (plan.seed, lane), plan.batch_size // plan.threads) for lane in range(plan.threads)]

    def gradients(source: Batches) -> tuple[float, tuple[Tensor, ...]]:
        loss = _loss(image, text, source.draw())
        return float(loss.detach()), torch.autograd.grad(loss, parameters)

    started, step, running, n_kept = time.monotonic(), 0, 0.0, 0
    with ThreadPoolExecutor(plan.threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        while (done := _part_done(plan, started, step)) < 1.0:
            answers = list(pool.map(gradients, sources))
            for parameter, *parts in zip(parameters, *(of_lane for _, of_lane in answers), strict=True):
                parameter.grad = sum(parts[1:], parts[0]) / len(parts)
            torch.nn.utils.clip_grad_norm_(parameters, 5.0)
            for group in optimizer.param_groups:
                group["lr"] = plan.learning_rate * _rate(done, plan.warm_up)
            optimizer.step()
            step += 1
            loss = float(np.mean([value for value, _ in answers]))
            running = loss if step == 1 else 0.98 * running + 0.02 * loss
            minutes = (time.monotonic() - started) / 60.0
            if step % 100 == 0:
                logger.info("step %d, %.1f minutes: loss %.3f", step, minutes, running)
            if plan.snapshot_minutes is not None and minutes >= (n_kept + 1) * plan.snapshot_minutes:
                n_kept += 1
                keep(_towers(image, _without_unseen_rows(text, optimizer), step, plan, minutes))
    minutes = (time.monotonic() - started) / 60.0
    return _towers(image, _without_unseen_rows(text, optimizer), step, plan, minutes)


def _part_done(plan: TrainingPlan, started: float, step: int) -> float:
    of_time = (time.monotonic() - started) / (60.0 * plan.minutes)
    return of_time if plan.max_steps is None else max(of_time, step / plan.max_steps)


def _without_unseen_rows(text: TextTower, optimizer: torch.optim.Optimizer) -> TextTower:
    """A copy with zeros in table rows not used by any caption, so that unknown words contribute nothing, not noise."""
    known = copy.deepcopy(text)
    has_moved = optimizer.state[text.table]["exp_avg_sq"].sum(1) > 0
    with torch.no_grad():
        known.table[~has_moved] = 0.0
    return known


def _towers(image: ImageTower, text: TextTower, n_steps: int, plan: TrainingPlan, minutes: float) -> Towers:
    copies = copy.deepcopy(image).eval(), copy.deepcopy(text).eval()
    return Towers(*copies, n_steps, n_steps * plan.batch_size, minutes)


def _rate(done: float, warm_up: float) -> float:
    if done < warm_up:
        return max(done / warm_up, 0.01)
    return 0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * (done - warm_up) / (1.0 - warm_up))))


@dataclass(frozen=True)
class Batch:
    """One step's crops and captions. The first ``n_classes`` captions state one class each, in class order.

    ``classes`` (B,) is -1 for a whole image; ``matches`` (T, B) which caption is true of which crop.
    """

    pixels: Tensor
    log_sizes: Tensor
    ids: Tensor
    n_classes: int
    classes: Tensor
    matches: Tensor


class Batches:
    """Random batches of augmented crops, with rarer classes drawn more often than they occur."""

    def __init__(self, crops: CropSet, seed: Sequence[int], batch_size: int) -> None:
        self._crops = crops
        self._table = TruthTable(crops.truths)
        self._rng = np.random.default_rng(seed)
        self._batch_size = batch_size
        self._fixed = fixed_captions(frozenset(self._table.class_names))
        classes = self._table.class_of
        counts = np.bincount(classes + 1, minlength=len(self._table.class_names) + 1).astype(np.float64)
        # Square-root sampling: between the rooms' frequencies and uniform classes. Whole images count three times.
        weights = 1.0 / np.sqrt(np.maximum(counts, 1.0))
        weights[0] *= 3.0
        weight = weights[classes + 1]
        self._cumulative = np.cumsum(weight / weight.sum())

    def draw(self) -> Batch:
        """The next batch."""
        rng = self._rng
        chosen = np.searchsorted(self._cumulative, rng.random(self._batch_size)).clip(max=len(self._crops) - 1)
        chosen = chosen.astype(np.int64)
        names = self._table.class_names
        captions = [class_caption(name, rng) for name in names]
        captions += [self._fixed[index] for index in rng.choice(len(self._fixed), FIXED_CAPTIONS, replace=False)]
        drawn = [draw_caption(self._crops.truths[index], rng) for index in chosen for _ in range(CAPTIONS_PER_CROP)]
        related = [caption for caption in drawn if caption.relation and caption.classes][:WRONG_RELATIONS]
        captions += [*drawn, *(wrong_relation(caption, names, rng) for caption in related)]
        captions += self._rooms(chosen)
        return Batch(
            torch.from_numpy(augment(self._crops.pixels[chosen], rng)),
            torch.from_numpy(self._jittered_sizes(chosen)),
            torch.from_numpy(self._ids(captions)),
            len(names),
            torch.from_numpy(self._table.class_of[chosen]),
            torch.from_numpy(self._table.matches(captions, chosen)),
        )

    def _ids(self, captions: list[Caption]) -> Int64Array:
        ids = token_ids([caption.text for caption in captions])
        # Positions beyond all captions of the batch do not affect the tower but cost as much as the others.
        ids = ids[:, : max(1, int((ids[:, :, 0] != PADDING).sum(axis=1).max()))]
        # Sometimes a word is represented only by its 4-grams, so that they carry meaning.
        ids[:, :, :2][self._rng.random(ids.shape[:2]) < UNKNOWN_WORDS] = PADDING
        return ids

    def _rooms(self, chosen: Int64Array) -> list[Caption]:
        whole = chosen[self._table.class_of[chosen] < 0]
        return [room_caption(room, self._rng) for room in sorted({self._crops.truths[index].room for index in whole})]

    def _jittered_sizes(self, chosen: Int64Array) -> Float32Array:
        # Other image sizes and lenses: a crop may be half or twice as large in pixels (0.5 is a factor of two).
        common = self._rng.normal(0.0, 0.2, (len(chosen), 1))
        single = self._rng.normal(0.0, 0.03, (len(chosen), 2))
        return (self._crops.log_sizes[chosen] + common + single).astype(np.float32)


def augment(pixels: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """``pixels`` randomly mirrored, relit, tinted, shifted slightly, and with a patch hidden."""
    n = len(pixels)
    out = pixels.astype(np.float32)
    mirrored = rng.random(n) < 0.5
    out[mirrored] = out[mirrored, :, ::-1]
    gain = np.exp(rng.normal(0.0, 0.18, (n, 1, 1, 1)))
    tint = np.exp(rng.normal(0.0, 0.04, (n, 1, 1, 3)))
    contrast = np.exp(rng.normal(0.0, 0.12, (n, 1, 1, 1)))
    middle = out.mean(axis=(1, 2, 3), keepdims=True)
    out = ((out - middle) * contrast.astype(np.float32) + middle) * (gain * tint).astype(np.float32)
    for row in np.flatnonzero(rng.random(n) < 0.25).tolist():
        out[row] += rng.uniform(2.0, 7.0) * rng.standard_normal(out[row].shape, np.float32)
    shifts = rng.integers(-3, 4, (n, 2))
    sides, corners = rng.integers(8, 26, (n, 2)), rng.integers(0, 56, (n, 2))
    hidden, fills = rng.random(n) < 0.25, rng.uniform(0.0, 255.0, (n, 3)).astype(np.float32)
    for row in range(n):
        if shifts[row].any():
            out[row] = np.roll(out[row], shifts[row], axis=(0, 1))
        if hidden[row]:
            top, left = corners[row]
            out[row, top : top + sides[row, 0], left : left + sides[row, 1]] = fills[row]
    return np.asarray(np.clip(out + 0.5, 0.0, 255.0), np.uint8)


def _loss(image: ImageTower, text: TextTower, batch: Batch) -> Tensor:
    """Class cross-entropy over the class captions, and a contrastive loss in which every true pair is a positive."""
    logits = LOGIT_SCALE * text(batch.ids) @ image(batch.pixels, batch.log_sizes).T
    has_class = batch.classes >= 0
    by_class = logits[: batch.n_classes, has_class].T
    class_loss = functional.cross_entropy(by_class, batch.classes[has_class], label_smoothing=0.02)
    positives = batch.matches.float()
    return class_loss + 0.5 * (_multi_positive(logits.T, positives.T) + _multi_positive(logits, positives))


def _multi_positive(logits: Tensor, positives: Tensor) -> Tensor:
    """Cross-entropy of each row's softmax against its positives, equally weighted; rows without any are skipped."""
    n_positives = positives.sum(1)
    rows = n_positives > 0
    targets = positives[rows] / n_positives[rows, None]
    return -(targets * functional.log_softmax(logits[rows], dim=1)).sum(1).mean()
