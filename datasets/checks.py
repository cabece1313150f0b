"""Check of a scene: counts and faults of every file and every frame, and whether frames and ground truth align.

Readers stop at the first fault, the check continues: a dataset that has ``problems(scene)`` lists its faults
itself, one line each, and every file that it lists is checked.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Container, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import (
    DataError,
    FramesMissing,
    GroundTruthMissing,
    PlugInError,
    Su3dError,
    error_line,
    printable,
)
from su3d_bench.core.interfaces import Dataset, ProvidesUpAxis, ReportsProblems
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Frame, GroundTruth, WorldUp
from su3d_bench.datasets.frame_checks import (
    Finding,
    FrameFacts,
    Meeting,
    Severity,
    check_frames,
    check_truth,
    facts_of,
)
from su3d_bench.datasets.recordings.pose_convention import guess_up, judge_scene
from su3d_bench.formats.images import decode_colour, decode_depth, read_bytes

SAMPLED_FRAMES = 20
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".ppm", ".pgm"}
FILE_FRAME = re.compile(r"\bframe \d")
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class DepthStatistics:
    """Over the frames read: minimum 1st percentile, median of medians, maximum 99th percentile, mean share of
    pixels with a depth."""

    near_m: float
    median_m: float
    far_m: float
    valid_share: float


@dataclass(frozen=True)
class TruthVariant:
    """One form of ground truth: its counts, or the ``reason`` why it is missing."""

    variant: str
    reason: str | None
    n_points: int = 0
    n_objects: int = 0
    n_classes: int = 0


@dataclass(frozen=True)
class Inspection:
    """Result of checking a scene; ``digest`` is the data key that results of this scene carry.

    ``n_frames`` is None if the frames cannot be counted; ``n_read`` of them were read. ``meeting`` is None without
    ground truth or frames; ``up`` (the axis of the files that points up) is None if no frame was read.
    """

    scene: str
    n_frames: int | None
    n_read: int
    n_files: int
    size: tuple[int, int] | None
    depth: DepthStatistics | None
    up: WorldUp | None
    truth: tuple[TruthVariant, ...]
    meeting: Meeting | None
    digest: str | None
    findings: tuple[Finding, ...]
    elapsed_s: float

    def count(self, severity: Severity) -> int:
        return sum(finding.severity == severity for finding in self.findings)


Progress = Callable[[int, int], None]


def inspect(
    dataset: Dataset,
    scene: str,
    *,
    is_quick: bool = False,
    n_threads: int = 1,
    progress: Progress = lambda n_done, n_frames: None,
) -> Inspection:
    """Check all of ``scene``, continuing after each fault; ``progress`` gets (frames read, frames to read).

    All frames are read, by ``n_threads`` threads; only ``SAMPLED_FRAMES`` evenly spaced ones if ``is_quick`` or
    if the scene is generated on demand and has no file that could be damaged.
    """
    started, findings = time.perf_counter(), _Findings(f"{dataset.name}/{scene}")
    with _warnings_as_findings(findings):
        n_problems = _ask_for_problems(dataset, scene, findings)
        listed = findings.attempt("file", lambda: tuple(dataset.files(scene)))
        files, is_made_on_demand = listed or (), listed == () and not n_problems
        frames = _counted_frames(dataset, scene, findings)
        facts: list[FrameFacts] = []
        if frames is not None:
            positions = _positions(len(frames), is_quick or is_made_on_demand)
            facts = _read_frames(frames, positions, findings, 1 if is_made_on_demand else n_threads, progress)
        _check_files(files, findings, decode=frames is None)
        findings.add(*check_frames(facts))
        up = None
        if frames is not None and facts:
            is_whole = len(facts) == len(positions)
            if is_whole and not is_made_on_demand:
                _check_convention(dataset, scene, frames, findings)
            up = _check_up_axis(dataset, scene, facts, frames if is_whole else (), findings)
        truth, known = _check_ground_truth(dataset, scene, findings)
        meeting = None
        if known is not None and facts:
            meeting, meeting_findings = check_truth(facts, known.points, known.boxes)
            findings.add(*meeting_findings)
        digest = findings.attempt("digest", lambda: dataset.digest(scene))
    return Inspection(
        scene=findings.scene,
        n_frames=None if frames is None else len(frames),
        n_read=len(facts),
        n_files=len(files),
        size=(facts[0].width, facts[0].height) if facts else None,
        depth=_depth_statistics(facts),
        up=up,
        truth=truth,
        meeting=meeting,
        digest=digest,
        findings=findings.sorted(),
        elapsed_s=time.perf_counter() - started,
    )


class _Findings:
    """Collects the findings of one scene; a fault found by several steps is kept once, at its highest severity."""

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self._findings: dict[tuple[str, str], Finding] = {}

    @property
    def n(self) -> int:
        return len(self._findings)

    def add(self, *findings: Finding) -> None:
        for finding in findings:
            text = printable(finding.text.removeprefix(f"{self.scene}: ").removeprefix(f"{finding.where}: "))
            where = printable(finding.where)
            keys = [(place, text) for place in (where, "") if (place, text) in self._findings] or [(where, text)]
            known = self._findings.get(keys[0])
            if known is None or SEVERITIES.index(finding.severity) < SEVERITIES.index(known.severity):
                self._findings[keys[0]] = Finding(finding.severity, finding.check, keys[0][0], text)

    def add_fault(self, check: str, where: str, error: BaseException) -> None:
        """Add a finding for an exception, unless it is about a file whose fault is known."""
        text = str(error) if isinstance(error, OSError) else error_line(error)
        text = printable(text.removeprefix(f"{self.scene}: "))
        first = text.partition(" ")[0].rstrip(":")
        is_of_a_file = "." in first and not FILE_FRAME.search(text)  # in a recording, other frames may be broken
        if not (is_of_a_file and self.mentions(Path(first))):
            self.add(Finding("error", check, where, text))

    def attempt(self, check: str, work: Callable[[], Any]) -> Any:
        """Result of ``work``; None if it fails, which is a finding unless only ground truth is missing."""
        try:
            return work()
        except GroundTruthMissing:
            return None
        except PlugInError:  # the code is at fault, not the data
            raise
        except (Su3dError, OSError) as error:
            self.add_fault(check, "", error)
            return None

    def mentions(self, path: Path) -> bool:
        """Whether a fault of this file is known; several steps find the same fault and word it differently."""
        parent, name = re.escape(path.parent.name), re.escape(path.name)
        named = re.compile(rf"(?:(?<![\w.-]){parent}/|(?<![\w./-])){name}(?!\w)")
        return any(path.name in text and named.search(text) for _, text in self._findings)

    def has_error(self, checks: Container[str]) -> bool:
        return any(finding.severity == "error" and finding.check in checks for finding in self._findings.values())

    def sorted(self) -> tuple[Finding, ...]:
        """Errors first, then warnings, then notes, each in the order they were found."""
        return tuple(sorted(self._findings.values(), key=lambda finding: SEVERITIES.index(finding.severity)))


@contextmanager
def _warnings_as_findings(findings: _Findings) -> Iterator[None]:
    """Turn warnings that readers log in the block into findings, as runs put them on record."""

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            findings.add(Finding("warning", "reader", "", record.getMessage()))

    listener, package = Listener(logging.WARNING), logging.getLogger("su3d_bench")
    package.addHandler(listener)
    try:
        yield
    finally:
        package.removeHandler(listener)


def _counted_frames(dataset: Dataset, scene: str, findings: _Findings) -> Sequence[Frame] | None:
    """The frames; None (a finding) if there are none or not as many as the dataset states."""
    try:
        info, frames = dataset.info(scene, 1), dataset.frames(scene, 1)
        if len(frames) != info.n_frames:
            raise DataError(f"the dataset states {info.n_frames} frames but returns {len(frames)}")
        if not len(frames):
            raise DataError("the scene has no frames")
    except FramesMissing as error:  # missing, but not faulty
        findings.add(Finding("warning", "frame", "", str(error)))
    except PlugInError:
        raise
    except (Su3dError, OSError) as error:
        findings.add_fault("frame", "", error)
    else:
        return frames
    return None


def _positions(n_frames: int, is_sampled: bool) -> Sequence[int]:
    if not is_sampled or n_frames <= SAMPLED_FRAMES:
        return range(n_frames)
    return [int(position) for position in np.linspace(0, n_frames - 1, SAMPLED_FRAMES)]


def _read_frames(
    frames: Sequence[Frame], positions: Sequence[int], findings: _Findings, n_threads: int, progress: Progress
) -> list[FrameFacts]:
    """Facts of the readable frames; each unreadable one becomes a finding."""

    def read(position: int) -> FrameFacts | BaseException:
        try:
            return facts_of(frames[position])
        except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything; every broken frame is named
            return error

    facts = []
    pool = ThreadPoolExecutor(n_threads)
    try:
        progress(0, len(positions))
        for n_done, (position, outcome) in enumerate(zip(positions, pool.map(read, positions), strict=True), 1):
            if isinstance(outcome, FrameFacts):
                facts.append(outcome)
            else:
                findings.add_fault("frame", f"frame {position}", outcome)
            progress(n_done, len(positions))
    finally:
        pool.shutdown(cancel_futures=True)
    return facts


def _ask_for_problems(dataset: Dataset, scene: str, findings: _Findings) -> int:
    """Add the faults that the dataset itself reports; return how many."""

    def ask() -> None:
        for line in dataset.problems(scene) if isinstance(dataset, ReportsProblems) else ():
            findings.add(Finding("error", "file", "", line))

    findings.attempt("file", ask)
    return findings.n


def _check_convention(dataset: Dataset, scene: str, frames: Sequence[Frame], findings: _Findings) -> None:
    """Check whether depth and poses agree between frames, if each is usable by itself."""
    if findings.has_error(("pose", "intrinsics", "size")):
        return
    verdict = findings.attempt("convention", lambda: judge_scene(dataset, scene, frames))
    if verdict is not None:
        findings.add(Finding("error" if verdict.is_wrong else "warning", "convention", "", verdict.line))


def _check_up_axis(
    dataset: Dataset, scene: str, facts: Sequence[FrameFacts], frames: Sequence[Frame], findings: _Findings
) -> WorldUp | None:
    """Which axis points up; a warning if z is assumed but the frames show another axis."""
    poses = np.array([frame.camera_to_world for frame in facts])
    up: WorldUp | None = findings.attempt(
        "up", lambda: dataset.up(scene) if isinstance(dataset, ProvidesUpAxis) else guess_up(poses, frames)
    )
    if up is not None and up.doubt is not None:
        findings.add(Finding("warning", "up", "", up.doubt))
    return up


def _check_files(files: Sequence[Path], findings: _Findings, *, decode: bool) -> None:
    """Report every file that is missing, empty or unreadable and, with ``decode``, every damaged image."""
    for path in files:
        name = f"{path.parent.name}/{path.name}"
        reason = _fault_of_file(path, name, decode)
        if reason is not None and not findings.mentions(path):
            findings.add(Finding("error", "file", "", reason))


def _fault_of_file(path: Path, name: str, decode: bool) -> str | None:
    try:
        if decode and path.suffix.lower() in IMAGE_SUFFIXES:
            content = read_bytes(path, name)
            is_depth = path.suffix.lower() == ".pgm" or content[24:26] == b"\x10\x00"  # a 16-bit PNG with one channel
            (decode_depth if is_depth else decode_colour)(content, name)
            return None
        with opened(path) as stream:
            return None if stream.read(1) else f"{name} is empty; copy the file again"
    except FileNotFoundError:
        return f"{name} is missing; copy the file again"
    except OSError as error:
        return f"{name} cannot be read: {error.strerror}"
    except DataError as error:
        return str(error)


def _check_ground_truth(
    dataset: Dataset, scene: str, findings: _Findings
) -> tuple[tuple[TruthVariant, ...], GroundTruth | None]:
    """Counts of every ground-truth variant, and the first one available."""
    rows: list[TruthVariant] = []
    known = None
    for variant in getattr(dataset, "variants", ()):
        try:
            truth = dataset.ground_truth(scene, variant)
        except DataError as error:
            if not isinstance(error, GroundTruthMissing):
                findings.add_fault("truth", "", error)
            rows.append(TruthVariant(variant, printable(str(error).removeprefix(f"{findings.scene}: "))))
            continue
        known = truth if known is None else known
        n_objects, n_classes = (len(np.unique(ids[ids > 0])) for ids in (truth.instance, truth.semantic))
        rows.append(TruthVariant(variant, None, len(truth.points), n_objects, n_classes))
    if known is not None:
        findings.attempt("truth", lambda: dataset.instance_mesh(scene))
    return tuple(rows), known


def _depth_statistics(facts: Sequence[FrameFacts]) -> DepthStatistics | None:
    with_depth = [frame for frame in facts if frame.valid_share > 0]
    if not with_depth:
        return None
    return DepthStatistics(
        near_m=min(frame.near_m for frame in with_depth),
        median_m=float(np.median([frame.median_m for frame in with_depth])),
        far_m=max(frame.far_m for frame in with_depth),
        valid_share=float(np.mean([frame.valid_share for frame in facts])),
    )
