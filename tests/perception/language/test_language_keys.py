"""A server that says the key back, in whatever dress: nothing of it is kept, told or counted."""

from __future__ import annotations

import base64
import codecs
import html
import json
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

import pytest
from chat_server import Answered, ChatServer, error, quick_config

from su3d_bench.core.errors import Su3dError
from su3d_bench.perception.language.chat import ChatRequest
from su3d_bench.perception.language.client import ChatClient
from su3d_bench.perception.language.key_cleaning import Secret
from su3d_bench.perception.language.parsing import answered, described
from su3d_bench.perception.language.reply_store import ReplyStore

KEY = "sk-proj-Tq7_Zb3Kx9Lm2Vw8Rc5Yd1Hf6Jn4Gs0Pu"
INSIDE = KEY[12:30]
DRESSES: dict[str, Callable[[str], str]] = {
    "plain": str,
    "upper": str.upper,
    "lower": str.lower,
    "swapped": str.swapcase,
    "backwards": lambda key: key[::-1],
    "spaced": " ".join,
    "lines": "\n".join,
    "quoted": lambda key: "' + '".join([key[:5], key[5:11], key[11:]]),
    "invisible": "\u200b".join,
    "wide": lambda key: "".join(chr(ord(one) + 0xFEE0) for one in key),
    "first half": lambda key: key[: len(key) // 2],
    "inside": lambda key: f"it holds {INSIDE} in it",
    "percent": lambda key: "".join(f"%{ord(one):02x}" for one in key),
    "percent twice": lambda key: quote("".join(f"%{ord(one):02X}" for one in key)),
    "json": lambda key: "".join(f"\\u{ord(one):04x}" for one in key),
    "python": lambda key: "".join(f"\\x{ord(one):02x}" for one in key),
    "octal": lambda key: "".join(f"\\{ord(one):03o}" for one in key),
    "blanks between": "\\t".join,
    "entities": lambda key: "".join(f"&#{ord(one)};" for one in key),
    "entities twice": lambda key: html.escape("".join(f"&#x{ord(one):x};" for one in key)),
    "base64": lambda key: base64.b64encode(key.encode()).decode(),
    "base64 later": lambda key: "see: " + base64.b64encode(f"x{key}y".encode()).decode(),
    "base64 of capitals": lambda key: base64.b64encode(key.upper().encode()).decode(),
    "base64 in lines": lambda key: base64.encodebytes((key * 3).encode()).decode(),
    "base64 backwards": lambda key: base64.b64encode(key.encode()).decode()[::-1],
    "base64 for addresses": lambda key: base64.urlsafe_b64encode(f"??>{key}".encode()).decode(),
    "base64 in percent": lambda key: quote(base64.b64encode(key.encode()).decode(), safe=""),
    "base32": lambda key: base64.b32encode(key.encode()).decode().lower(),
    "hex": lambda key: key.encode().hex(),
    "hex apart": lambda key: "the bytes are " + key.encode().hex(":"),
    "hex list": lambda key: ", ".join(f"0x{ord(one):02x}" for one in key),
    "numbers": lambda key: ", ".join(str(ord(one)) for one in key),
    "rot13": lambda key: codecs.encode(key, "rot13"),
}


@pytest.fixture
def server(chat: ChatServer, monkeypatch: pytest.MonkeyPatch) -> ChatServer:
    monkeypatch.setenv("SU3D_TEST_KEY", KEY)
    return chat


def request(text: str) -> ChatRequest:
    return ChatRequest("ask", "tiny-model", "be brief", text, max_answer_tokens=20)


def tells(text: str, dress: Callable[[str], str]) -> bool:
    """Whether ``text`` holds eight characters of the dressed key or of the key, in any case."""
    pieces = {one[k : k + 8].lower() for one in (dress(KEY), KEY, KEY[::-1]) for k in range(len(one) - 7)}
    return any(piece in text.lower() for piece in pieces if sum(map(str.isalnum, piece)) == 8)


@pytest.mark.parametrize("dress", DRESSES)
def test_no_text_keeps_the_key_in_any_dress(dress: str) -> None:
    told = DRESSES[dress](KEY)
    for text in (told, f"The lamp: {told}.", json.dumps({"name": told})):
        cleaned = Secret(KEY).cleaned(text)
        assert "(key)" in cleaned and not tells(cleaned, DRESSES[dress]), cleaned


@pytest.mark.parametrize("dress", ["plain", "upper", "first half", "percent", "base64", "json", "backwards", "spaced"])
@pytest.mark.parametrize("place", ["text", "finish", "model", "error", "kind", "page"])
def test_whatever_a_server_says_is_cleaned(server: ChatServer, tmp_path: Path, place: str, dress: str) -> None:
    told = DRESSES[dress](KEY)
    one_line = " ".join(told.split())
    server.script = [
        {
            "text": Answered(f"a lamp {told}"),
            "finish": Answered(finish=told),
            "model": Answered(model=told),
            "error": error(400, f"no {told}", told),
            "kind": Answered(raw=b"{}", kind=f"text/{one_line.encode('ascii', 'ignore').decode()}"),
            "page": Answered(raw=told.encode()),
        }[place]
    ]
    try:
        said = repr(ChatClient(quick_config(server, max_retries=0), ReplyStore(tmp_path)).ask(request("x")))
    except Su3dError as caught:
        said = str(caught)
    files = "".join(path.read_text() for path in tmp_path.rglob("*.json"))
    assert said and not tells(said + files, DRESSES[dress]), said


def test_a_key_in_pieces_over_several_fields_is_not_kept(server: ChatServer, tmp_path: Path) -> None:
    server.script = [Answered("a lamp", model=KEY[:8], finish=KEY[8:15])]
    reply = ChatClient(quick_config(server), ReplyStore(tmp_path)).ask(request("x"))
    assert (reply.text, reply.model, reply.finish_reason) == ("a lamp", "(key)", "(key)")


@pytest.mark.parametrize("text", [r"\ud800", r"&#xd800;\udc00", r"%ed%a0%80 \ud83d"])
def test_half_of_a_pair_of_characters_in_an_escape_ends_nothing(text: str) -> None:
    assert Secret(KEY).cleaned(text) == text
    assert Secret(KEY).cleaned(text + KEY) != text + KEY


def test_a_key_said_in_numbers_is_not_kept(server: ChatServer, tmp_path: Path) -> None:
    server.script = [Answered(usage=(int.from_bytes(KEY.encode()), 1)), Answered("a lamp")]
    reply = ChatClient(quick_config(server), ReplyStore(tmp_path)).ask(request("x"))
    assert (reply.text, reply.input_tokens) == ("a lamp", 10)
    server.script = [error(429, "wait", retry_after=str(int.from_bytes(KEY.encode())))]
    assert ChatClient(quick_config(server), ReplyStore(tmp_path)).ask(request("y")).failure.endswith("1000000 s")


def test_what_is_read_out_of_an_answer_holds_no_key_either() -> None:
    hidden = DRESSES["json"](KEY)
    for text in (f'{{"name": "{hidden}", "description": "a lamp"}}', f"{{'answer': '{hidden}', 'object_ids': [3]}}"):
        cleaned = Secret(KEY).cleaned(text)
        assert KEY.lower() not in f"{described(cleaned)}{answered(cleaned, [3])}".lower()


@pytest.mark.parametrize(
    "text",
    [
        "`office chair':`A black chair on wheels.'",
        '{"answer": "the lamp", "object_ids": [3, 12345678], "reasoning": "100 % closer, \\u00e9t\\u00e9 &amp; co"}',
        "C:\\new\\table %s 0x1f " + "ab " * 200,
        "an empty shelf, none of the test objects",
    ],
)
@pytest.mark.parametrize("key", [KEY, "", "EMPTY", "none", "abc"])
def test_what_holds_no_key_stays_as_it_is(key: str, text: str) -> None:
    assert Secret(key).cleaned(text) == text


def test_a_short_key_is_looked_for_as_a_whole() -> None:
    secret = Secret("Pass12")
    assert secret.cleaned("the word is pass-12 or 21ssap, not pass1") == "the word is (key) or (key), not pass1"
