"""Whether the pictures of annotation sheets tell the methods of a run apart outside of the answer, pair by pair.

``python benchmarks sheet_blindness RUN [--most 40] [--per-kind 10]``: what ``tests/sheets/test_blindness.py`` holds in
two small rooms, over all scenes of a finished run, which needs two or more. Prints a Markdown table: of each kind the
pairs that were held, those of which a classifier tells more than chance allows (Holm over all), and the least p. Exit
code 1 where a pair is told apart, or a pixel outside of an answer is not that of a picture without a map.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import folders  # noqa: F401 (makes what tests share known)
import numpy as np
from blindness import Drafts, Onlooker, Thing, asked_alike, differs, untitled
from threadpoolctl import threadpool_limits

from su3d_bench.core.types import BoolArray, Float64Array, UInt8Array
from su3d_bench.numerics.statistics import holm
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.drafts import Draft
from su3d_bench.sheets.drawing import Artist
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.sources import RunSource

KINDS: tuple[SheetKind, ...] = ("retrieval", "annotation", "reasoning")


SMALLER = 4  # times, of the pictures that are compared


ALPHA = 0.05


@dataclass(frozen=True)
class Look:
    """A picture (h, w, 3) without its title, and the zone (h, w) of the answer, both made ``SMALLER``."""

    picture: UInt8Array
    zone: BoolArray


def look_at(picture: UInt8Array, zone: BoolArray) -> Look:
    """Both at a fraction of their size; a pixel that holds any of the zone is of it."""
    size = picture.shape[1] // SMALLER, picture.shape[0] // SMALLER
    cut = tuple(slice(SMALLER * side) for side in size[::-1])
    small: Any = cv2.resize(picture[cut], size, interpolation=cv2.INTER_AREA)
    share: Any = cv2.resize(np.ascontiguousarray(zone[cut]).view(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
    return Look(small, share > 0)  # of 16 pixels one is still 16 of 255


def features_of(look: Look, zone: BoolArray) -> Float64Array:
    """What a classifier is shown of a picture outside ``zone``: the picture made small, colours, edges, file size."""
    left = ~zone
    picture = look.picture * left[:, :, None]
    grey = picture.astype(np.float32) @ np.full(3, 1 / 3, np.float32)
    small: Any = cv2.resize(grey, (30, 26), interpolation=cv2.INTER_AREA)
    seen = picture[left]
    red, green, blue = (seen >> 6).T
    colours = np.bincount(16 * red + 4 * green + blue, minlength=64) / max(1, len(seen))
    both = left[1:, 1:] & left[:-1, 1:] & left[1:, :-1]
    down, across = (np.abs(np.diff(grey, axis=axis))[: len(grey) - 1, : grey.shape[1] - 1] for axis in (0, 1))
    edges = [float(one[both].mean()) for one in (down, across)] + [
        float((one[both] > 20).mean()) for one in (down, across)
    ]
    means = seen.mean(axis=0)
    return np.concatenate([small.ravel(), colours, edges, means, [len(zlib.compress(picture.tobytes(), 1))]])


def p_of_telling(pairs: Sequence[tuple[str, Look, Look]]) -> float | None:
    """How probable it is by chance to tell two methods apart as well as a logistic regression does; None untested.

    ``pairs``: scene, and the looks of both methods at one asked thing. Trained on every other scene, the model says
    which of the two is which: were they exchangeable, each pair of a scene would be a toss. The least p of the scenes,
    corrected for their number. What both methods share tells nothing and is left out.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    unlike = [(scene, a, b, a.zone | b.zone) for scene, a, b in pairs if a is not b]
    shown = [(scene, features_of(a, zone), features_of(b, zone)) for scene, a, b, zone in unlike]
    scenes, found = sorted({scene for scene, *_ in shown}), []
    for held_out in scenes:
        train = [(a, b) for scene, a, b in shown if scene != held_out]
        test = [(a, b) for scene, a, b in shown if scene == held_out and not np.array_equal(a, b)]
        if not train or not test:
            continue
        model = make_pipeline(StandardScaler(), LogisticRegression(C=0.1, max_iter=500))
        with threadpool_limits(1):  # so few rows: threads would only wait for each other
            model.fit(np.array([one for pair in train for one in pair]), [0, 1] * len(train))
        lead = model.decision_function([b for _, b in test]) - model.decision_function([a for a, _ in test])
        found.append(_p_of_tosses(int((lead > 0).sum()), len(test)))
    return min(1.0, len(found) * min(found)) if found else None


def _p_of_tosses(n_right: int, n: int) -> float:
    """Of so many tosses so many heads or more."""
    from scipy.stats import binom

    return float(binom.sf(n_right - 1, n, 0.5))


Looks = Mapping[Thing, Mapping[str, Look]]


def pairs_of(looks: Looks, one: str, other: str) -> list[tuple[str, Look, Look]]:
    """What both methods show for the same asked things."""
    return [(thing[0], shown[one], shown[other]) for thing, shown in looks.items() if {one, other} <= shown.keys()]


def methods_in(looks: Looks) -> list[str]:
    """The methods of which something is shown."""
    return sorted({method for shown in looks.values() for method in shown})


def told_apart(looks_of: Mapping[str, Looks]) -> dict[tuple[str, str, str], float | None]:
    """For each kind and pair of its methods Holm's p that the pictures are no better told apart than by chance."""
    names = [(kind, *pair) for kind, looks in looks_of.items() for pair in combinations(methods_in(looks), 2)]
    raw = [p_of_telling(pairs_of(looks_of[kind], one, other)) for kind, one, other in names]
    return dict(zip(names, holm(raw), strict=True))


def all_looks(
    artist: Artist, drafts: Drafts, check: Callable[[Draft, UInt8Array, UInt8Array, BoolArray], None]
) -> Looks:
    """The looks of all drafts; ``check`` sees of each the picture, the one without a map, and the answer's zone."""
    looks: dict[Thing, dict[str, Look]] = {}
    drawn: dict[int, Look] = {}  # an item of several methods is drawn once
    onlooker = Onlooker(artist)
    for thing, of_method in drafts.items():
        for method, draft in of_method.items():
            if id(draft) not in drawn:
                parts = artist.parts(draft)
                picture, zone = untitled(parts), onlooker.zone_of(draft, parts)
                check(draft, picture, onlooker.without_answer(draft, parts), zone)
                drawn[id(draft)] = look_at(picture, zone)
            looks.setdefault(thing, {})[method] = drawn[id(draft)]
    return looks


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--most", type=int, default=40, help="things a scene and kind")
    parser.add_argument("--per-kind", type=int, default=10, help="questions of each kind of query")
    arguments = parser.parse_args()
    source = RunSource(read_run(arguments.run))
    artist, encoder = Artist(source), source.run.encoder("cpu")
    astray: list[Draft] = []

    def check(draft: Draft, picture: UInt8Array, blank: UInt8Array, zone: BoolArray) -> None:
        if (differs(picture, blank) & ~zone).any():
            astray.append(draft)

    looks: dict[str, Looks] = {}
    for kind in KINDS:
        per_kind = 1 if kind == "reasoning" else arguments.per_kind
        looks[kind] = all_looks(artist, asked_alike(source, encoder, kind, per_kind, arguments.most), check)
    found = told_apart(looks)
    print("| kind | things | pictures | pairs | told apart | least p |\n|---|---|---|---|---|---|")
    for kind in KINDS:
        values = [p for (of_kind, *_), p in found.items() if of_kind == kind and p is not None]
        n_pictures = sum(map(len, looks[kind].values()))
        n_told, least = sum(p < ALPHA for p in values), min(values, default=1.0)
        print(f"| {kind} | {len(looks[kind])} | {n_pictures} | {len(values)} | {n_told} | {least:.3g} |")
    print(f"pictures with a pixel outside of the answer that a map has a part in: {len(astray)}")
    return 1 if astray or any(p is not None and p < ALPHA for p in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
