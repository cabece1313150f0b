"""The profile of detections that were made elsewhere, in whatever format."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, Regions
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.detections import Assembler, captioned_by_colour
from su3d_bench.perception.embedded.naming import Namer
from su3d_bench.perception.regions import RegionsOnDemand
from su3d_bench.perception.stored.source import StoredSource

STORED_CAVEAT = "stored perception: masks and names were made elsewhere and are taken as they are"


class StoredPerception:
    """Detections from files; features are computed where the files lack them.

    With a ``namer`` regions without a name get one as any other region does, and its confidence, and captions tell
    their colour.
    """

    profile = "stored"
    caveat: str | None = STORED_CAVEAT

    def __init__(self, source: StoredSource, encoder: Encoder, cache: FrameCache, namer: Namer | None = None) -> None:
        self.encoder = encoder
        self._source = source
        self._namer = namer
        self._assembler = Assembler(encoder, cache, "published" if namer is None else "own")
        names = "" if namer is None else namer.digest
        self.digest = content_key(self.profile, source.name, content_digest(source.files), names, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("cache"):
            stored = self._source.frame(frame)
        if self._namer is not None:
            regions, known = self._assembler.named(frame, stored.regions, self._namer, needs, timer)
            return self._assembler.assemble(frame, regions, needs, timer, describe=captioned_by_colour, known=known)
        known = stored.features_for(needs, self.encoder)
        whole = stored.global_feature
        return self._assembler.assemble(frame, stored.regions, needs, timer, known=known, global_feature=whole)

    def regions(self) -> RegionPerception:
        """Perception on demand over the masks from the files: as sure as the share of the points in one."""
        return RegionsOnDemand(self._regions_of, self.encoder)

    def _regions_of(self, frame: Frame) -> Regions:
        regions = self._source.frame(frame).regions
        return replace(regions, scores=np.ones(len(regions.masks), np.float32))


def content_digest(files: Iterable[Path]) -> str:
    """A digest of the names and contents of ``files``, in their order."""
    hasher = hashlib.sha256()
    for path in files:
        hasher.update(path.name.encode() + b"\0" + hashlib.sha256(file_bytes(path)).digest())
    return hasher.hexdigest()
