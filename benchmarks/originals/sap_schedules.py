"""Schedules of sAP's own simulation, for tests/cases/sap01_schedules.json.

    python benchmarks/originals/sap_schedules.py CHECKOUT [OUT]

``CHECKOUT`` is mtli/sAP at commit 0a45939. Its ``det/srt_det.py`` runs unmodified on generated sequences: files,
detector and random durations are replaced by lists in memory.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from original_code import load, silence

N_CASES = 200
RATES_HZ = (1, 5, 10, 15, 25, 30, 60)
UNUSED = ("tqdm", "torch", "pycocotools", "pycocotools.coco", "util.bbox", "det", "det.det_apis")
WORDS = ["--data-root=", "--annot-path=", "--out-dir=.", "--runtime=runtime", "--cached-res=results", "--overwrite"]


class Durations:
    """Returns given durations in order, in place of a distribution."""

    def __init__(self, durations_us: list[int]) -> None:
        self.n_drawn = 0
        self._durations_us = durations_us

    def draw(self) -> float:
        self.n_drawn += 1
        return self._durations_us[self.n_drawn - 1] / 1e6


def answer(module: Any, rate_hz: int, n_frames: int, durations_us: list[int]) -> dict[str, Any]:
    """The frames that sAP processes, and the times at which they are finished, in s."""
    durations, written = Durations(durations_us), {}
    images = {k: {"id": k, "sid": 0} for k in range(n_frames)}
    data: dict[str, list[Any]] = {"sequences": ["made"], "seq_dirs": [""], "categories": []}
    module.COCO = lambda path: SimpleNamespace(dataset=data, imgs=images)
    module.dist_from_dict = lambda *words: durations
    module.parse_det_result = lambda *words: (None, None, None, None)
    module.tqdm = lambda sequences: sequences
    module.open = lambda path, mode: path
    module.pickle = SimpleNamespace(
        load=lambda name: dict.fromkeys(images), dump=lambda value, name: written.update({name: value})
    )
    sys.argv = ["srt_det.py", *WORDS, f"--fps={rate_hz}"]
    with silence(), contextlib.suppress(ZeroDivisionError, ValueError):  # of its statistics without any frame
        module.main()
    found = written["./made.pkl"]
    return {
        "rate_hz": rate_hz,
        "n_frames": n_frames,
        "durations_us": durations_us[: durations.n_drawn],
        "frames": [int(frame) for frame in found["input_fidx"]],
        "finished_s": [round(time, 6) for time in found["timestamps"]],
    }


def cases(module: Any) -> Iterator[dict[str, Any]]:
    for index in range(N_CASES):
        rng = np.random.default_rng([2020, index])
        rate_hz, n_frames = int(rng.choice(RATES_HZ)), int(rng.integers(1, 31))
        mean_us = 1e6 / rate_hz * 10 ** rng.uniform(-1, 1)
        durations_us = rng.integers(1, 2 * mean_us, 2 * n_frames + 1)
        yield answer(module, rate_hz, n_frames, durations_us.tolist())


def main(checkout: Path, out: Path = Path("tests/cases/sap01_schedules.json")) -> None:
    module = load(checkout / "det/srt_det.py", [checkout], replaced={name: {} for name in UNUSED})
    lines = [json.dumps(case, separators=(",", ":")) for case in cases(module)]
    out.write_text("[\n" + ",\n".join(lines) + "\n]\n")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
