"""What a table shows of a run: one method under one protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from su3d_bench.reports.tables.model import Interval

BY_PEOPLE = "-people"  # ends the name of what stands in a protocol's place where people judged


@dataclass(frozen=True)
class Measured:
    """The numbers of ``metrics.json`` for one method and protocol, as fractions, None where undefined.

    What people judged is of this form too, from ``scores.json`` instead. ``run`` is the folder as it was named;
    ``limit``: how many frames of a scene, 0 for all; ``ceilings`` are empty where there is none. ``per_scene`` is
    scene -> metric -> value.
    """

    run: str
    method: str
    protocol: str
    version: int
    kind: str
    headline: tuple[str, ...]
    metrics: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]
    per_scene: Mapping[str, Mapping[str, float | None]]
    ceilings: Mapping[str, float | None]
    n_planned: int
    failed: tuple[str, ...]
    unscored: tuple[str, ...]
    limit: int
    profile: str | None
    encoder: str | None
    caveat: str | None

    @property
    def is_by_people(self) -> bool:
        return self.protocol.endswith(BY_PEOPLE)

    @property
    def scenes(self) -> frozenset[str]:
        return frozenset(self.per_scene)

    @property
    def datasets(self) -> str:
        """The datasets of the scenes, which are named ``dataset/scene``."""
        return ", ".join(dict.fromkeys(scene.partition("/")[0] for scene in self.per_scene)) or "no scene"

    @property
    def scenes_text(self) -> str:
        """``8``, ``7/8`` where some are missing, ``8 partial`` where only the first frames were used."""
        n = len(self.per_scene)
        text = str(n) if n == self.n_planned else f"{n}/{self.n_planned}"
        return f"{text} partial" if self.limit else text

    @property
    def is_whole(self) -> bool:
        return len(self.per_scene) == self.n_planned and not self.limit

    @property
    def is_ceiling(self) -> bool:
        """Whether the method was told the truth, or where to look for it, so that it competes with none."""
        return self.method == "oracle" or "a ceiling, not a result" in (self.caveat or "")
