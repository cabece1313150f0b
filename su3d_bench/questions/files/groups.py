"""The groups that sentences are scored in apart: unique and multiple, easy and hard, by the view and not.

Sources: ``_get_unique_multiple_lookup`` of lib/dataset.py (daveredrum/ScanRefer at 9d74830); of referit3d (referit3d/
referit3d at 725a5d3) data_generation/nr3d/stimuli_generation.py, analysis/utterances.py and deepnet_predictions.py, and
what in_out/neural_net_oriented.py and in_out/pt_datasets/listening_dataset.py leave out.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.open_vocabulary.query_ap import TextQuery

UNIQUE, MULTIPLE = "unique", "multiple"
EASY, HARD = "easy", "hard"
BY_VIEW, BY_ANY_VIEW = "view-dependent", "view-independent"
LEFT_OUT = "left out"  # of the evaluation of Nr3D with its candidates
PAIRS = ((UNIQUE, MULTIPLE), (EASY, HARD), (BY_VIEW, BY_ANY_VIEW))
# ``type2class`` of data/scannet/model_util_scannet.py: what the table calls otherwise is one class, others.
CLASSES = frozenset(
    (
        *("cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "picture", "counter", "desk"),
        *("curtain", "refrigerator", "shower curtain", "toilet", "sink", "bathtub"),
    )
)
OTHERS = "others"
# ``is_explicitly_view_dependent``
VIEW_WORDS = frozenset(
    ("front", "behind", "back", "right", "left", "facing", "leftmost", "rightmost", "looking", "across")
)
MOST_EASY = 2  # objects of the class of the one that is meant, itself among them
MOST_TOKENS = 24  # of a sentence that is scored: ``--max-seq-len``
ClassOfName = Callable[[str], str | None]  # the class of NYU40 that ScanNet's table gives a raw category


def scanrefer_groups(queries: Sequence[TextQuery], class_of: ClassOfName) -> tuple[TextQuery, ...]:
    """The queries of a scene of ScanRefer's file, each with ``unique`` or ``multiple``.

    Unique is what is the only object of its class among those that the file speaks of in the scene, by the name that
    the first of its sentences has. Queries without a name stay as they are.
    """
    known: dict[int, str] = {}
    for query in queries:
        if query.name:
            known.setdefault(query.object_ids[0], _class(query.name, class_of))
    classes = list(known.values())
    return tuple(
        with_group(query, UNIQUE if classes.count(_class(query.name, class_of)) == 1 else MULTIPLE)
        if query.name
        else query
        for query in queries
    )


def _class(name: str, class_of: ClassOfName) -> str:
    found = class_of(" ".join(name.split("_")))
    return found if found in CLASSES else OTHERS


def nr3d_groups(stimulus: str, tokens: str | None, mentions: str | None, at: str) -> tuple[str, ...]:
    """The groups of a row of Nr3D's file, or ``LEFT_OUT``; ``at`` says where it stands.

    ``stimulus`` is ``scan-class-n-target-others``, ``n`` the number of objects of the class; ``tokens`` a list of words
    as Python writes it, ``mentions`` whether the sentence names the class: where it does not it is left out, and so is
    one of more than 24 words or of an object that has none beside it.

    >>> nr3d_groups("scene0011_00-office_chair-3-1-2-4", "['the', 'left', 'chair']", "True", "row 2")
    ('hard', 'view-dependent')
    """
    parts = stimulus.split("-", 4)
    others = parts[4].split("-") if len(parts) == 5 else []
    numbers = [*parts[2:4], *(word for word in others if word)]
    if len(parts) < 4 or not all(word.isascii() and word.isdigit() and len(word) < 10 for word in numbers):
        raise DataError(f"{at}: 'stimulus_id' must be scan-class-n-target-others; found {printable(stimulus, 60)}")
    n = int(parts[2])
    if n - 1 != len([word for word in others if word]):
        raise DataError(f"{at}: 'stimulus_id' says {n} objects and names {len(others)} others")
    words = [] if tokens is None else _words(tokens, at)
    if (mentions or "True").strip() not in ("True", "true", "1") or len(words) > MOST_TOKENS or n < 2:
        return (LEFT_OUT,)
    return (EASY if n <= MOST_EASY else HARD, BY_VIEW if VIEW_WORDS.intersection(words) else BY_ANY_VIEW)


def _words(text: str, at: str) -> list[str]:
    try:
        words = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError) as error:
        raise DataError(f"{at}: 'tokens' must be a list of words; found {printable(text, 40)}") from error
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise DataError(f"{at}: 'tokens' must be a list of words; found {printable(text, 40)}")
    return words


def grouped_by_truth(queries: Iterable[TextQuery], truth: GroundTruth) -> tuple[TextQuery, ...]:
    """The queries with a group of every pair of which they have none yet, by the classes of the truth's objects (ours).

    Of several objects that are meant the class of the first counts; by the view is what has a word of those that Nr3D
    goes by.
    """
    ids, first = np.unique(truth.instance, return_index=True)
    class_of = {
        key: class_id for key, class_id in zip(ids.tolist(), truth.semantic[first].tolist(), strict=True) if key
    }
    classes = list(class_of.values())
    answer = []
    for query in queries:
        n = classes.count(class_of[query.object_ids[0]])
        words = re.findall(r"\w+", query.text.lower())
        ours = (
            UNIQUE if n == 1 else MULTIPLE,
            EASY if n <= MOST_EASY else HARD,
            BY_VIEW if VIEW_WORDS.intersection(words) else BY_ANY_VIEW,
        )
        for pair, group in zip(PAIRS, ours, strict=True):
            query = query if _has(query.groups, pair) else with_group(query, group)
        answer.append(query)
    return tuple(answer)


def _has(groups: Collection[str], pair: tuple[str, str]) -> bool:
    return not {*pair, LEFT_OUT}.isdisjoint(groups)


def with_group(query: TextQuery, group: str) -> TextQuery:
    return replace(query, groups=(*query.groups, group))
