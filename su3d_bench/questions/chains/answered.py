"""Beacon3D's numbers of what a system answered: grounding per case, chain and object, questions per case and object.

Source: ``evaluate_grounding.py`` and ``evaluate_qa.py`` of beacon-3d/beacon-3d at 9cd8f1f. Numbers are shares of 1.
There a language model scores the answers from 1 to 5 that do not match a right one; here such scores are read where
answers have them, and where not, the least and the most are given that any judge could make of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.questions.chains import CHAINS_EACH, judge_chains
from su3d_bench.questions.chains.answer_matching import cleaned, is_yes_or_no, match
from su3d_bench.questions.chains.beacon3d_files import Chains, Questions, Reply

LEAST_SCORE, MOST_SCORE = 1.0, 5.0
RIGHT_FROM = 4.0  # the score from which an answer counts as right for its object
FIRST = ("case", "object")  # of the numbers
TAGS = ("class", "appearance", "geometry", "spatial", "existence", "functionality")


@dataclass(frozen=True)
class Number:
    """A share of ``n``; ``least`` and ``most`` differ where answers wait for a judge."""

    name: str
    least: float
    most: float
    n: int


def grounding_numbers(chains: Chains, right: Mapping[str, Mapping[int, bool]]) -> list[Number]:
    """The numbers of all scenes together; those of which nothing was asked are left out.

    ``right``: of each scene, for each case by its place, whether it was found.
    """
    rows: dict[str, list[bool]] = {}
    for scene, cases in chains.cases.items():
        is_right = np.array([right[scene][row] for row in range(len(cases))], bool)
        for name, of_scene in judge_chains(cases, is_right).items():
            rows.setdefault(name, []).extend(of_scene.tolist())
    asked = {name: rows[name] for name in (*FIRST, *rows) if rows[name]}
    shares = {name: float(np.mean(values)) for name, values in asked.items()}
    return [Number(name, share, share, len(asked[name])) for name, share in shares.items()]


def answer_numbers(questions: Questions, replies: Mapping[tuple[str, str], Reply]) -> list[Number]:
    """EM, EM-R, the share that needs no judge or has one, and the scores per case, object and kind of knowledge."""
    each = [scored(replies[one.scene, one.question.lower()]) for one in questions.asked]
    em, em_r, low, high = (np.array(column, float) for column in zip(*each, strict=True))
    n, tags = len(each), [one.tag for one in questions.asked]
    settled = float((low == high).mean())
    numbers = [Number(name, float(row.mean()), float(row.mean()), n) for name, row in (("EM", em), ("EM-R", em_r))]
    numbers.append(Number("settled", settled, settled, n))
    numbers.append(Number("case", _share(low), _share(high), n))
    least, most = (float((scores.reshape(-1, CHAINS_EACH) >= RIGHT_FROM).all(axis=1).mean()) for scores in (low, high))
    numbers.append(Number("object", least, most, n // CHAINS_EACH))
    for tag in TAGS:
        of_tag = np.array([one == tag for one in tags])
        if of_tag.any():
            numbers.append(Number(tag, _share(low[of_tag]), _share(high[of_tag]), int(of_tag.sum())))
    return numbers


def scored(reply: Reply) -> tuple[bool, bool, float, float]:
    """EM and EM-R of an answer and its least and most score.

    >>> scored(Reply("Yes, there is.", "Yes", None))
    (False, True, 5.0, 5.0)
    """
    given, right = cleaned(reply.given), [cleaned(reply.right)]
    em, em_r = match(given, right)
    if em or (em_r and is_yes_or_no(right)):
        return em, em_r, MOST_SCORE, MOST_SCORE
    if reply.score is not None:
        return em, em_r, reply.score, reply.score
    return em, em_r, LEAST_SCORE, MOST_SCORE


def _share(scores: Float64Array | Sequence[float]) -> float:
    return float((np.mean(scores) - LEAST_SCORE) / (MOST_SCORE - LEAST_SCORE))
