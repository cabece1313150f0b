"""Verbs that process a finished run, killed at random moments and repeated."""

from __future__ import annotations

import csv
import os
import random
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forked_runs import COMPLETE, EXECUTORS, SUBJECTS, ForkedProcess, outcome
from killing import SIGNALS, Tally, check_end, clear_leftovers, end_of, end_orphans, kill


@dataclass(frozen=True)
class KilledVerb:
    """A verb to kill, in a folder with copies of ``needs``; ``after``: a command that must still work there."""

    words: tuple[str, ...]
    needs: tuple[str, ...]
    after: tuple[str, ...] = ()


RUN_AGAIN = (*SUBJECTS["light"], *EXECUTORS["inline"], "--out", "run")
SHEETS = ("sheets", "make", "run", "--kinds", "annotation", "--methods", "collector", "--per-kind", "2", "--quiet")
VERBS = {
    "export": KilledVerb(
        ("runs", "export", "run", "--to", "openlex3d", "--method", "collector", "--out", "run/exported", "--quiet"),
        ("run",),
        RUN_AGAIN,
    ),
    "sheets-make": KilledVerb((*SHEETS, "--jobs", "2", "--out", "sheets"), ("run",)),
    "sheets-score": KilledVerb(
        ("sheets", "score", "answers.csv", "--key", "sheets-key", "--out", "scores", "--quiet"),
        ("sheets", "sheets-key", "answers.csv"),
    ),
    "report-html": KilledVerb(("report", "html", "run", "--texts", "chair", "--out", "page.html", "--quiet"), ("run",)),
}


def load_verbs() -> None:
    """Import these verbs' modules in this process."""
    import matplotlib.figure  # noqa: F401


def make_inputs(folder: Path) -> None:
    """A finished run, sheets of it, and answers to them."""
    folder.mkdir()
    for words in (RUN_AGAIN, (*SHEETS, "--jobs", "1", "--out", "sheets")):
        made = ForkedProcess(words, folder.with_suffix(".log"), folder)
        if made.finish() != COMPLETE:
            raise SystemExit(f"{' '.join(words[:2])} failed: {made.output()}")
    with (folder / "sheets/annotator-1/sheet.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    with (folder / "answers.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(row | {"answer": row["choices"].partition(" | ")[0]} for row in rows)


class VerbTrial:
    """One verb: its undisturbed result, and as many killed ones as requested."""

    def __init__(self, scratch: Path, inputs: Path, name: str, seed: str, tally: Tally) -> None:
        self._verb, self._inputs, self._tally = VERBS[name], inputs, tally
        self._moments = random.Random(f"{seed} {name}")
        self._place, self._log, self._temporary = scratch / "place", scratch / "log", scratch.parent / "temporary"
        scratch.mkdir()
        self._kept = {path.name for path in self._temporary.iterdir()}
        found = [self._undisturbed() for _ in range(2)]
        if found[0] != found[1]:
            raise SystemExit(f"two undisturbed results of {name} differ; killed ones cannot be compared")
        self._expected = found[1]

    def _undisturbed(self) -> dict[str, Any]:
        self._prepare()
        one = ForkedProcess(self._verb.words, self._log, self._place)
        if one.finish() != COMPLETE:
            raise SystemExit(f"{' '.join(self._verb.words[:2])} failed undisturbed: {one.output()}")
        self._whole_s = time.monotonic() - one.started
        return everything(self._place)

    def _prepare(self) -> None:
        shutil.rmtree(self._place, ignore_errors=True)
        self._place.mkdir()
        for name in self._verb.needs:
            source, copy = self._inputs / name, self._place / name
            shutil.copytree(source, copy) if source.is_dir() else shutil.copyfile(source, copy)

    def kills(self, n: int) -> None:
        """Episodes until ``n`` kills struck, each with up to a few kills, then one that completes."""
        struck = 0
        while struck < n:
            self._prepare()
            of_episode = 0
            while of_episode == 0 or (struck < n and self._moments.random() < 0.5):
                of_episode += 1
                struck += self._kill_one()
            self._give_again()

    def _kill_one(self) -> bool:
        victim, sent = self._moments.choice(("group", "driver")), self._moments.choice(SIGNALS)
        one = ForkedProcess(self._verb.words, self._log, self._place)
        time.sleep(self._moments.uniform(0, self._whole_s))
        was_hit = kill(one, victim, sent, (), self._moments)
        code = end_of(one, self._tally) if was_hit else one.finish()
        self._restore()
        if not was_hit:
            self._tally.done["nobody there"] += 1
            return False
        if sent != signal.SIGKILL:
            check_end(one, code, sent, (COMPLETE,), self._tally)
        end_orphans(self._place, self._tally)
        self._tally.kill(victim, sent, None)
        return True

    def _restore(self) -> None:
        """An export completed before the signal would be rejected the next time."""
        if self._verb.after:
            shutil.rmtree(self._place / "run/exported", ignore_errors=True)

    def _give_again(self) -> None:
        self._tally.done["compared"] += 1
        for words in filter(None, (self._verb.words, self._verb.after)):
            one = ForkedProcess(words, self._log, self._place)
            if (code := one.finish()) != COMPLETE:
                self._tally.fault(f"repeated, {words[0]} ended with {code}: {one.output()}")
        end_orphans(self._place, self._tally)
        found = everything(self._place)
        for name in sorted(found.keys() | self._expected.keys()):
            if name not in self._expected:
                self._tally.leftover(name)
            elif name not in found or found[name] != self._expected[name]:
                self._tally.fault(f"repeated: {name} {'differs' if name in found else 'is missing'}")
        clear_leftovers(self._temporary, self._kept, self._tally)


def everything(folder: Path) -> dict[str, Any]:
    """Content of every file in ``outcome``, and every folder, by name."""
    folders = {path.relative_to(folder).as_posix(): None for path in folder.rglob("*") if path.is_dir()}
    return outcome(folder) | folders


def try_verbs(scratch: Path, counts: dict[str, int], seed: str, tallies: dict[str, Tally]) -> None:
    """That many kills of each verb."""
    os.environ["SU3D_CACHE"] = str(scratch / "cache-of-verbs")
    make_inputs(scratch / "inputs")
    for name, n in counts.items():
        VerbTrial(scratch / name, scratch / "inputs", name, seed, tallies[name]).kills(n)
