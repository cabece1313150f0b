"""A finished run of a painted scene, and a small set of sheets that needs no run, for tests of annotation sheets."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.human_eval.drafts import Draft
from su3d_bench.human_eval.items import ASKS, Key, SheetKind
from su3d_bench.human_eval.sets import GeneratedSheets, make_sheets
from su3d_bench.reports.pictures.items import jpeg_bytes

METHODS = ("collector", "collector@noise_m=0.0", "collector@drop=1")
HOSTILE = (
    "<script>document.title='gone'</script><img src=x onerror=alert(1)>",
    '=HYPERLINK("http://example.com","win")',
    r"\input{/etc/passwd} $x_1$ & % #",
    "\u202eright to left \u05d0\u05d1\u05d2 \u0627\u0644",
    "emoji \U0001f600\U0001f1e9\U0001f1ea",
    "x" * 10_000,
    "@SUM(1+1)*cmd|' /C calc'!A0",
    "</script><!--<script>",
    "bell \x07 null \x00 escape \x1b[2J",
)


def drafts_of(kind: SheetKind, texts: Sequence[str]) -> list[Draft]:
    """A draft per text, by two methods in turn."""
    asks = tuple(one.name for one in ASKS[kind])
    by = itertools.cycle((("opensu3d@scheme1",), ("opensu3d@scheme1", "opensu3d@scheme4")))
    return [
        Draft(
            kind=kind,
            scene="rooms/secret-scene",
            methods=methods,
            instance_ids=tuple(range(70 + k, 70 + k + len(methods))),
            rows=(0,),
            title=(text,),
            text=text,
            asks=asks,
            question_id=f"question-{k}",
            question_kind="relative",
            automatic={asks[0]: "right"},
        )
        for k, (text, methods) in enumerate(zip(texts, by, strict=False))
    ]


def painted_png(draft: Draft) -> bytes:
    """A picture with a colour determined by the draft's text."""
    shade = np.frombuffer(draft.text.encode()[:3].ljust(3), np.uint8)
    return jpeg_bytes(np.tile(shade, (60, 80, 1)).astype(np.uint8))


def made(
    kind: SheetKind, texts: Sequence[str], *, seed: int = 0, annotators: int = 1, overlap: float = 0.5
) -> GeneratedSheets:
    """A set of sheets with one item per text."""
    safe = [replace(one, text=printable(one.text, 1000)) for one in drafts_of(kind, texts)]
    methods = ("opensu3d@scheme1", "opensu3d@scheme4")
    origin = Key("", kind, "runs/secret-run", "secret-code", methods, "secret-rule", ())
    drawn = [painted_png(one) for one in safe]
    return make_sheets(origin, safe, drawn, seed=seed, annotators=annotators, overlap=overlap)
