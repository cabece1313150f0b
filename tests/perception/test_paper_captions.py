"""A run of the profile ``paper`` with captions from a local vision model that fails in every way."""

from __future__ import annotations

import shutil
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from chat_server import Answered, Body, ChatServer, error
from tiny_models import paper_words, write_models

from su3d_bench.cli.main import main
from su3d_bench.core.files.atomic import read_json
from su3d_bench.core.maps import Instances
from su3d_bench.perception.language.captioner import DESCRIBE
from su3d_bench.store.predictions import read_prediction

TIMEOUT_S = 1.5  # a hung connection is closed after this; long enough for good answers on a busy machine
N_TRIES = 2


class FailingModel:
    """Answers images in turn in different ways: well, with a refusal, in broken JSON, ...; counts the images."""

    KINDS = ("good", "refusal", "malformed", "429", "500", "hung", "good")

    def __init__(self) -> None:
        self.asked: Counter[str] = Counter()
        self.kinds: dict[str, str] = {}
        self._lock = threading.Lock()

    def __call__(self, body: Body) -> Answered:
        text, picture = body["messages"][-1]["content"]
        assert text["text"] == DESCRIBE
        with self._lock:
            url = picture["image_url"]["url"]
            self.asked[url] += 1
            kind = self.kinds.setdefault(url, self.KINDS[len(self.kinds) % len(self.KINDS)])
            if kind == "429" and self.asked[url] > 1:
                kind = "good"
            number = list(self.kinds).index(url)
        answers: dict[str, Answered] = {
            "good": Answered(f"`thing {number}':`A thing with the number {number}.'"),
            "refusal": Answered("I'm sorry, I can't help with that."),
            "malformed": Answered(raw=b'{"choices": [{"message": '),
            "429": error(429, "slow down"),
            "500": error(500, "out of order"),
            "hung": Answered(wait_s=60.0),
        }
        return answers[kind]

    def n_sent(self, kind: str) -> set[int]:
        """How often images of ``kind`` were sent."""
        return {self.asked[url] for url, one in self.kinds.items() if one == kind}


class Finished:
    """A finished run, and the server that it used."""

    def __init__(self, root: Path, models: Path, server: ChatServer) -> None:
        self.root, self.server, self.model = root, server, FailingModel()
        self._models = models
        server.answer = self.model
        self.code = self.run("first")

    def run(self, folder: str, *words: str) -> int:
        settings = ["perception.paper.captions=model", f"perception.language.base_url={self.server.url}"]
        settings += [f"perception.language.timeout_s={TIMEOUT_S}"]
        settings += [f"perception.language.max_retries={N_TRIES - 1}", "perception.language.max_failures_in_a_row=50"]
        settings += ["perception.language.max_concurrent=8", "perception.language.key_variable=SU3D_TEST_KEY"]
        return main(paper_words(self._models, self.root / folder, "rooms/bathroom0", settings, "--limit", "4", *words))

    def file(self, name: str, folder: str = "first") -> Path:
        return next((self.root / folder).glob(f"scenes/*/opensu3d/{name}"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, rooms_data: Path) -> Iterator[Finished]:
    root = tmp_path_factory.mktemp("captions")
    models = write_models(root / "models")
    with pytest.MonkeyPatch.context() as patch, ChatServer() as server:
        patch.setenv("SU3D_DATA", str(rooms_data))
        patch.setenv("SU3D_CACHE", str(root / "cache"))
        patch.delenv("SU3D_TEST_KEY", raising=False)
        yield Finished(root, models, server)


def test_run_completes_for_any_model_replies(made: Finished) -> None:
    assert made.code == 0
    assert set(made.model.kinds.values()) == set(FailingModel.KINDS), "every kind of answer was given"


def test_map_has_model_captions_with_tagger_fallback(made: Finished) -> None:
    found = read_prediction(made.file("prediction.npz"))
    assert isinstance(found, Instances) and found.captions is not None
    of_model = [caption for caption in found.captions if caption.startswith("A thing with the number ")]
    assert of_model and all(
        name.startswith("thing ")
        for name, caption in zip(found.names, found.captions, strict=True)
        if caption in of_model
    )
    assert any(caption.endswith(" in a scene") for caption in found.captions)


def test_fallbacks_and_reasons_are_logged_and_recorded(made: Finished) -> None:
    log, record = made.file("log.txt").read_text(), (made.root / "first" / "run.json").read_text()
    for reason in ("the model refused", "is not a chat completion", "status 500: out of order", "no answer within"):
        assert reason in log, reason
        assert reason in record, reason


def test_each_crop_is_requested_once_unless_unanswered(made: Finished) -> None:
    assert made.model.n_sent("good") == made.model.n_sent("refusal") == {1}
    assert made.model.n_sent("429") == {2}
    assert made.model.n_sent("malformed") == {1}
    for kind in ("500", "hung"):
        assert made.model.n_sent(kind) == {N_TRIES}


def test_replies_are_stored_with_run_and_rerun_sends_nothing(made: Finished) -> None:
    replies = [read_json(path) for path in (made.root / "first" / "language").glob("*.json")]
    assert len(replies) == len(made.model.kinds)
    assert {reply["purpose"] for reply in replies} == {"caption"}
    n_asked = made.server.n_asked
    assert made.run("first") == 0
    assert made.server.n_asked == n_asked


def test_offline_rerun_from_stored_replies_gives_same_numbers(
    made: Finished, capsys: pytest.CaptureFixture[str]
) -> None:
    n_asked = made.server.n_asked
    assert made.run("again", "--offline") == 2
    assert "no stored reply to this caption request" in capsys.readouterr().err
    shutil.copytree(made.root / "first" / "language", made.root / "again" / "language")
    assert made.run("again", "--offline") == 0
    assert made.server.n_asked == n_asked
    first, again = (read_json(made.root / folder / "metrics.json") for folder in ("first", "again"))
    assert first == again
    assert made.file("prediction.npz").read_bytes() == made.file("prediction.npz", "again").read_bytes()
