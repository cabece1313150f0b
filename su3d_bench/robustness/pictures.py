"""Pictures of what corruptions do to one scene, and the figure of a sweep: the score against the severity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, GroundTruthMissing
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Float64Array, Frame, Int64Array, PerceptionNeeds, UInt8Array
from su3d_bench.corruptions.model import MAX_SEVERITY, Corruption, Recording, generator
from su3d_bench.corruptions.sensors.depth import edges
from su3d_bench.metrics.protocols.loading import headline_protocols, load_protocol
from su3d_bench.perception.profiles import PerceptionConfig, build_perception
from su3d_bench.reports.pictures.canvas import figure_style, write_figure
from su3d_bench.reports.pictures.plots import draw_legend, figure_with_panels, style_of_line
from su3d_bench.robustness.measures import MethodResult, SweepResult
from su3d_bench.runs.scene_data import poses_of
from su3d_bench.runs.scenes import cache_root

WIDTH, HEIGHT, TITLE = 200, 150, 22  # of a tile and its title, px
WHITE = (2 * HEIGHT, 2 * WIDTH, 3)
FAR_M = 6.0
N_UPDATES = 40  # of the picture of an order
BLUE, GREY = (0, 80, 200), (170, 170, 170)


@dataclass(frozen=True)
class CleanInputs:
    """What corruptions change of one scene: ``found`` are perfect masks, None without an annotated mesh."""

    scene: str
    recording: Recording
    found: Detections | None
    names: tuple[str, ...]


def clean_inputs(dataset: Any, scene: str, index: int | None) -> CleanInputs:
    """The inputs of a scene at frame ``index``, by default the middle one; raises ``ConfigError``."""
    frames = dataset.frames(scene, 1)
    index = len(frames) // 2 if index is None else index
    if index >= len(frames):
        raise ConfigError(f"--frame {index}: {dataset.name}/{scene} has frames 0 to {len(frames) - 1}")
    names = [entry.name for name in headline_protocols(dataset)[:1] for entry in load_protocol(name).classes]
    recording, info = Recording(frames, poses_of(dataset, scene), index), dataset.info(scene, 1)
    found = None
    with suppress(GroundTruthMissing):
        mesh = dataset.instance_mesh(scene)
        perception = build_perception("oracle", PerceptionConfig(), scene=info, cache_root=cache_root(), mesh=mesh)
        found = perception.detect(frames[index], PerceptionNeeds(), Timer())
    return CleanInputs(f"{dataset.name}/{scene}", recording, found, tuple(names))


def tiles(
    corruption: Corruption, inputs: CleanInputs, severities: Sequence[float] = range(MAX_SEVERITY + 1)
) -> Mapping[str, UInt8Array]:
    """Pictures by title of what a corruption does at each of ``severities``; empty if the scene lacks its input."""
    recording = inputs.recording
    every = np.arange(0, len(recording.frames), max(1, len(recording.frames) // N_UPDATES))
    clean: Any = {
        "frame": recording.frames[recording.index], "poses": recording.poses, "order": every,
        "detections": inputs.found, "names": inputs.names or None,
    }[corruption.stage]  # fmt: skip
    pictures: dict[str, UInt8Array] = {}
    for severity in severities if clean is not None else ():
        value, rng = corruption.value_at(severity), generator(corruption, 0, inputs.scene, recording.index)
        more = (recording,) if corruption.stage == "frame" else ()
        changed: Any = corruption.function(clean, value, rng, *more) if severity else clean
        pictures[f"{corruption.address} {severity:g}: {value:.4g}"] = _picture(corruption, changed, clean, recording)
    return pictures


def sheet(pictures: Mapping[str, UInt8Array], n_severities: int) -> UInt8Array:
    """All pictures with their titles: the severities of a corruption in one row, with up to eight pictures."""
    import cv2

    columns = n_severities * max(1, 8 // n_severities)
    n_rows = -(-len(pictures) // columns)
    result = np.full((n_rows * (HEIGHT + TITLE), columns * WIDTH, 3), 255, np.uint8)
    for k, (title, picture) in enumerate(pictures.items()):
        top, left = k // columns * (HEIGHT + TITLE), k % columns * WIDTH
        small = cv2.resize(picture, (WIDTH - 4, HEIGHT), interpolation=cv2.INTER_AREA)
        result[top + TITLE : top + TITLE + HEIGHT, left : left + WIDTH - 4] = small
        _write(result, title, left + 2, top + 15, 0.36)
    return result


def _picture(corruption: Corruption, changed: Any, clean: Any, recording: Recording) -> UInt8Array:
    if corruption.stage == "poses":
        return _path(changed, clean)
    if corruption.stage == "order":
        return _order(changed, len(recording.frames), len(clean))
    if corruption.stage == "detections":
        return _masks(changed)
    if corruption.stage == "names":
        return _names(changed, clean)
    if corruption.family == "depth":
        return _depth(changed)
    return _overlay(changed) if corruption.family in ("calibration", "time") else np.asarray(changed.rgb)


def _write(image: UInt8Array, text: str, x: int, y: int, size: float) -> None:
    import cv2

    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)


def _depth(frame: Frame) -> UInt8Array:
    """Nearer is brighter, missing is black."""
    import cv2

    scaled = np.clip(255 * (1 - frame.depth_m / FAR_M), 30, 255).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    return np.asarray(np.where(frame.depth_m[..., None] > 0, coloured, 0), np.uint8)


def _overlay(frame: Frame) -> UInt8Array:
    """Edges of depth in red on colour."""
    picture = frame.rgb.copy()
    picture[edges(frame.depth_m)] = (255, 0, 0)
    return picture


def _masks(found: Detections) -> UInt8Array:
    """The regions in colours that depend on their place, brighter with the score."""
    picture = np.full((*found.masks.shape[1:], 3), 30, np.uint8)
    for k, mask in enumerate(found.masks):
        picture[mask] = np.random.default_rng(k).integers(60, 200, 3) + int(55 * min(1.0, float(found.scores[k])))
    return picture


def _path(poses: Float64Array, clean: Float64Array) -> UInt8Array:
    """The trajectory and viewing directions from above, the clean trajectory in grey."""
    import cv2

    picture = np.full(WHITE, 255, np.uint8)
    low, high = clean[:, :2, 3].min(axis=0), clean[:, :2, 3].max(axis=0)
    scale = 0.85 * float((np.array(WHITE[1::-1]) / np.maximum(high - low, 1e-3)).min())
    middle = np.array(WHITE[1::-1]) / 2
    for path, colour in ((clean, GREY), (poses, BLUE)):
        at = ((path[:, :2, 3] - (low + high) / 2) * scale + middle).astype(np.int32)
        cv2.polylines(picture, [at[:, None]], False, colour, 2, cv2.LINE_AA)
        ahead = (at + 14 * path[:, :2, 2]).astype(np.int32)
        for start, end in list(zip(at.tolist(), ahead.tolist(), strict=True))[:: max(1, len(at) // 20)]:
            cv2.line(picture, start, end, colour, 1, cv2.LINE_AA)
    return picture


def _order(places: Int64Array, n_frames: int, n_updates: int) -> UInt8Array:
    """The frame of each update."""
    picture = np.full(WHITE, 255, np.uint8)
    for k, place in enumerate(places.tolist()):
        x = 10 + int(380 * k / max(len(places), n_updates))
        y = 290 - int(280 * place / n_frames)
        picture[max(y - 4, 0) : y + 4, max(x - 4, 0) : x + 4] = BLUE
    return picture


def _names(names: tuple[str, ...], clean: tuple[str, ...]) -> UInt8Array:
    """Some changed names, or some of the added ones."""
    picture = np.full(WHITE, 255, np.uint8)
    changed = [f"{old} > {new}" for old, new in zip(clean, names, strict=False) if old != new]
    lines = changed or [f"+ {name}" for name in names[len(clean) :]] or list(clean)
    for k, line in enumerate(lines[:9]):
        _write(picture, line[:38], 8, 30 + 31 * k, 0.62)
    return picture


PANEL_HEIGHT_IN = 2.1


@figure_style()
def draw_sweep(result: SweepResult, path: Path) -> None:
    """Write the figure as the format of ``path``, ``.png`` or ``.pdf``."""
    families = list(dict.fromkeys(family for method in result.methods for family in method.families))
    figure, axes = figure_with_panels("17cm", *[PANEL_HEIGHT_IN] * len(families))
    for family, panel in zip(families, axes, strict=True):
        for index, method in enumerate(result.methods):
            severities, values = _curve(method, family)
            panel.plot(severities, values, label=method.method, markersize=4, **style_of_line(index))
        panel.set_title(family)
        panel.set_xlim(-0.15, MAX_SEVERITY + 0.15)
        panel.set_ylim(0, 1.05 * 100 * max(method.clean for method in result.methods) or 1)
        panel.set_xlabel("severity")
        panel.set_ylabel(f"{result.metric}, %")
    draw_legend(figure, axes)
    write_figure(figure, path)


def _curve(method: MethodResult, family: str) -> tuple[list[float], list[float]]:
    """The mean value over the corruptions of a family at each severity, from the clean one on, in per cent."""
    values: dict[float, list[float]] = {0.0: [method.clean]}
    for one in method.cells:
        if one.cell.family == family:
            severity = max(condition.severity for condition in one.cell.conditions)
            values.setdefault(severity, []).append(one.difference.right)
    severities = sorted(values)
    return severities, [100 * float(np.mean(values[severity])) for severity in severities]
