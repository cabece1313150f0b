"""Which prediction file belongs to which scene of the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ConfigError, PredictionError, StoreError, printable, shown, suggest
from su3d_bench.predictions.base import Reader
from su3d_bench.predictions.formats import recognise
from su3d_bench.predictions.own_runs import OwnRuns
from su3d_bench.store.records import RequestRecord, read_record


@dataclass(frozen=True)
class Source:
    """One path of predictions, its reader, and the names that its files give to scenes."""

    path: Path
    reader: Reader
    scenes: tuple[str, ...]

    def dataset_of(self, name: str) -> str | None:
        """The dataset in a name such as ``rooms/living0``."""
        return name.partition("/")[0] if "/" in name else None


@dataclass(frozen=True)
class Match:
    """The prediction of one scene: ``name`` as ``source`` calls it, ``scene`` as the ground truth does."""

    scene: str
    name: str
    source: Source


def open_sources(paths: Sequence[Path], format: str | None) -> list[Source]:
    """Every path with the reader that knows it."""
    if not paths:
        raise ConfigError("evaluate: no predictions were named; give a folder or files")
    sources = []
    for path in paths:
        reader = recognise(path, format)
        scenes = tuple(reader.scenes(path))
        if not scenes:
            raise PredictionError(f"{shown(path)}: has no prediction in the format {reader.name}")
        sources.append(Source(path, reader, scenes))
    return sources


def match_scenes(
    sources: Sequence[Source], known: Sequence[str], dataset: str | None, where: str, requested: Sequence[str] = ()
) -> tuple[list[Match], list[str]]:
    """The prediction of each scene of ``known`` that has one, in that order, and remarks.

    Names agree when they are equal without case, ``_`` and ``-``; otherwise the only name that goes on after the
    scene's is taken, and said. A single prediction is that of the single scene that was ``requested``, whatever its
    name. Raises ``PredictionError`` where several fit or one fits no scene.
    """
    names = {name: source for source in sources for name in source.scenes}
    if len(names) < sum(len(source.scenes) for source in sources):
        twice = next(n for k, s in enumerate(sources) for n in s.scenes if any(n in t.scenes for t in sources[:k]))
        raise PredictionError(f"scene '{printable(twice, 80)}' is predicted in several of the paths; give each once")
    foreign = [
        name for name, source in names.items() if dataset is not None and source.dataset_of(name) not in {None, dataset}
    ]
    remarks = [f"left out, of another dataset: {printable(', '.join(foreign), 200)}"] if foreign else []
    own = {name: _plain(name.rpartition("/")[2]) for name in names if name not in foreign}
    if len(requested) == 1 and len(own) == 1 and not is_known(next(iter(own)), known):
        name = next(iter(own))
        remark = f"{requested[0]}: the prediction '{printable(name, 80)}' is taken for it, as the only one"
        return [Match(requested[0], name, names[name])], [*remarks, remark]
    taken: dict[str, list[str]] = {}
    for name, plain in own.items():
        taken.setdefault(_scene_of(name, plain, known, where), []).append(name)
    matches = []
    for scene in dict.fromkeys((*known, *taken)):
        if scene in taken:
            name, more = _only_name(scene, taken[scene], own)
            remarks += more
            matches.append(Match(scene, name, names[name]))
    return matches, remarks


def _scene_of(name: str, plain: str, known: Sequence[str], where: str) -> str:
    """The scene that ``name`` means: of the same name, else the longest that it begins with."""
    same = [scene for scene in known if _plain(scene) == plain]
    if same:
        return same[0]
    if "/" in name:  # a scene that is made on demand stands in no list
        return name.rpartition("/")[2]
    longer = [scene for scene in known if _goes_on(name, scene)]
    if longer:
        return max(longer, key=len)
    hint = suggest(name, known)
    raise PredictionError(f"{where}: no ground truth for the predicted scene '{printable(name, 80)}'{hint}")


def is_known(name: str, known: Sequence[str]) -> bool:
    """Whether a prediction's name fits one of the scenes; one with a dataset before it fits whatever there is."""
    return "/" in name or any(_plain(scene) == _plain(name) or _goes_on(name, scene) for scene in known)


def _goes_on(name: str, scene: str) -> bool:
    """Whether ``name`` is ``scene`` with more behind it: ``room0_mesh``, not ``room01``."""
    for form in (scene, scene.replace("_", ""), scene.replace("-", "_")):
        if name.startswith(form) and not name[len(form) : len(form) + 1].isalnum():
            return True
    return False


def _only_name(scene: str, names: Sequence[str], plain: Mapping[str, str]) -> tuple[str, list[str]]:
    same = [name for name in names if plain[name] == _plain(scene)]
    if len(same or names) > 1:
        raise PredictionError(
            f"{scene}: {len(same or names)} predictions match it ({printable(', '.join(same or names), 200)}); "
            "give the one that is meant"
        )
    chosen = (same or names)[0]
    others = [name for name in names if name != chosen]
    if others:
        return chosen, [f"{scene}: '{chosen}' is taken; its name also begins {printable(', '.join(others), 200)}"]
    return chosen, [] if same else [f"{scene}: the prediction '{printable(chosen, 80)}' is taken for it"]


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "")


def planned_scenes(sources: Sequence[Source], dataset: str) -> list[str] | None:
    """The scenes of ``dataset`` that our own run folders were to predict; None for predictions from elsewhere."""
    planned: list[str] = []
    for source in sources:
        record_file = source.path / "run.json"
        if source.reader.name != OwnRuns.name or not record_file.is_file():
            return None
        try:
            record = read_record(RequestRecord, record_file, str(source.path))
        except StoreError:
            return None
        planned += [scene.removeprefix(f"{dataset}/") for scene in record.scenes if scene.startswith(f"{dataset}/")]
    return planned
