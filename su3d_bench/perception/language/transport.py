"""One attempt to have a request answered by an OpenAI-compatible server, whatever that server does.

An attempt ends within the total time-out, reads no more than the cap, and never shows the key: each text of a server
goes through ``key_cleaning.py`` before it is kept, told or judged, and its numbers have a bound. It gives a reply, or
raises ``TryAgain`` (the next attempt may do better), ``GiveUp`` (this request never will), or a ``Su3dError`` (no
request will: no server, no key, no such model).
"""

from __future__ import annotations

import email.utils
import importlib
import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, ValidationError

from su3d_bench.core.errors import ConfigError, ModelMissing, printable
from su3d_bench.perception.language.chat import ChatRequest, Reply, n_tokens
from su3d_bench.perception.language.config import LanguageConfig, check_address
from su3d_bench.perception.language.key_cleaning import PLACE, Secret

HOSTED = "https://api.openai.com/v1"
STATUS_TO_TRY_AGAIN = frozenset({408, 409, 425, 429})
NO_KEY = "none"  # servers on one's own machine ask for no key, the client library for any text
LONGEST_PAUSE_S = 1e6  # that is told of what a server asks for
MOST_TOKENS = 100_000_000  # of one request; no model reads or writes so many
OPTIONAL_PARAMETERS = ("seed", "temperature", "max_tokens")


class TryAgain(Exception):
    """An attempt failed; ``wait_s`` is the pause that the server asked for, ``is_answered`` whether one answered."""

    def __init__(self, reason: str, wait_s: float | None = None, *, is_answered: bool = True) -> None:
        super().__init__(reason)
        self.wait_s = wait_s
        self.is_answered = is_answered


class GiveUp(Exception):
    """The request can never be answered."""


class _TooLarge(Exception):
    pass


class _TooLate(Exception):
    pass


class _Message(BaseModel):
    content: str | None = None
    refusal: str | None = None


class _Choice(BaseModel):
    message: _Message
    finish_reason: str | None = None


class _Usage(BaseModel):
    prompt_tokens: int = Field(default=0, ge=0, le=MOST_TOKENS)
    completion_tokens: int = Field(default=0, ge=0, le=MOST_TOKENS)


class _Completion(BaseModel):
    """What is read of a chat completion."""

    model: str = ""
    choices: list[_Choice] = Field(min_length=1)
    usage: _Usage | None = None


class Transport:
    """The connection to one server, made when the first request is sent; may be used from several threads."""

    def __init__(self, config: LanguageConfig) -> None:
        self._config = config
        self._address = _address_of(config)
        self._key = _key_of(config)
        self._secret = Secret(self._key)
        self._lock = threading.Lock()
        self._client: Any = None
        self._dropped: tuple[str, ...] = ()

    @property
    def server(self) -> str:
        """Host and port that are asked."""
        return printable(urlsplit(self._address).netloc, 200)

    def send(self, request: ChatRequest) -> Reply:
        """One attempt; parameters that the server refuses by name are left out, and stay so."""
        client = self._connected()
        while True:
            dropped = self._dropped
            body = _without(request.body(), dropped)
            try:
                text = self._within(partial(self._post, client, body))
            except _Unsupported as refused:
                if refused.parameter in dropped:
                    raise GiveUp(f"the server refuses '{refused.parameter}'") from None
                with self._lock:
                    self._dropped = (*self._dropped, refused.parameter)
                continue
            return self._reply(request, text, dropped)

    def _connected(self) -> Any:
        with self._lock:
            if self._client is None:
                self._client = self._connect()
            return self._client

    def _connect(self) -> Any:
        try:
            import openai
        except ImportError:
            raise ModelMissing("language models need the models extra: pip install 'su3d-bench[models]'") from None
        if not self._key and self._address == HOSTED:
            raise ModelMissing(
                f"${self._config.key_variable} is not set: put the key of {self.server} there, or name a server of "
                "your own with --base-url"
            )
        config = self._config
        timeout = openai.Timeout(config.total_timeout_s, connect=config.connect_timeout_s)
        bound = _bounded(config.max_answer_bytes, config.total_timeout_s)
        return openai.OpenAI(
            api_key=self._key or NO_KEY,
            base_url=self._address,
            max_retries=0,
            timeout=timeout,
            default_headers={"Accept-Encoding": "identity"},
            http_client=openai.DefaultHttpxClient(
                event_hooks={"response": [bound]}, timeout=timeout, follow_redirects=False
            ),
        )

    def _within(self, attempt: Callable[[], str]) -> str:
        """What ``attempt`` gives, in a thread that is left behind where the server drips its answer."""
        done: list[tuple[str, BaseException | None]] = []

        def work() -> None:
            try:
                done.append((attempt(), None))
            except BaseException as error:  # noqa: BLE001 - raised again in the thread that waits
                done.append(("", error))

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        limit_s = self._config.total_timeout_s
        thread.join(limit_s)
        if not done:
            raise TryAgain(f"no whole answer within {limit_s:g} s")
        text, error = done[0]
        if error is not None:
            raise error
        return text

    def _post(self, client: Any, body: dict[str, Any]) -> str:
        import openai

        try:
            response = client.chat.completions.with_raw_response.create(**body)
        except openai.APIStatusError as error:
            raise self._judged(error) from None
        except openai.APITimeoutError:
            raise TryAgain(f"no answer within {self._config.total_timeout_s:g} s") from None
        except (openai.APIConnectionError, _TooLarge, _TooLate) as error:
            raise self._unconnected(error) from None
        except (openai.OpenAIError, ValueError) as error:
            raise GiveUp(self._shown(str(error))) from None
        kind = response.headers.get("content-type", "")
        if "json" not in kind.lower():
            raise TryAgain(f"the server answered with '{self._shown(kind, 60)}' instead of JSON")
        return response.text if isinstance(response.text, str) else response.text()

    def _unconnected(self, error: BaseException) -> Exception:
        chain: list[BaseException] = []
        while error is not None and len(chain) < 10:
            chain.append(error)
            error = error.__cause__ or error.__context__  # type: ignore[assignment]
        if any(isinstance(cause, _TooLarge) for cause in chain):
            return GiveUp(f"the answer is larger than {self._config.max_answer_bytes:,} bytes")
        if any(isinstance(cause, _TooLate) for cause in chain):
            return TryAgain(f"no whole answer within {self._config.total_timeout_s:g} s")
        is_refused = any(type(cause).__name__ in ("ConnectError", "UnsupportedProtocol") for cause in chain)
        reason = self._shown(str(chain[1] if len(chain) > 1 else chain[0]), 120) or type(chain[-1]).__name__
        return TryAgain(f"the connection failed: {reason}", is_answered=not is_refused)

    def _judged(self, error: Any) -> Exception:
        """What an answer with an error status means."""
        status = int(error.status_code)
        message = self._shown(_message_of(error), 200)
        code = str(getattr(error, "code", "") or "")
        if status in (401, 403):
            return ModelMissing(
                f"{self.server}: refuses the key in ${self._config.key_variable} (status {status}); set the right one"
            )
        if status == 404:
            return ModelMissing(
                f"{self.server}: knows no such model or address (status 404: {message}); name the model with --model "
                "and the server with --base-url, which usually ends with /v1"
            )
        if status == 429 and code == "insufficient_quota":
            return ModelMissing(f"{self.server}: the account has no quota left ({message}); top it up, then ask again")
        if status in (400, 422):
            named = next((name for name in OPTIONAL_PARAMETERS if re.search(rf"\b{name}\b", message)), None)
            if named is not None:
                return _Unsupported(named)
        if status in STATUS_TO_TRY_AGAIN or status >= 500:
            return TryAgain(f"status {status}: {message}", _pause_of(error.response.headers))
        return GiveUp(f"status {status}: {message}")

    def _reply(self, request: ChatRequest, text: str, dropped: tuple[str, ...]) -> Reply:
        try:
            completion = _Completion.model_validate(json.loads(text))
        except (ValueError, RecursionError, ValidationError):
            raise TryAgain(f"the server's answer is no chat completion: '{self._shown(text, 60)}'") from None
        choice = completion.choices[0]
        answer = self._secret.cleaned(choice.message.content or choice.message.refusal or "")
        usage = completion.usage or _Usage(prompt_tokens=request.n_input_tokens, completion_tokens=n_tokens(answer))
        finish, model = self._shown(choice.finish_reason or "", 40), self._shown(completion.model, 200)
        if self._secret.is_split([answer, finish, model]):
            finish = model = PLACE
        return Reply(answer, finish, model, usage.prompt_tokens, usage.completion_tokens, dropped)

    def _shown(self, text: str, limit: int = 200) -> str:
        """What a server says, fit for a message or a record: without the key or what looks like one."""
        return printable(self._secret.shown(text), limit)


class _Unsupported(Exception):
    """The server will not take one of the optional parameters."""

    def __init__(self, parameter: str) -> None:
        super().__init__(parameter)
        self.parameter = parameter


def _address_of(config: LanguageConfig) -> str:
    address = config.base_url
    if not address and (address := os.environ.get("OPENAI_BASE_URL", "")):
        try:
            check_address(address)
        except ValueError as error:
            raise ConfigError(f"$OPENAI_BASE_URL: {error}") from error
    return address.rstrip("/") or HOSTED


def _key_of(config: LanguageConfig) -> str:
    key = os.environ.get(config.key_variable, "").strip()
    if not all("!" <= character <= "~" for character in key):
        raise ConfigError(f"${config.key_variable}: holds characters that no key has; set it anew")
    return key


def _without(body: dict[str, Any], dropped: tuple[str, ...]) -> dict[str, Any]:
    """``body`` without what the server refused; newer models take the cap of the answer under another name."""
    kept = {name: value for name, value in body.items() if name not in dropped}
    if "max_tokens" in dropped:
        kept["max_completion_tokens"] = body["max_tokens"]
    return kept


def _message_of(error: Any) -> str:
    body = error.body
    message = body.get("message") if isinstance(body, dict) else None
    return message if isinstance(message, str) else str(error)


def _pause_of(headers: Any) -> float | None:
    """Seconds that ``Retry-After`` asks for, given as a number or as a date."""
    value = str(headers.get("retry-after", "")).strip()[:100]
    if re.fullmatch(r"\d+(\.\d+)?", value):
        return min(float(value), LONGEST_PAUSE_S)
    try:
        at = email.utils.parsedate_to_datetime(value)
    except (ValueError, TypeError, IndexError):
        return None
    return min(max(0.0, at.timestamp() - time.time()), LONGEST_PAUSE_S)


def _bounded(most_bytes: int, total_s: float) -> Callable[[Any], None]:
    """A hook that replaces the body of a response by one which ends with an error beyond the cap or the time."""

    def hook(response: Any) -> None:
        if response.headers.get("content-encoding", "identity") not in ("", "identity"):
            raise _TooLarge("a packed body may hold anything")
        base = importlib.import_module(type(response).__module__.split(".")[0]).SyncByteStream
        body, end = response.stream, time.monotonic() + total_s

        class BoundedStream(base):  # type: ignore[misc, valid-type]
            def __iter__(self) -> Iterator[bytes]:
                n = 0
                for chunk in body:
                    n += len(chunk)
                    if n > most_bytes:
                        raise _TooLarge
                    if time.monotonic() > end:
                        raise _TooLate
                    yield chunk

            def close(self) -> None:
                body.close()

        response.stream = BoundedStream()

    return hook
