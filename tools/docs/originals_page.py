"""docs/numbers/originals.md, made from the protocols' files: whose evaluation each repeats, and how both were compared.

``python tools/docs/originals_page.py`` writes the page; ``--check`` says whether it still holds.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence

from made_documents import ROOT, cell, write_or_check

from su3d_bench.metrics.protocols.loading import Original, original_of, protocol_names

PAGE = ROOT / "docs" / "numbers" / "originals.md"
HEAD = """# Whose evaluation each protocol repeats

Made by `make architecture` from the table `[original]` of each protocol's file in `su3d_bench/metrics/rules/`; a test
fails where it does not hold any more. `su3d-bench protocols` lists the same, `su3d-bench protocols show NAME` beside
every rule.

A made problem is one or several small scenes with made predictions (ties, empty predictions, void, missing classes,
small and doubled masks) that the original, run unedited but for versions of Python and its libraries, and this program
both answered. The difference is the largest of any number of any problem, as a fraction: 0 is equal to the last bit.
From the source tree `python benchmarks against_originals PROTOCOL CHECKOUT` asks again, of a checkout of the original
that you made yourself; without words it lists the protocols for which it can.

## Protocols with an original
"""
WITHOUT = """
## Protocols without one

Their rules are this program's own, or no program is known that gives these numbers.
"""


def page() -> str:
    with_one: defaultdict[Original, list[str]] = defaultdict(list)
    without: defaultdict[Original, list[str]] = defaultdict(list)
    for name in protocol_names():
        stated = original_of(name)
        assert stated is not None
        (with_one if stated.original.none is None else without)[stated.original].append(name)
    rows = [
        (_names(names), _link(one), cell(one.licence), cell(one.data), cell(one.held_together))
        for one, names in with_one.items()
    ]
    rest = [(_names(names), cell(one.none), cell(one.data)) for one, names in without.items()]
    return "\n".join(
        [
            HEAD,
            _table(("protocol", "original", "licence of its code", "licence of the data", "compared"), rows),
            WITHOUT,
            _table(("protocol", "why", "licence of the data"), rest),
        ]
    )


def _names(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _link(one: Original) -> str:
    return f"[{one.code} at {str(one.commit)[:7]}]({one.place}): {', '.join(f'`{file}`' for file in one.files)}"


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main(arguments: list[str]) -> int:
    return write_or_check(PAGE, page(), arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
