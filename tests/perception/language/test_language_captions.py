"""Names and captions by a vision model, labels n' by vote and by a model, and what is read out of free answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chat_server import Answered, Body, chat_server, error, quick_config
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_room import instances

from su3d_bench.core.errors import PredictionError, StoreError
from su3d_bench.core.maps import Instances
from su3d_bench.perception.language.captioner import Captioner
from su3d_bench.perception.language.chat import ChatRequest, Reply
from su3d_bench.perception.language.client import ChatClient
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.perception.language.parsing import Described, answered, chosen_name, described
from su3d_bench.perception.language.reply_store import ReplyStore
from su3d_bench.questions.refining import (
    FilterConfig,
    ModelRefiner,
    TopNames,
    read_records,
    records_of,
    top_names,
    vote,
    write_records,
)
from su3d_bench.store.predictions import prediction_arrays, prediction_from_arrays, write_prediction
from su3d_bench.store.run_folder import JobFolder

NAMES = ("white sofa", "sofa", "couch", "trash can", "indoor-plant")


class Spoken:
    """A language model that says the same to everybody, or what ``texts`` has for each request."""

    def __init__(self, *texts: str, failure: str = "") -> None:
        self.texts = texts
        self.failure = failure
        self.requests: list[ChatRequest] = []

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        self.requests += requests
        texts = self.texts if len(self.texts) == len(requests) else self.texts * len(requests)
        return [Reply(text, failure=self.failure) for text in texts[: len(requests)]]


@pytest.mark.parametrize(
    ("text", "name", "caption"),
    [
        ("`office chair':`A black chair on wheels.'", "office chair", "A black chair on wheels."),
        ('"Sofa": "A grey sofa"', "sofa", "A grey sofa"),
        ("‘desk’: ‘a desk’", "desk", "a desk"),
        ('```json\n{"name": "TV stand", "description": "low, wooden"}\n```', "tv stand", "low, wooden"),
        ('Here it is: {"lamp": "a lit lamp"}. Anything else?', "lamp", "a lit lamp"),
        ("{'lamp': 'a lit lamp'}", "lamp", "a lit lamp"),
        ("**Chair**: a wooden chair", "chair", "a wooden chair"),
        ("Name: Potted plant\nDescription: green leaves", "potted plant", "green leaves"),
        ("name': 'vase', 'description': 'a blue vase'", "vase", "a blue vase"),
        ("Sure! Here you go:\n\n`trash can':`A bin'\n`lid':`its lid'", "trash can", "A bin"),
        ("1. Cushion - a soft, red pillow", "cushion", "a soft, red pillow"),
        ("I'm sorry for the blur. `chair':`a chair'", "chair", "a chair"),
        ("chair", "chair", ""),
        ("This is a wooden nightstand with a lamp on top.", "wooden nightstand",
         "This is a wooden nightstand with a lamp on top."),
    ],
)  # fmt: skip
def test_a_name_and_a_description_are_read_out_of_any_form(text: str, name: str, caption: str) -> None:
    assert described(text) == Described(name, caption)


@pytest.mark.parametrize(
    "text",
    [
        "", "   ", "I'm sorry, I can't help with that.", "I cannot: determine what it is", "`name':`description'",
        '{"error": "cannot identify"}', "{" * 5000, "unknown: the object is not visible", "\x1b[31m", "?" * 9000,
        "As an AI, I cannot see images.",
    ],
)  # fmt: skip
def test_refusals_echoes_and_noise_describe_nothing(text: str) -> None:
    assert described(text) is None


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("sofa", "sofa"),
        ("'White Sofa'.", "white sofa"),
        ('The name is "couch".', "couch"),
        ("trash cans", "trash can"),
        ("Indoor Plant", "indoor-plant"),
        ('{"name": "sofa"}', "sofa"),
        ("The best single name for the object based on the given list is **white sofa**.", "white sofa"),
        ("I would call it a sofa", "sofa"),
        ("furniture", "furniture"),
        ("Name: settee", "settee"),
        ("I'm sorry, I can't do that.", None),
        ("Based on the list, this seems to be upholstery, but I cannot say.", None),
        ("It could be a sofa or a trash can, it is hard to say.", None),
        ("", None),
        ("a very long noun phrase that nobody would ever take for the name of a thing", None),
    ],
)
def test_a_chosen_name_is_one_of_the_names_or_a_short_noun_phrase(text: str, name: str | None) -> None:
    assert chosen_name(text, NAMES) == name


def test_ids_of_an_answer_are_those_of_the_map() -> None:
    found = answered(
        'So: {"answer": "bathroom sink", "object_ids": [179, "#60", 7, true], "reasoning": "near"}', (179, 60)
    )
    assert found is not None
    assert (found.text, found.object_ids, found.reasons) == ("bathroom sink", (179, 60), "near")
    prose = answered("The bathroom sink (object_179) is closer to the bed (ID 60), by 5 m.", (5, 60, 179))
    assert prose is not None
    assert prose.object_ids == (179, 60)
    assert answered(" ", (1,)) is None


def test_ids_of_parts_of_objects_are_understood_whole() -> None:
    part = 123456000012  # of object 12; its first nine digits are another's
    known = (123456000, part)
    told = answered(f'{{"answer": "lamp", "object_ids": [{part}], "reference_ids": ["#{part}", 123456000]}}', known)
    assert told is not None
    assert (told.object_ids, told.reference_ids) == ((part,), (123456000,))
    prose = answered(f"The lamp (id {part}) hangs above nothing.", known)
    assert prose is not None and prose.object_ids == (part,)
    digits = answered(f"The lamp (id 1{'0' * 18}) hangs above nothing.", (10**18,))
    assert digits is not None and digits.object_ids == ()


@settings(max_examples=150, deadline=None)
@given(st.text(alphabet=st.sampled_from("ab:'\"`{}[]\n,.*# 1é\x00"), max_size=60))
def test_no_answer_breaks_a_parser(text: str) -> None:
    for found in (described(text), chosen_name(text, NAMES), answered(text, (1,))):
        shown = getattr(found, "name", found if isinstance(found, str) else "")
        assert "\n" not in shown
        assert len(shown) <= 60


def test_the_paper_s_prompt_goes_with_each_crop() -> None:
    model = Spoken("`lamp':`A lit lamp.'")
    crops = [np.full((8, 8, 3), value, np.uint8) for value in (0, 255)]
    captions = Captioner(model, LanguageConfig()).captions(crops, ["thing", "thing"])
    assert [(one.name, one.caption, one.source) for one in captions] == [("lamp", "A lit lamp.", "model")] * 2
    request = model.requests[0]
    assert request.text == "Give name and description to the object. Output e.g. `name':`description'"
    assert (request.model, request.temperature) == ("gpt-4-vision-preview", 0.0)
    assert captions[0].key != captions[1].key


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (Spoken("I'm sorry, I can't help with that."), "the model refused"),
        (Spoken("???"), "the answer cannot be read"),
        (Spoken(""), "an empty answer (no reason given)"),
        (Spoken("", failure="status 500: down"), "status 500: down"),
    ],
)
def test_where_the_model_refuses_the_tagger_s_name_stands(
    model: Spoken, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    crop = np.zeros((8, 8, 3), np.uint8)
    found = Captioner(model, LanguageConfig()).captions([crop, crop], ["indoor-plant", ""])
    assert [(one.name, one.caption) for one in found] == [
        ("indoor-plant", "an indoor-plant in a scene"),
        ("object", "an object in a scene"),
    ]
    assert {(one.source, one.reason) for one in found} == {("fallback", reason)}
    assert [record.getMessage().partition("was: ")[2] for record in caplog.records] == [reason]


def test_a_name_without_a_description_gets_the_simple_caption() -> None:
    crop = np.zeros((8, 8, 3), np.uint8)
    assert (
        Captioner(Spoken("umbrella"), LanguageConfig()).captions([crop], ["x"])[0].caption == "an umbrella in a scene"
    )


def test_a_run_over_a_bad_server_ends_complete_and_asks_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("openai", reason="the models extra is not installed")
    monkeypatch.setenv("SU3D_TEST_KEY", "sk-test-0123456789abcdef")
    n_of: dict[str, int] = {}

    def answer(body: Body) -> Answered:
        url = body["messages"][0]["content"][1]["image_url"]["url"]
        n_of[url] = n_of.get(url, 0) + 1
        first, kind = n_of[url] == 1, sorted(n_of).index(url) % 6
        troubles = [error(429, retry_after="0.01"), error(500), Answered(raw=b"{"), Answered(wait_s=30)]
        if first and kind < 4:
            return troubles[kind]
        return Answered("I'm sorry, I can't help with that." if kind == 4 else "`lamp':`A lamp.'")

    crops = [np.full((4, 4, 3), 9 * k, np.uint8) for k in range(12)]
    with chat_server() as server:
        server.answer = answer
        config = quick_config(server, total_timeout_s=0.4)

        def run() -> list[tuple[str, str]]:
            captioner = Captioner(ChatClient(config, ReplyStore(tmp_path)), config)
            return [(one.name, one.caption) for one in captioner.captions(crops, ["thing"] * 12)]

        captions, n_asked = run(), server.n_asked
        assert len(captions) == 12
        assert {name for name, _ in captions} <= {"lamp", "thing"}
        assert 12 <= n_asked <= 24
        assert run() == captions
        assert server.n_asked == n_asked


def seen() -> Instances:
    """Two instances: one seen as a sofa once and as a couch twice, one never named."""
    made = instances(np.zeros((2, 3), np.float32), [np.array([0]), np.array([1])], None)
    return replace(
        made,
        names=("sofa", "thing"),
        view_indptr=np.array([0, 4, 5]),
        views=np.array([[0, 0], [40, 1], [80, 2], [120, 0], [0, 3]], np.int32),
        view_names=("couch", "sofa", "Couches", "lamp", ""),
        view_scores=np.array([0.5, 0.9, 0.5, 0.1, 0.8]),
    )


def test_the_top_m_names_go_by_score_and_then_by_order() -> None:
    assert top_names(seen(), 3) == [
        TopNames("sofa", ("sofa", "couch", "Couches"), (0.9, 0.5, 0.5)),
        TopNames("thing", (), ()),
    ]
    with pytest.raises(PredictionError, match="keeps no names of its views"):
        top_names(replace(seen(), view_names=None), 3)


def test_the_vote_sums_scores_over_spellings_of_one_name() -> None:
    assert vote(TopNames("sofa", ("sofa", "couch", "Couches"), (0.9, 0.5, 0.5))).name == "couch"
    assert vote(TopNames("sofa", ("sofa", "couch"), (0.5, 0.5))).name == "sofa"
    nobody = vote(TopNames("thing", (), ()))
    assert (nobody.name, nobody.source) == ("thing", "label")


def test_the_model_refines_with_the_paper_s_prompt_and_n_stays_where_it_does_not() -> None:
    model = Spoken("seat")
    refined = ModelRefiner(model, LanguageConfig()).refine(top_names(seen(), 3))
    assert [(one.name, one.source) for one in refined] == [("seat", "model"), ("thing", "label")]
    assert model.requests[0].system.startswith("assign a single name to the object based on a given list of names")
    assert model.requests[0].text == '["sofa", "couch", "Couches"]'
    assert len(model.requests) == 1
    refused = ModelRefiner(Spoken("I'm sorry, I can't."), LanguageConfig()).refine(top_names(seen(), 3))[0]
    assert (refused.name, refused.source, refused.reason) == ("sofa", "label", "the model refused")


def test_a_map_keeps_the_names_of_its_views_on_disk() -> None:
    back = prediction_from_arrays(prediction_arrays(seen()), "here")
    assert isinstance(back, Instances)
    assert back.view_names == seen().view_names
    assert back.view_scores is not None
    assert back.view_scores.tolist() == [0.5, 0.9, 0.5, 0.1, 0.8]
    without = prediction_arrays(replace(seen(), view_names=None, view_scores=None))
    assert "view_names" not in without
    assert prediction_from_arrays(without, "here").view_names is None  # type: ignore[union-attr]
    with pytest.raises(PredictionError, match="5 views and 1 names"):
        replace(seen(), view_names=("sofa",))


def test_labels_n_prime_belong_to_one_map(tmp_path: Path) -> None:
    job = JobFolder(tmp_path)
    assert read_records(job) is None
    write_prediction(job.prediction, seen())
    tops = top_names(seen(), 3)
    records = records_of(job, seen(), tops, [vote(top) for top in tops], "vote", "", 3, FilterConfig())
    path = write_records(job, records)
    assert read_records(job) == records
    assert records.refined.names == ("couch", "thing")
    write_prediction(job.prediction, replace(seen(), names=("a", "b")))
    with pytest.raises(StoreError, match="belongs to another map"):
        read_records(job)
    path.write_text('{"names": 3}')
    with pytest.raises(StoreError, match="is not as su3d-bench runs refine writes it"):
        read_records(job)
