"""Cache of a page's scenes in the folder of their run, under a key of all inputs.

The entry of a scene is a file in ``RUN/.cache/page``: a SHA-256 of its key and content, a line break and the content.
An entry that is damaged or has other inputs counts as absent; if the folder is not writable, the next page computes its
scenes again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from su3d_bench.analysis.attribution import Explained, JobCounts, attribution_of
from su3d_bench.analysis.page.gallery import SceneGallery
from su3d_bench.analysis.page.maps import PageScene
from su3d_bench.core import digests
from su3d_bench.core.errors import StoreError, Su3dError
from su3d_bench.core.files.atomic import filling
from su3d_bench.core.system.files import file_bytes
from su3d_bench.metrics.attribution.arrays import EXPLAINED, CorrectedScene
from su3d_bench.metrics.attribution.masks import CorrectedCounts
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.matching.transfer import COVERAGE_RADII_M
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of, pack_scores, unpack_scores
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.run_folder import check_no_links

FOLDER = Path(".cache", "page")
MAX_BYTES = 1 << 28  # of an entry; that of a scene under fifty methods has a tenth of it
FORMAT = 5  # changes every key: increase it when the format of an entry changes

Job = tuple[int, str]  # index of the run, method
RulesOf = Callable[[str], ProtocolRules]
AS_IS, ALL, LABELLED = "as it is", "all corrected", "true labels"  # besides the kinds of errors, each corrected alone
_FORM: TypeAdapter[tuple[list[tuple[int, str, bytes]], PageScene | None, SceneGallery | None]] = TypeAdapter(
    tuple[list[tuple[int, str, bytes]], PageScene | None, SceneGallery | None],
    config=ConfigDict(ser_json_bytes="base64", val_json_bytes="base64"),
)


@dataclass
class SceneContent:
    """The results of one scene; the errors of a job are a text if they could not be computed."""

    scene: str
    errors: dict[Job, JobCounts | str] = field(default_factory=dict)
    page: PageScene | None = None
    gallery: SceneGallery | None = None

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing, so that the result can be cached."""
        has_errors = not any(isinstance(one, str) for one in self.errors.values())
        return has_errors and all(part is None or part.is_whole for part in (self.page, self.gallery))


@dataclass(frozen=True)
class CacheFile:
    """The cache entry of ``scene`` below the run folder ``top``, and the key of its inputs."""

    top: Path
    scene: str
    key: str

    @property
    def _place(self) -> Path:
        return self.top / FOLDER / digests.digest_json(self.scene)[:16]

    def _signed(self, content: bytes) -> bytes:
        return digests.digest_bytes(self.key.encode() + content).encode()

    def save(self, made: SceneContent, runs: Sequence[FinishedRun]) -> None:
        """Cache a complete scene, if the folder is writable."""
        errors = [
            (index, method, packed(corrected, runs[index].rules))
            for (index, method), corrected in made.errors.items()
            if not isinstance(corrected, str)
        ]
        content = _FORM.dump_json((errors, made.page, made.gallery))
        with suppress(OSError, StoreError):
            check_no_links(self.top, self._place)
            with filling(self._place) as stream:
                stream.write(self._signed(content) + b"\n" + content)

    def load(self, runs: Sequence[FinishedRun]) -> SceneContent | None:
        """The cached scene; None if there is no valid entry with this key."""
        # run folders are untrusted: content that another program left under the right key counts as absent, too
        with suppress(OSError, Su3dError, ValueError, KeyError, TypeError, RecursionError):
            check_no_links(self.top, self._place)
            if self._place.stat().st_size <= MAX_BYTES:
                signature, _, content = file_bytes(self._place).partition(b"\n")
                if signature == self._signed(content):
                    kept, page, gallery = _FORM.validate_json(content)
                    errors = {(index, method): unpacked(one, runs[index].rules) for index, method, one in kept}
                    return SceneContent(self.scene, {**errors}, page, gallery)
        return None


def piece(run: FinishedRun, scene: str, made_from: Any) -> CacheFile:
    """The cache entry of ``scene`` in the folder of ``run``; ``made_from``: a JSON-like value of all inputs."""
    versions = digests.package_versions(digests.NUMERIC_PACKAGES)
    code = [FORMAT, digests.code_digest(), digests.package_digest("analysis", "reports"), versions]
    return CacheFile(run.folder.path, scene, digests.digest_json([scene, made_from, code]))


def state_of_scene(run: FinishedRun, scene: str, method: str) -> list[Any]:
    """The inputs of a page for a scene and method: records, rules, state of the data, digests of files."""
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
    """The digests of a method's counts in every scene."""
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


def errors_of(explained: Explained | str, method: str, of_scenes: Mapping[str, JobCounts | str]) -> dict[str, Any]:
    """The errors of a method in the page's form; a text in place of errors becomes their ``reason``."""
    reasons = [explained] if isinstance(explained, str) else [one for one in of_scenes.values() if isinstance(one, str)]
    try:
        if not isinstance(explained, str) and not reasons:
            corrected = {scene: one for scene, one in of_scenes.items() if not isinstance(one, str)}
            return {**attribution_of(explained, corrected).to_json(), "reason": None}
    except Su3dError as error:
        reasons = [str(error)]
    return {"method": method, "protocols": [], "remarks": [], "reason": reasons[0]}


def packed(corrected: JobCounts, rules_of: RulesOf) -> bytes:
    """The counts of a scene under a method as the bytes of an npz file; ``rules_of`` returns a protocol's rules."""
    scores: dict[str, SceneScore] = {}
    nowhere = np.zeros(len(COVERAGE_RADII_M), np.int64)
    for protocol, of_scene in corrected.items():
        version, n_scored = rules_of(protocol).version, of_scene.n_scored or 0
        parts = {AS_IS: of_scene.as_is, ALL: of_scene.all, LABELLED: of_scene.with_true_labels, **of_scene.alone}
        for part, counts in parts.items():
            if counts is not None:
                name, n = f"{protocol} {part}", of_scene.n.get(part, 0)
                scores[name] = SceneScore(name, version, counts, n, n_scored, nowhere, ())
    return pack_scores(scores)


def unpacked(content: bytes, rules_of: RulesOf) -> JobCounts:
    """The inverse of ``packed``."""
    corrected: dict[str, CorrectedScene] = {}
    scores: dict[str, dict[str, SceneScore]] = {}
    for name, score in unpack_scores(content).items():
        protocol, _, part = name.partition(" ")
        metric_of(rules_of(protocol)).check(protocol, score.counts)
        scores.setdefault(protocol, {})[part] = score
    for protocol, parts in scores.items():
        counts: dict[str, Any] = {part: score.counts for part, score in parts.items()}
        kinds = EXPLAINED[rules_of(protocol).kind][0]
        alone, n = {kind: counts[kind] for kind in kinds}, {kind: parts[kind].n_predictions for kind in kinds}
        as_is, everything, labelled = counts[AS_IS], counts[ALL], counts.get(LABELLED)
        n_scored = None if isinstance(as_is, InstanceCounts) else parts[AS_IS].n_scored
        corrected[protocol] = CorrectedCounts(as_is, alone, everything, n, labelled, n_scored)
    return corrected
