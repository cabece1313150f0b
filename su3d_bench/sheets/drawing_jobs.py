"""The pictures of many drafts, several scenes side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import DataError
from su3d_bench.reports.pictures.heat_scales import Scale
from su3d_bench.runs.executors.local import Event, Report, run_inline, run_processes
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.drafts import Draft
from su3d_bench.sheets.drawing import Artist
from su3d_bench.sheets.run_source import RunSource

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SceneDrafts:
    """What one process draws: ``places`` of the drafts of one scene among all."""

    run: Path
    methods: tuple[str, ...]
    scale: Scale
    places: tuple[int, ...]
    drafts: tuple[Draft, ...]


@dataclass(frozen=True)
class DrawnScene:
    """The PNG of each draft; ``lost`` says why there are none."""

    places: tuple[int, ...]
    pictures: tuple[bytes, ...]
    lost: str = ""


def draw_all(
    source: RunSource,
    scale: Scale,
    drafts: Sequence[Draft],
    jobs: int,
    progress: Progress = lambda n_done, n: None,
) -> list[bytes]:
    """The pictures of ``drafts`` in their order, ``jobs`` scenes at once; the same bytes whatever their number."""
    units = []
    for scene in dict.fromkeys(one.scene for one in drafts):
        places = tuple(k for k, one in enumerate(drafts) if one.scene == scene)
        mine = tuple(drafts[k] for k in places)
        units.append(SceneDrafts(source.run.folder.path, source.methods, scale, places, mine))
    n_done = 0

    def report(event: Event) -> None:
        nonlocal n_done
        n_done += 1
        progress(n_done, len(drafts))

    if jobs == 1 or len(units) == 1:
        found = run_inline(draw_scene, units, report)
    else:
        found = run_processes(draw_scene, units, report, jobs=jobs, lost=_lost)
    pictures: dict[int, bytes] = {}
    for drawn in found:
        if drawn.lost:
            raise DataError(drawn.lost)
        pictures.update(zip(drawn.places, drawn.pictures, strict=True))
    return [pictures[k] for k in range(len(drafts))]


def draw_scene(unit: SceneDrafts, report: Report) -> DrawnScene:
    """The pictures of one scene."""
    artist = Artist(RunSource(read_run(unit.run), unit.methods), unit.scale)
    pictures = []
    for k, draft in enumerate(unit.drafts):
        pictures.append(artist.draw(draft))
        report(Event(draft.scene, "pictures", k + 1, len(unit.drafts)))
    return DrawnScene(unit.places, tuple(pictures))


def _lost(unit: SceneDrafts, how: str) -> DrawnScene:
    scene = unit.drafts[0].scene
    return DrawnScene(unit.places, (), f"{scene}: the process that drew its pictures {how}; try --jobs 1")
