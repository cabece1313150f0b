"""Odd argument vectors for every verb: a clear line and exit code 0, 1 or 2, never a traceback."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator

import pytest
from cli_calls import Declined, called
from fuzz_words import vectors, verbs
from fuzzing import alarm
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

VERBS = dict(verbs())
EXAMPLES = int(os.environ.get("SU3D_FUZZ_EXAMPLES", "6"))  # of each verb; more in a long run
QUIET = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=EXAMPLES == 6,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@pytest.fixture(scope="module", autouse=True)
def _empty_place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A folder with a few files of the right names and no data."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "folder").mkdir()
    for name, text in (
        ("a.toml", "[method.opensu3d]\ntop_m = 3\n"),
        ("a.json", json.dumps({"a": 1})),
        ("a.csv", "a,b\n1,2\n"),
        ("a.tex", "% no table"),
        ("broken.py", "this is no Python"),
        ("a.py", "class A: pass\n"),
    ):
        (folder / name).write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in ("SU3D_DATA", "SU3D_CACHE", "SU3D_MODELS", "HF_HOME", "XDG_CACHE_HOME"):
            patch.setenv(name, str(folder / "data"))
        yield


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
@QUIET
@given(data=st.data())
def test_any_words_behind_a_verb_are_done_or_declined_in_one_line(words: tuple[str, ...], data: st.DataObject) -> None:
    vector = data.draw(vectors(words, VERBS[words]))
    try:
        with alarm(60):
            called(vector)
    except Declined:
        pass


@QUIET
@given(
    st.lists(st.text(max_size=12) | st.sampled_from(sorted({word for words in VERBS for word in words})), max_size=5)
)
def test_any_words_at_all_are_declined_in_one_line(vector: list[str]) -> None:
    if vector[:1] in (["run"], ["ablate"]) or vector[:2] == ["datasets", "make"]:
        vector = [*vector, "--scenes", "replica/none", "--dry-run"]
    try:
        with alarm(60):
            called(vector)
    except Declined:
        pass


def test_every_verb_is_met() -> None:
    assert len(VERBS) > 25 and ("run",) in VERBS and ("report", "verify") in VERBS and ("datasets", "make") in VERBS
