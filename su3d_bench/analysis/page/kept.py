"""Scenes of a page that were made before, kept in the folder of their run under a key of all that they were made from.

A piece lies in ``RUN/.cache/page`` as a SHA-256 of its key and its content, a line end and the content. One that is
damaged, or was made from anything else, counts as absent; a folder that takes no files only means that the next page
makes its pieces again.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from su3d_bench.analysis.attribution import Explained, MendedJob, attribution_of
from su3d_bench.analysis.page.gallery import SceneGallery
from su3d_bench.analysis.page.maps import PageScene
from su3d_bench.core import digests
from su3d_bench.core.errors import StoreError, Su3dError
from su3d_bench.core.files.atomic import filling
from su3d_bench.core.files.locks import is_unfinished
from su3d_bench.core.system.files import file_bytes
from su3d_bench.metrics.attribution.arrays import EXPLAINED, MendedScene
from su3d_bench.metrics.attribution.masks import Mended, MendedPoints
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.matching.nearest import COVERAGE_RADII_M
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of, pack_scores, unpack_scores
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.run_folder import refuse_links

FOLDER = Path(".cache", "page")
MOST_BYTES = 1 << 28  # of a piece; one of a scene under fifty methods has a tenth of it
MOST_OF_EACH = 3  # of one scene, made from different things, such as other --queries
FORMAT = 4  # moves every key: raise it when the form of a piece changes


@dataclass(frozen=True)
class Piece:
    """The place of one piece below the folder of a run, ``top``, and the key of what it is made from."""

    top: Path
    name: str
    key: str

    @property
    def _place(self) -> Path:
        return self.top / FOLDER / f"{self.name}-{self.key[:16]}"

    def load(self) -> bytes | None:
        """What was kept; None where there is no whole piece of this key."""
        place = self._place
        try:
            refuse_links(self.top, place)
            if place.stat().st_size > MOST_BYTES:
                return None
            seal, _, content = file_bytes(place).partition(b"\n")
        except (OSError, StoreError):
            return None
        if seal != self._seal(content):
            return None
        with suppress(OSError):
            os.utime(place)  # what is asked for stays
        return content

    def save(self, content: bytes) -> None:
        """Keep ``content``, and of the other pieces of this name the youngest, where the folder takes files."""
        with suppress(OSError, StoreError):
            refuse_links(self.top, self._place)
            with filling(self._place) as stream:
                stream.write(self._seal(content) + b"\n" + content)
            self._remove_old()

    def _seal(self, content: bytes) -> bytes:
        return digests.digest_bytes(self.key.encode() + content).encode()

    def _remove_old(self) -> None:
        of_name = [place for place in self._place.parent.glob(f"{self.name}-*") if not is_unfinished(place.name)]
        for place in sorted(of_name, key=lambda place: place.lstat().st_mtime_ns)[:-MOST_OF_EACH]:
            place.unlink(missing_ok=True)


def piece(run: FinishedRun, scene: str, made_from: Any) -> Piece:
    """The piece of ``scene`` in the folder of ``run``; ``made_from`` is a JSON-like value of all that moves it."""
    code = [
        FORMAT,
        digests.code_digest(),
        digests.package_digest("analysis", "reports"),
        digests.package_versions(digests.NUMERIC_PACKAGES),
    ]
    return Piece(run.folder.path, digests.digest_json(scene)[:16], digests.digest_json([scene, made_from, code]))


def state_of_scene(run: FinishedRun, scene: str, method: str) -> list[Any]:
    """What a page is made from of a scene under a method: records, rules, state of the data, digests of files."""
    job = run.folder.job(scene, method)
    files = (job.prediction, features_beside(job.prediction), job.counts, job.updates, job.done)
    return [
        method,
        *(_digest(run.folder.path / name) for name in ("run.json", "run.toml")),
        {name: _fault(partial(run.rules, name)) or run.rules(name).digest for name in run.protocols},
        _fault(partial(run.dataset, scene)),
        {file.name: _digest(file) for file in files},
    ]


def state_of_counts(run: FinishedRun, method: str) -> list[str | None]:
    """The digests of what a method counted in every scene."""
    return [_digest(run.folder.job(scene, method).counts) for scene in run.scenes]


def _digest(file: Path) -> str | None:
    with suppress(OSError):
        return digests.digest_file(file)
    return None


def _fault(ask: Callable[[], Any]) -> str | None:
    try:
        ask()
    except Su3dError as error:
        return str(error)
    return None


# ---- the form of a scene

Job = tuple[int, str]  # index of the run, method
_SCENES: TypeAdapter[PageScene | None] = TypeAdapter(PageScene | None)
_GALLERIES: TypeAdapter[SceneGallery | None] = TypeAdapter(SceneGallery | None)
RulesOf = Callable[[str], ProtocolRules]
AS_IS, ALL, LABELLED = "as it is", "all mended", "true labels"  # beside the kinds of errors, each mended alone


@dataclass
class Made:
    """What was made of one scene; the errors of a job are a text where they cannot be had."""

    scene: str
    errors: dict[Job, MendedJob | str] = field(default_factory=dict)
    page: PageScene | None = None
    gallery: SceneGallery | None = None

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing, so that it would come out the same another time."""
        has_errors = not any(isinstance(one, str) for one in self.errors.values())
        return has_errors and all(part is None or part.is_whole for part in (self.page, self.gallery))


def save_scene(place: Piece, made: Made, runs: Sequence[FinishedRun]) -> None:
    """Keep a whole scene."""
    errors = [
        [index, method, base64.b64encode(packed(mended, runs[index].rules)).decode("ascii")]
        for (index, method), mended in made.errors.items()
        if not isinstance(mended, str)
    ]
    value = {"errors": errors, "page": _SCENES.dump_python(made.page), "gallery": _GALLERIES.dump_python(made.gallery)}
    place.save(json.dumps(value).encode())


def load_scene(place: Piece, scene: str, runs: Sequence[FinishedRun]) -> Made | None:
    """The scene that was kept at ``place``; None where there is none."""
    content = place.load()
    if content is None:
        return None
    # a run folder comes from anywhere: what another program left under the right key counts as absent, too
    with suppress(Su3dError, ValueError, KeyError, TypeError, RecursionError):
        value = json.loads(content)
        errors: dict[Job, MendedJob | str] = {
            (index, method): unpacked(base64.b64decode(mended), runs[index].rules)
            for index, method, mended in value["errors"]
        }
        page, gallery = _SCENES.validate_python(value["page"]), _GALLERIES.validate_python(value["gallery"])
        return Made(scene, errors, page, gallery)
    return None


def errors_of(explained: Explained | str, method: str, of_scenes: Mapping[str, MendedJob | str]) -> dict[str, Any]:
    """The errors of a method as a page holds them; a text in the place of what cannot be had is their reason."""
    reasons = [explained] if isinstance(explained, str) else [one for one in of_scenes.values() if isinstance(one, str)]
    try:
        if not isinstance(explained, str) and not reasons:
            mended = {scene: one for scene, one in of_scenes.items() if not isinstance(one, str)}
            return {**attribution_of(explained, mended).to_json(), "reason": None}
    except Su3dError as error:
        reasons = [str(error)]
    return {"method": method, "protocols": [], "remarks": [], "reason": reasons[0]}


def packed(mended: MendedJob, rules_of: RulesOf) -> bytes:
    """The counts of a scene under a method as the bytes of an npz file; ``rules_of`` finds a protocol by its name."""
    scores: dict[str, SceneScore] = {}
    for protocol, of_scene in mended.items():
        parts = {AS_IS: of_scene.as_is, ALL: of_scene.all, LABELLED: of_scene.with_true_labels, **of_scene.alone}
        for part, counts in parts.items():
            if counts is not None:
                name, n = f"{protocol} {part}", of_scene.n.get(part, 0)
                version, nowhere = rules_of(protocol).version, np.zeros(len(COVERAGE_RADII_M), np.int64)
                scores[name] = SceneScore(name, version, counts, n, of_scene.n_scored or 0, nowhere, ())
    return pack_scores(scores)


def unpacked(content: bytes, rules_of: RulesOf) -> MendedJob:
    """What ``packed`` packed."""
    scores = unpack_scores(content)
    names = dict.fromkeys(name.partition(" ")[0] for name in scores)
    return {name: _of_protocol(rules_of(name), scores) for name in names}


def _of_protocol(rules: ProtocolRules, scores: Mapping[str, SceneScore]) -> MendedScene:
    def counts(part: str) -> Any:
        found: Counts = scores[f"{rules.name} {part}"].counts
        metric_of(rules).check(rules.name, found)
        return found

    as_is, everything = counts(AS_IS), counts(ALL)
    labelled = counts(LABELLED) if f"{rules.name} {LABELLED}" in scores else None
    kinds = EXPLAINED[rules.kind][0]
    alone = {kind: counts(kind) for kind in kinds}
    n = {kind: scores[f"{rules.name} {kind}"].n_predictions for kind in kinds}
    if isinstance(as_is, InstanceCounts):
        return Mended(as_is, alone, everything, n, labelled)
    return MendedPoints(as_is, alone, everything, labelled, n, scores[f"{rules.name} {AS_IS}"].n_scored)
