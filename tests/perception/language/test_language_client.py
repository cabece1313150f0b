"""The client of language models with a server that answers, refuses, fails, hangs and floods."""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chat_server import KEY, Answered, ChatServer, error, quick_config

from su3d_bench.core.errors import ConfigError, ModelMissing, RunIncomplete, StoreError
from su3d_bench.perception.language.chat import ChatRequest, Image, LanguageConfig, Price, ReplyStore, fitted
from su3d_bench.perception.language.client import HOSTED, ChatClient
from su3d_bench.perception.language.parsing import CaptionForm


@pytest.fixture
def server(chat: ChatServer, monkeypatch: pytest.MonkeyPatch) -> ChatServer:
    monkeypatch.setenv("SU3D_TEST_KEY", KEY)
    return chat


def ask(text: str, **changes: Any) -> ChatRequest:
    return ChatRequest("ask", "tiny-model", "be brief", text, max_answer_tokens=20, **changes)


def client(server: ChatServer, folder: Path, **changes: Any) -> ChatClient:
    return ChatClient(quick_config(server, **changes), ReplyStore(folder))


def everything_in(folder: Path) -> str:
    return "".join(path.read_text(errors="replace") for path in sorted(folder.rglob("*")) if path.is_file())


def test_rerun_uses_stored_replies(server: ChatServer, tmp_path: Path) -> None:
    server.answer = lambda body: Answered("a lamp")
    first = client(server, tmp_path).ask_all([ask("one"), ask("two"), ask("one")])
    assert [reply.text for reply in first] == ["a lamp"] * 3
    assert server.n_asked == 2
    files = everything_in(tmp_path)
    again = client(server, tmp_path).ask_all([ask("one"), ask("two")])
    assert server.n_asked == 2 and again == first[:2] and all(reply.was_stored for reply in again)
    assert everything_in(tmp_path) == files


def test_request_is_a_chat_completion(server: ChatServer, tmp_path: Path) -> None:
    picture = Image(np.zeros((4, 6, 3), np.uint8))
    client(server, tmp_path).ask(ask("what is it?", images=(picture,), form=CaptionForm))
    body = server.bodies[0]
    assert (body["model"], body["temperature"], body["seed"], body["max_tokens"]) == ("tiny-model", 0.0, 0, 20)
    assert body["messages"][0] == {"role": "system", "content": "be brief"}
    words, image = body["messages"][1]["content"]
    assert words == {"type": "text", "text": "what is it?"}
    assert image["image_url"]["url"].startswith("data:image/png;base64,")
    assert set(body["response_format"]["json_schema"]["schema"]["properties"]) == {"name", "description"}
    assert server.headers[0]["authorization"] == f"Bearer {KEY}"
    assert (tmp_path / "images" / f"{picture.digest}.png").is_file()


def test_offline_replay_needs_no_key_and_reports_missing_replies(
    server: ChatServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client(server, tmp_path).ask(ask("known"))
    monkeypatch.delenv("SU3D_TEST_KEY")
    monkeypatch.setitem(sys.modules, "openai", None)
    offline = ChatClient(LanguageConfig(), ReplyStore(tmp_path), offline=True)
    assert offline.ask(ask("known")).text == "ok"
    with pytest.raises(StoreError, match=r"no stored reply to this ask request of model 'tiny-model'.*--offline"):
        offline.ask(ask("unknown"))
    assert server.n_asked == 1


@pytest.mark.parametrize("trouble", [error(429, "slow down"), error(503, "busy")])
def test_transient_errors_are_retried(server: ChatServer, tmp_path: Path, trouble: Answered) -> None:
    server.script = [trouble]
    assert client(server, tmp_path).ask(ask("x")).text == "ok"
    assert server.n_asked == 2


@pytest.mark.parametrize(
    ("trouble", "reason"),
    [
        (error(400, "content policy"), "status 400: content policy"),
        (Answered(status=302, headers={"Location": "http://127.0.0.1:9/elsewhere"}), "status 302"),
        (Answered(raw=b"{not json"), "not a chat completion: '{not json'"),
        (Answered(raw=b"[" * 100_000), "not a chat completion"),
        (Answered(raw=b"<html>gateway</html>", kind="text/html"), "not a chat completion: '<html>"),
        (Answered(raw=b'{"choices": [{"message": {"content": 5}}]}'), "not a chat completion"),
        (Answered(usage=(10**30, 1)), "not a chat completion"),
        (Answered(raw=b" " * 3_000_000), "larger than 100,000 bytes"),
        (Answered(raw=b"\x1f\x8b" + bytes(100), headers={"Content-Encoding": "gzip"}), "the answer is compressed"),
        (Answered(wait_s=30), "no answer within 0.3 s; attempts: 1"),
    ],
    ids=["refused", "redirect", "malformed", "nested", "html", "wrong-type", "usage", "huge", "compressed", "hung"],
)
def test_invalid_response_is_a_request_failure(
    server: ChatServer, tmp_path: Path, trouble: Answered, reason: str
) -> None:
    server.script = [trouble]
    reply = client(server, tmp_path, max_answer_bytes=100_000, timeout_s=0.3, max_retries=0).ask(ask("x"))
    assert reason in reply.failure and "\n" not in reply.failure
    assert server.n_asked == 1


def test_permanent_failure_is_stored_and_retried_only_on_request(server: ChatServer, tmp_path: Path) -> None:
    server.answer = lambda body: error(500, "down")
    failed = client(server, tmp_path).ask(ask("x"))
    assert failed.failure == "status 500: down; attempts: 2"
    server.answer = lambda body: Answered("up again")
    assert client(server, tmp_path).ask(ask("x")) == failed
    assert server.n_asked == 2
    again = ChatClient(quick_config(server), ReplyStore(tmp_path), retry_failed=True)
    assert [reply.text for reply in again.ask_all([ask("x"), ask("x")])] == ["up again"] * 2
    assert server.n_asked == 3


def test_repeated_server_failures_end_the_command(server: ChatServer, tmp_path: Path) -> None:
    server.answer = lambda body: error(500)
    with pytest.raises(ModelMissing, match="3 consecutive requests failed"):
        client(server, tmp_path, max_retries=0, max_failures_in_a_row=3, max_concurrent=1).ask_all(
            [ask(str(k)) for k in range(9)]
        )
    assert server.n_asked == 3


@pytest.mark.parametrize(
    ("trouble", "line"),
    [
        (error(401, f"Incorrect API key provided: {KEY}"), r"rejects the key in \$SU3D_TEST_KEY"),
        (error(404, "model 'tiny-model' not found"), "unknown model or address"),
        (error(429, "pay", "insufficient_quota"), "no quota left"),
    ],
)
def test_fatal_server_errors_give_one_line(server: ChatServer, tmp_path: Path, trouble: Answered, line: str) -> None:
    server.script = [trouble]
    with pytest.raises(ModelMissing, match=line) as caught:
        client(server, tmp_path, max_retries=0).ask(ask("x"))
    assert KEY not in str(caught.value) and "\n" not in str(caught.value)


def test_api_key_is_never_written_or_printed(server: ChatServer, tmp_path: Path) -> None:
    server.script = [
        Answered(f"your key is {KEY}", model=KEY, finish=KEY),
        error(400, f"bad request with {KEY} and sk-other-987654321"),
        Answered(raw=KEY.encode()),
    ]
    asked = client(server, tmp_path, max_retries=0)
    assert asked.ask(ask("x")).text == "your key is (key)"
    assert asked.ask(ask("y")).failure == "status 400: bad request with (key) and (key)"
    asked.ask(ask("z"))
    assert KEY not in everything_in(tmp_path) and "sk-other" not in everything_in(tmp_path)


def test_only_the_hosted_service_needs_an_api_key(
    server: ChatServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SU3D_TEST_KEY")
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    assert HOSTED == "https://api.openai.com/v1"
    with pytest.raises(ModelMissing, match=r"\$SU3D_TEST_KEY is not set"):
        ChatClient(quick_config(base_url=""), ReplyStore(tmp_path)).ask(ask("x"))
    monkeypatch.setenv("OPENAI_BASE_URL", server.url)
    assert client(server, tmp_path, base_url="").ask(ask("x")).text == "ok"


def test_refused_parameters_are_dropped_and_recorded(server: ChatServer, tmp_path: Path) -> None:
    server.script = [
        error(400, "Unsupported parameter: 'max_tokens' is not supported; use 'max_completion_tokens' instead"),
        error(400, "seed is not supported by this model"),
        error(422, "response_format: unknown field"),
    ]
    asked = client(server, tmp_path)
    left_out = ("max_tokens", "seed", "response_format")
    assert asked.ask(ask("x", form=CaptionForm)).dropped == asked.ask(ask("y", form=CaptionForm)).dropped == left_out
    assert server.n_asked == 5
    assert not {"seed", "response_format"} & set(server.bodies[-1])
    assert server.bodies[-1]["max_completion_tokens"] == 20


def test_damaged_reply_is_requested_again(server: ChatServer, tmp_path: Path) -> None:
    client(server, tmp_path).ask(ask("x"))
    path = ReplyStore(tmp_path).path(ask("x").key)
    entry = json.loads(path.read_text())
    entry["reply"]["text"] = "forged"
    for content in (json.dumps(entry), "{", "[]", "[" * 50_000):
        path.write_text(content)
        assert ReplyStore(tmp_path).load(ask("x").key) is None
    server.answer = lambda body: Answered("again")
    assert client(server, tmp_path).ask(ask("x")).text == "again"
    assert ReplyStore(tmp_path).load(ask("x").key) is not None


def test_first_reply_of_two_processes_is_stored(server: ChatServer, tmp_path: Path) -> None:
    server.answer = lambda body: Answered(f"answer {len(server.bodies)}")
    clients = [client(server, tmp_path) for _ in range(4)]
    replies: list[str] = []
    threads = [threading.Thread(target=lambda one=one: replies.append(one.ask(ask("x")).text)) for one in clients]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    kept = ReplyStore(tmp_path).load(ask("x").key)
    assert kept is not None and set(replies) == {kept.text}


def test_budget_is_never_exceeded_and_can_be_raised(server: ChatServer, tmp_path: Path) -> None:
    server.answer = lambda body: Answered(usage=(30, 10))
    questions = [ask(str(k)) for k in range(5)]
    most = questions[0].n_input_tokens + 20  # maximum cost of one request
    with pytest.raises(RunIncomplete, match=r"budget_tokens = .* is reached"):
        client(server, tmp_path, budget_tokens=80 + most, max_concurrent=1).ask_all(questions)
    assert server.n_asked == 3
    assert len(client(server, tmp_path, budget_tokens=1000).ask_all(questions)) == 5
    assert server.n_asked == 5


def test_dollar_budget_needs_a_price(server: ChatServer, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'tiny-model' has no price"):
        client(server, tmp_path, budget_usd=1.0).ask(ask("x"))
    priced = {"tiny-model": Price(input_usd=1e6, output_usd=2e6)}  # one dollar per input token, two per output token
    asked = client(server, tmp_path, budget_usd=100.0, prices=priced)
    asked.ask(ask("x"))
    assert asked.spending.usd == 10 * 1 + 5 * 2
    with pytest.raises(RunIncomplete, match="budget_usd = 30 is reached"):
        client(server, tmp_path, budget_usd=30.0, prices=priced).ask(ask("y"))
    assert server.n_asked == 1


def test_estimate_counts_stored_replies_and_sends_nothing(server: ChatServer, tmp_path: Path) -> None:
    priced = {"tiny-model": Price(input_usd=1.0, output_usd=2.0)}
    asked = client(server, tmp_path, prices=priced)
    asked.ask(ask("stored"))
    estimate = asked.estimate([ask("stored"), ask("new"), ask("new")])
    assert server.n_asked == 1
    assert (estimate.n_requests, estimate.n_stored, estimate.output_tokens) == (2, 1, 20)
    assert estimate.usd == pytest.approx((ask("new").n_input_tokens * 1.0 + 20 * 2.0) / 1e6)
    assert client(server, tmp_path).estimate([ask("new")]).usd is None


def test_rate_limit_spaces_requests(server: ChatServer, tmp_path: Path) -> None:
    pauses: list[float] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("su3d_bench.perception.language.client.sleep", pauses.append)
        patch.setattr("su3d_bench.perception.language.client.monotonic", lambda: 100.0)
        client(server, tmp_path, requests_per_minute=30, max_concurrent=1).ask_all([ask(str(k)) for k in range(3)])
    assert pauses == [0.0, 2.0, 4.0]


def test_images_are_keyed_by_pixels_and_token_counts_match_openai() -> None:
    pixels = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
    assert Image(pixels).digest == Image(pixels.copy()).digest != Image(pixels[:, ::-1]).digest
    assert ask("x", images=(Image(pixels),)).key != ask("x").key
    assert max(fitted(np.zeros((100, 400, 3), np.uint8), 64).rgb.shape) == 64
    # OpenAI's own examples: 1024x1024 costs 765 tokens in high detail, 2048x4096 costs 1105.
    assert Image(np.zeros((1024, 1024, 3), np.uint8)).n_tokens("high") == 765
    assert Image(np.zeros((4096, 2048, 3), np.uint8)).n_tokens("high") == 1105
    assert Image(np.zeros((4096, 2048, 3), np.uint8)).n_tokens("low") == 85


@pytest.mark.parametrize("address", ["ftp://x", "http://user:secret@host/v1", "localhost:8000", "http://h/v1?key=1"])
def test_invalid_urls_and_urls_with_credentials_fail(address: str) -> None:
    with pytest.raises(ValueError, match=r"expected an http|set keys in the environment"):
        LanguageConfig(base_url=address)
