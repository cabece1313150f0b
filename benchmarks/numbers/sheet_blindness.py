"""Whether the pictures of annotation sheets tell the methods of a run apart outside of the answer, pair by pair.

``python benchmarks sheet_blindness RUN [--most 40] [--per-kind 10]``: what ``tests/sheets/test_blindness.py`` holds in
two small rooms, over all scenes of a finished run, which needs two or more. Prints a Markdown table: of each kind the
pairs that were held, those of which a classifier tells more than chance allows (Holm over all), and the least p. Exit
code 1 where a pair is told apart, or a pixel outside of an answer is not that of a picture without a map.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import folders  # noqa: F401 (makes what tests share known)
from blindness import ALPHA, Looks, all_looks, asked_alike, differs, told_apart

from su3d_bench.core.types import BoolArray, UInt8Array
from su3d_bench.runs.finished import read_run
from su3d_bench.sheets.drafts import Draft
from su3d_bench.sheets.drawing import Artist
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.sources import RunSource

KINDS: tuple[SheetKind, ...] = ("retrieval", "annotation", "reasoning")


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
