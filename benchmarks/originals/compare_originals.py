"""Synthetic problems, answered by an original evaluator run unedited from a checkout, and by this program.

    python benchmarks compare_originals scannet200-instance ~/openmask3d --problems 1000 --cases 30

The checkout is of the repository in the protocol's [original] table, at the commit given there. It is only
adapted to versions: Python 2 is converted to Python 3, names removed from numpy are restored, ``.cuda()`` stays
on the processor, and modules that are imported but never called need not be installed. Problems at which it stops are
counted and skipped. ``--cases`` stores its answers to some problems in tests/cases, where a test replays them. Exit
code 1 if a number differs by more than 1e-7, the last bits of float32. Without a checkout: the list of originals.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import folders  # noqa: F401 - lets the next ones be found
import numpy as np
import original_answers
import original_boxes
import original_chains
import original_challenge
import original_derived
import original_instances
import original_maps
import original_objects
import original_points
import original_queries
import original_segments
import original_top_k
from original_code import STOPS, Original, silence

from su3d_bench.metrics.protocols.loading import load_protocol

LARGEST = 1e-7
FAMILIES = (
    original_instances, original_derived, original_points, original_objects, original_maps, original_boxes,
    original_queries, original_segments, original_top_k, original_answers, original_challenge, original_chains,
)  # fmt: skip
ORIGINALS: tuple[Original, ...] = tuple(one for family in FAMILIES for one in family.ORIGINALS)


def difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """The largest difference of any number; infinite if one has a value and the other none."""
    if ours.shape != theirs.shape or (np.isnan(ours) != np.isnan(theirs)).any():
        return math.inf
    return float(np.nanmax(np.abs(ours - theirs), initial=0.0))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("protocol", nargs="?")
    parser.add_argument("checkout", nargs="?", type=Path)
    parser.add_argument("--problems", type=int, default=1000, help="number of problems that both must answer")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=0, help="number of answers to store in tests/cases")
    words = parser.parse_args()
    if words.checkout is None:
        for one in ORIGINALS:
            print(f"{', '.join(one.protocols):60} {one.file}")
        return 0
    fits = [one for one in ORIGINALS if words.protocol in one.protocols and (words.checkout / one.file).is_file()]
    if not fits:
        parser.error(f"no original of '{words.protocol}' in {words.checkout}; run without arguments for a list")
    return compared(fits[0], words)


def compared(original: Original, words: argparse.Namespace) -> int:
    """Compare both on problem after problem and print the result."""
    rules, started = load_protocol(words.protocol), time.monotonic()
    stops: Counter[str] = Counter()
    n_answered, n_same, worst, worst_index = 0, 0, 0.0, -1
    with tempfile.TemporaryDirectory(prefix="original") as folder, np.errstate(all="ignore"):
        with silence():
            ask = original.start(rules, words.checkout.resolve(), Path(folder))
        for index in itertools.count():
            if n_answered == words.problems or sum(stops.values()) > 20 + 20 * words.problems:
                break
            problem = original.drawn(words.seed, index)
            try:
                with silence():
                    theirs = ask(problem)
            except STOPS as error:
                stops[f"{type(error).__name__}: {error}"[:100]] += 1
                continue
            apart = difference(original.ours(rules, problem), theirs)
            n_answered, n_same = n_answered + 1, n_same + (apart == 0)
            if apart > worst:
                worst, worst_index = apart, index
        if words.cases:
            original.keep(rules, ask, words.seed, words.cases)
    print(f"{words.protocol}: {n_answered} problems, {n_same} equal to the last bit, largest difference {worst:.3g}")
    print(f"    problem {worst_index} of seed {words.seed} is the worst; {time.monotonic() - started:.0f} s")
    for reason, n in stops.most_common(5):
        print(f"    the original stopped at {n} others: {reason}")
    return 1 if worst > LARGEST or n_answered < words.problems else 0


if __name__ == "__main__":
    sys.exit(main())
