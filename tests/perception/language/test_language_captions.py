"""Names and captions by a vision model, labels n' by vote and by a model, and parsing of free-form answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scored_room import instances

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.perception.language.captioner import Captioner
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply
from su3d_bench.perception.language.parsing import Described, answered, chosen_name, described
from su3d_bench.questions.refining import ModelRefiner, TopNames, top_names, vote

NAMES = ("white sofa", "sofa", "couch", "trash can", "indoor-plant")


class Spoken:
    """A language model with one reply for all requests, or those of ``texts`` in turn."""

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
        ("object: chair - a wooden chair", "chair", "a wooden chair"),
        ("Object: office chair", "office chair", ""),
        ("Object: a chair.", "chair", ""),
        ("**chair**", "chair", ""),
        ("`Object': `chair'", "chair", ""),
        ("This is a chair. It is made of wood.", "chair", ""),
        ("The image shows a chair: it's wooden", "chair", "it's wooden"),
        ("Name - chair, Description - wooden", "chair", "wooden"),
        ("label maker: white, on a desk", "label maker", "white, on a desk"),
    ],
)  # fmt: skip
def test_name_and_description_are_parsed_from_each_format(text: str, name: str, caption: str) -> None:
    assert described(text) == Described(name, caption)


@pytest.mark.parametrize(
    "text",
    [
        "", "   ", "I'm sorry, I can't help with that.", "I cannot: determine what it is", "`name':`description'",
        '{"error": "cannot identify"}', "{" * 5000, "unknown: the object is not visible", "\x1b[31m", "?" * 9000,
        "As an AI, I cannot see images.", "Unidentified object", "`Unidentified object':`A blurred shape'",
        "I cannot identify the object", "unknown", "Unknown object", "object: unknown", "undetectable", "nothing",
        "Object: Undefined - blurry", "A blurry object", "The object is unidentifiable.", "mystery item",
    ],
)  # fmt: skip
def test_refusals_echoes_and_noise_give_no_caption(text: str) -> None:
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
        ("Object: a settee.", "settee"),
        ("Unidentified object", None),
        ("unknown", None),
        ("I'm sorry, I can't do that.", None),
        ("Based on the list, this seems to be upholstery, but I cannot say.", None),
        ("It could be a sofa or a trash can, it is hard to say.", None),
        ("", None),
        ("a very long noun phrase that nobody would ever take for the name of a thing", None),
    ],
)
def test_chosen_name_is_one_of_the_names_or_a_short_noun_phrase(text: str, name: str | None) -> None:
    assert chosen_name(text, NAMES) == name


def test_answer_ids_are_restricted_to_the_map() -> None:
    found = answered(
        'So: {"answer": "bathroom sink", "object_ids": [179, "#60", 7, true], "reasoning": "near"}', (179, 60)
    )
    assert found is not None
    assert (found.text, found.object_ids, found.reasons) == ("bathroom sink", (179, 60), "near")
    prose = answered("The bathroom sink (object_179) is closer to the bed (ID 60), by 5 m.", (5, 60, 179))
    assert prose is not None
    assert prose.object_ids == (179, 60)
    assert answered(" ", (1,)) is None


def test_long_part_ids_are_parsed_completely() -> None:
    part = 123456000012  # of object 12; its first nine digits are the id of another object
    known = (123456000, part)
    result = answered(f'{{"answer": "lamp", "object_ids": [{part}], "reference_ids": ["#{part}", 123456000]}}', known)
    assert result is not None
    assert (result.object_ids, result.reference_ids) == ((part,), (123456000,))
    prose = answered(f"The lamp (id {part}) hangs above nothing.", known)
    assert prose is not None and prose.object_ids == (part,)
    digits = answered(f"The lamp (id 1{'0' * 18}) hangs above nothing.", (10**18,))
    assert digits is not None and digits.object_ids == ()


def test_each_crop_is_sent_with_the_paper_prompt() -> None:
    model = Spoken("`lamp':`A lit lamp.'")
    crops = [np.full((8, 8, 3), value, np.uint8) for value in (0, 255)]
    captions = Captioner(model, LanguageConfig()).captions(crops, ["thing", "thing"])
    assert [(one.name, one.caption, one.source) for one in captions] == [("lamp", "A lit lamp.", "model")] * 2
    request = model.requests[0]
    assert request.text == "Give name and description to the object. Output e.g. `name':`description'"
    assert (request.model, request.temperature, request.reasoning_effort) == ("gpt-6-luna", 0.0, "none")
    papers = Captioner(model, LanguageConfig(preset="paper")).requests(crops)[0]
    assert (papers.model, papers.reasoning_effort) == ("gpt-4-vision-preview", "")
    assert "reasoning_effort" not in papers.body() and papers.key != request.key
    assert captions[0].key != captions[1].key


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (Spoken("I'm sorry, I can't help with that."), "the model refused"),
        (Spoken("???"), "the answer cannot be parsed"),
        (Spoken(""), "an empty answer (no reason given)"),
        (Spoken("", failure="status 500: down"), "status 500: down"),
    ],
)
def test_tagger_name_is_used_when_the_model_refuses(
    model: Spoken, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    crop = np.zeros((8, 8, 3), np.uint8)
    found = Captioner(model, LanguageConfig()).captions([crop, crop], ["indoor-plant", ""])
    assert [(one.name, one.caption) for one in found] == [
        ("indoor-plant", "an indoor-plant in a scene"),
        ("object", "an object in a scene"),
    ]
    assert {(one.source, one.reason) for one in found} == {("fallback", reason)}
    assert [record.getMessage().partition("unusable replies: ")[2] for record in caplog.records] == [reason]


def seen() -> Instances:
    """Two instances: one named sofa once and couch twice, one never named."""
    made = instances(np.zeros((2, 3), np.float32), [np.array([0]), np.array([1])], None)
    return replace(
        made,
        names=("sofa", "thing"),
        view_indptr=np.array([0, 4, 5]),
        views=np.array([[0, 0], [40, 1], [80, 2], [120, 0], [0, 3]], np.int32),
        view_names=("couch", "sofa", "Couches", "lamp", ""),
        view_scores=np.array([0.5, 0.9, 0.5, 0.1, 0.8]),
    )


def test_top_m_names_are_sorted_by_score_then_order() -> None:
    assert top_names(seen(), 3) == [
        TopNames("sofa", ("sofa", "couch", "Couches"), (0.9, 0.5, 0.5)),
        TopNames("thing", (), ()),
    ]
    with pytest.raises(PredictionError, match="has no per-view names"):
        top_names(replace(seen(), view_names=None), 3)


def test_vote_sums_scores_over_spellings() -> None:
    assert vote(TopNames("sofa", ("sofa", "couch", "Couches"), (0.9, 0.5, 0.5))).name == "couch"
    assert vote(TopNames("sofa", ("sofa", "couch"), (0.5, 0.5))).name == "sofa"
    nobody = vote(TopNames("thing", (), ()))
    assert (nobody.name, nobody.source) == ("thing", "label")


def test_model_refines_labels_and_falls_back_to_label_n() -> None:
    model = Spoken("seat")
    refined = ModelRefiner(model, LanguageConfig()).refine(top_names(seen(), 3))
    assert [(one.name, one.source) for one in refined] == [("seat", "model"), ("thing", "label")]
    assert model.requests[0].system.startswith("assign a single name to the object based on a given list of names")
    assert model.requests[0].text == '["sofa", "couch", "Couches"]'
    assert len(model.requests) == 1
    refused = ModelRefiner(Spoken("I'm sorry, I can't."), LanguageConfig()).refine(top_names(seen(), 3))[0]
    assert (refused.name, refused.source, refused.reason) == ("sofa", "label", "the model refused")
