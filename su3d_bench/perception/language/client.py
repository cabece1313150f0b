"""Client of language models: each request is sent once, within the budget, and stored with the run."""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from time import monotonic, sleep
from typing import Any, Protocol
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, ValidationError

from su3d_bench.core.errors import ConfigError, ModelMissing, RunIncomplete, StoreError, counted, printable
from su3d_bench.core.system.devices import require, require_installed
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply, ReplyStore, check_address, n_tokens

HOSTED = "https://api.openai.com/v1"
NO_KEY = "none"  # local servers need no key, but the client library requires some text
MAX_TOKENS = 100_000_000  # per request; no model reads or writes that many
OPTIONAL_PARAMETERS = ("seed", "temperature", "max_tokens", "response_format", "reasoning_effort")
PLACE = "(key)"
MIN_KEY_LENGTH = 8  # shorter keys are not secret: "none", "EMPTY", "test"
KEY_LIKE = re.compile(r"\b(?:sk|pk|key|gsk|hf)[-_][A-Za-z0-9_\-*]{6,}", re.IGNORECASE)


class LanguageModel(Protocol):
    """The interface of a language model for captions, names and reasoning."""

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        """The replies to ``requests``, in order."""
        ...


class ChatClient:
    """An OpenAI-compatible server with stored replies; thread-safe.

    ``offline``: a question without a stored reply is a ``StoreError``. A request that failed permanently is stored as
    failed, so that a rerun is identical; ``retry_failed`` sends it again.
    """

    def __init__(
        self, config: LanguageConfig, store: ReplyStore, *, offline: bool = False, retry_failed: bool = False
    ) -> None:
        self._config = config
        self._store = store
        self._offline = offline
        self._retry_failed = retry_failed
        self._server = Server(config)
        self._pace = _Pace(config.requests_per_minute)
        self._lock = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        self._sent: set[str] = set()
        self._n_failures_in_a_row = 0
        self.spending = Spending(config)

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        """Replies in the order of ``requests``; equal requests are sent once."""
        n_workers = min(self._config.max_concurrent, len(requests))
        if n_workers <= 1 or self._offline:
            return [self.ask(request) for request in requests]
        with ThreadPoolExecutor(n_workers) as pool:
            futures = [pool.submit(self.ask, request) for request in requests]
            try:
                return [future.result() for future in futures]
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    def ask(self, request: ChatRequest) -> Reply:
        """The stored reply, or that of the server; a request that cannot be answered returns a reply with a failure.

        Raises ``ModelMissing`` if the server, the key or the model is not available, ``RunIncomplete`` at the cap.
        """
        with self._lock:
            own = self._locks.setdefault(request.key, threading.Lock())
        with own:
            known = self._known(request)
            if known is not None:
                return known
            if self._offline:
                raise StoreError(
                    f"{self._store.folder}: no stored reply to this {request.purpose} request of model "
                    f"'{request.model}' ({request.key[:12]}); run without --offline to send it"
                )
            reply = self._send(request)
            self._sent.add(request.key)
            return self._store.save(request, reply, self._server.name, replace=self._retry_failed)

    def _known(self, request: ChatRequest) -> Reply | None:
        reply = self._store.load(request.key)
        is_wanted_again = self._retry_failed and request.key not in self._sent and not self._offline
        return None if reply is not None and reply.failure and is_wanted_again else reply

    def estimate(self, requests: Sequence[ChatRequest]) -> Estimate:
        """Upper bound of the cost of ``ask_all`` for ``requests``; sends nothing."""
        different = {request.key: request for request in requests}
        to_send = [request for request in different.values() if self._known(request) is None]
        return estimate_of(self._config, to_send, len(different) - len(to_send))

    def _send(self, request: ChatRequest) -> Reply:
        self._pace.wait()
        with self.spending.reserved(request) as replies:
            try:
                reply = self._server.send(request)
                replies.append(reply)
            except _Failed as failed:
                reply = Reply("", failure=str(failed))
                most = self._config.max_failures_in_a_row
                if self._count(failed=failed.is_down) >= most:
                    raise ModelMissing(
                        f"{self._server.name}: {most} consecutive requests failed "
                        f"({failed}); replies so far are stored: rerun the command when the server works"
                    ) from None
            else:
                self._count(failed=False)
        return reply

    def _count(self, *, failed: bool) -> int:
        with self._lock:
            self._n_failures_in_a_row = self._n_failures_in_a_row + 1 if failed else 0
            return self._n_failures_in_a_row


class _Pace:
    """Limits the request rate over all threads."""

    def __init__(self, per_minute: float) -> None:
        self._gap_s = 60.0 / per_minute if per_minute else 0.0
        self._lock = threading.Lock()
        self._next = 0.0

    def wait(self) -> None:
        if not self._gap_s:
            return
        with self._lock:
            now = monotonic()
            start = max(now, self._next)
            self._next = start + self._gap_s
        sleep(start - now)


# ---- the server


class _Failed(Exception):
    """A request was not answered; ``is_down``: possibly because of the server and not because of the request."""

    def __init__(self, reason: str, *, is_down: bool) -> None:
        super().__init__(reason)
        self.is_down = is_down


class _TooLarge(Exception):
    pass


class _Message(BaseModel):
    content: str | None = None
    refusal: str | None = None


class _Choice(BaseModel):
    message: _Message
    finish_reason: str | None = None


class _Usage(BaseModel):
    prompt_tokens: int = Field(default=0, ge=0, le=MAX_TOKENS)
    completion_tokens: int = Field(default=0, ge=0, le=MAX_TOKENS)


class _Completion(BaseModel):
    """The fields that are read from a chat completion."""

    model: str = ""
    choices: list[_Choice] = Field(min_length=1)
    usage: _Usage | None = None


class Server:
    """One OpenAI-compatible server; the client library, which retries, is loaded for the first request."""

    def __init__(self, config: LanguageConfig) -> None:
        self._config = config
        self._address = _address_of(config)
        self._key = _key_of(config)
        self._lock = threading.Lock()
        self._client: Any = None
        self._dropped: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The host and port."""
        return printable(urlsplit(self._address).netloc, 200)

    def send(self, request: ChatRequest) -> Reply:
        """The answer; parameters that the server rejects by name are omitted from then on.

        Raises ``_Failed``, and ``ModelMissing`` if no request can be answered: no server, no key, no such model.
        """
        with self._lock:
            self._client = self._client or self._connected()
        while True:
            dropped = self._dropped
            refused = self._post(_without(request.body(), dropped))
            if isinstance(refused, str):
                if refused in dropped:
                    raise _Failed(f"the server rejects '{refused}'", is_down=False)
                with self._lock:
                    self._dropped = (*self._dropped, refused)
                continue
            return self._reply(request, refused, dropped)

    def _connected(self) -> Any:
        openai = require("openai", "a language model")
        check_key(self._config)
        return openai.OpenAI(
            api_key=self._key or NO_KEY,
            base_url=self._address,
            max_retries=self._config.max_retries,
            timeout=self._config.timeout_s,
            default_headers={"Accept-Encoding": "identity"},
            http_client=openai.DefaultHttpxClient(
                event_hooks={"response": [_bounded(self._config.max_answer_bytes)]}, follow_redirects=False
            ),
        )

    def _post(self, body: dict[str, Any]) -> bytes | str:
        """The content of the answer, or the name of an optional parameter that the server rejects."""
        import openai

        n_tries = self._config.max_retries + 1
        try:
            content: bytes = self._client.chat.completions.with_raw_response.create(**body).content
        except openai.APIStatusError as error:
            return self._refused_parameter(error)
        except openai.APITimeoutError:
            raise _Failed(f"no answer within {self._config.timeout_s:g} s; attempts: {n_tries}", is_down=True) from None
        except _TooLarge as error:
            raise _Failed(f"the answer is {error}", is_down=False) from None
        except openai.OpenAIError as error:
            reason = self._shown(str(error.__cause__ or error), 120)
            if type(error.__cause__).__name__ in ("ConnectError", "UnsupportedProtocol"):
                raise ModelMissing(
                    f"{self.name}: cannot connect ({reason}); start the server or set another --base-url"
                ) from None
            raise _Failed(f"the connection failed: {reason}; attempts: {n_tries}", is_down=True) from None
        return content

    def _refused_parameter(self, error: Any) -> str:
        status, payload = int(error.status_code), error.body
        message = payload.get("message") if isinstance(payload, dict) else None
        message = self._shown(message if isinstance(message, str) else str(error))
        if status in (401, 403):
            raise ModelMissing(
                f"{self.name}: rejects the key in ${self._config.key_variable} (status {status}); set a valid key"
            ) from None
        if status == 404:
            raise ModelMissing(
                f"{self.name}: unknown model or address (status 404: {message}); set the model with --model "
                "and the server with --base-url, which usually ends with /v1"
            ) from None
        if status == 429 and getattr(error, "code", "") == "insufficient_quota":
            raise ModelMissing(
                f"{self.name}: the account has no quota left ({message}); add credit and rerun"
            ) from None
        if status in (400, 422):
            named = next((name for name in OPTIONAL_PARAMETERS if re.search(rf"\b{name}\b", message)), None)
            if named is not None:
                return named
        is_down = status == 429 or status >= 500
        tried = f"; attempts: {self._config.max_retries + 1}" if is_down else ""
        raise _Failed(f"status {status}: {message}{tried}", is_down=is_down) from None

    def _reply(self, request: ChatRequest, content: bytes, dropped: tuple[str, ...]) -> Reply:
        try:
            completion = _Completion.model_validate_json(content)
        except ValidationError:
            excerpt = self._shown(content[:200].decode("utf-8", "replace"), 60)
            raise _Failed(f"the response is not a chat completion: '{excerpt}'", is_down=True) from None
        choice = completion.choices[0]
        answer = (choice.message.content or choice.message.refusal or "").encode("utf-8", "replace").decode()
        answer = self._without_key(answer)
        usage = completion.usage or _Usage(prompt_tokens=request.n_input_tokens, completion_tokens=n_tokens(answer))
        finish, model = self._shown(choice.finish_reason or "", 40), self._shown(completion.model)
        return Reply(answer, finish, model, usage.prompt_tokens, usage.completion_tokens, dropped)

    def _without_key(self, text: str) -> str:
        return text.replace(self._key, PLACE) if len(self._key) >= MIN_KEY_LENGTH else text

    def _shown(self, text: str, limit: int = 200) -> str:
        """Text from a server, safe for a message or a record: without the key or anything that looks like one."""
        return printable(KEY_LIKE.sub(PLACE, self._without_key(text)), limit)


def _address_of(config: LanguageConfig) -> str:
    address = config.base_url
    if not address and (address := os.environ.get("OPENAI_BASE_URL", "")):
        try:
            check_address(address)
        except ValueError as error:
            raise ConfigError(f"$OPENAI_BASE_URL: {error}") from error
    return address.rstrip("/") or HOSTED


def check_key(config: LanguageConfig) -> None:
    """Raises ``ModelMissing`` if the hosted service is used without a key, or if its client library is missing."""
    if _address_of(config) == HOSTED and not _key_of(config):
        raise ModelMissing(
            f"${config.key_variable} is not set; set it to the key of {urlsplit(HOSTED).netloc}, or use your own "
            "server with $OPENAI_BASE_URL or --set perception.language.base_url=URL"
        )
    require_installed("openai", "a language model")


def _key_of(config: LanguageConfig) -> str:
    key = os.environ.get(config.key_variable, "").strip()
    if not all("!" <= character <= "~" for character in key):
        raise ConfigError(f"${config.key_variable}: contains invalid characters; set it again")
    return key


def _without(body: dict[str, Any], dropped: tuple[str, ...]) -> dict[str, Any]:
    """``body`` without the rejected parameters; newer models have another name for the answer limit."""
    kept = {name: value for name, value in body.items() if name not in dropped}
    if "max_tokens" in dropped:
        kept["max_completion_tokens"] = body["max_tokens"]
    return kept


def _bounded(max_bytes: int) -> Callable[[Any], None]:
    """A hook that raises an error for a response larger than ``max_bytes`` or a compressed one."""

    def hook(response: Any) -> None:
        if response.headers.get("content-encoding", "identity") not in ("", "identity"):
            raise _TooLarge("compressed")
        body = response.stream
        # The client library uses either httpx or httpx2.
        base = sys.modules[type(response).__module__.partition(".")[0]].SyncByteStream

        class Bounded(base):  # type: ignore[misc, valid-type]
            def __iter__(self) -> Iterator[bytes]:
                n = 0
                for chunk in body:
                    n += len(chunk)
                    if n > max_bytes:
                        raise _TooLarge(f"larger than {max_bytes:,} bytes")
                    yield chunk

            def close(self) -> None:
                body.close()

        response.stream = Bounded()

    return hook


# ---- costs


@dataclass(frozen=True)
class Estimate:
    """Upper bound of the cost of ``n_requests`` distinct requests; ``usd`` is None if a model has no price."""

    n_requests: int
    n_stored: int
    input_tokens: int
    output_tokens: int
    usd: float | None
    models: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"models": list(self.models)}

    def line(self) -> str:
        """The estimate as text."""
        to_send = self.n_requests - self.n_stored
        cost = "no price in the table" if self.usd is None else f"at most {self.usd:.4f} USD"
        models = ", ".join(self.models) or "no model"
        return (
            f"{counted(self.n_requests, 'request')}, {self.n_stored} of them already answered; "
            f"{to_send} to send to {models}: about {self.input_tokens:,} tokens in, "
            f"at most {self.output_tokens:,} out, {cost}"
        )


def cost_usd(config: LanguageConfig, model: str, input_tokens: int, output_tokens: int) -> float | None:
    """US dollars by the price table; None for an unknown model."""
    price = config.prices.get(model)
    if price is None:
        return None
    return (input_tokens * price.input_usd + output_tokens * price.output_usd) / 1e6


def estimate_of(config: LanguageConfig, to_send: Sequence[ChatRequest], n_stored: int) -> Estimate:
    """Upper bound of the cost of ``to_send``, in addition to ``n_stored`` requests that have replies."""
    costs = [cost_usd(config, request.model, request.n_input_tokens, request.max_answer_tokens) for request in to_send]
    known = [cost for cost in costs if cost is not None]
    return Estimate(
        n_requests=len(to_send) + n_stored,
        n_stored=n_stored,
        input_tokens=sum(request.n_input_tokens for request in to_send),
        output_tokens=sum(request.max_answer_tokens for request in to_send),
        usd=sum(known) if len(known) == len(costs) else None,
        models=tuple(dict.fromkeys(request.model for request in to_send)),
    )


class Spending:
    """The amount spent so far, limited by the configured cap; thread-safe."""

    def __init__(self, config: LanguageConfig) -> None:
        self._config = config
        self._lock = threading.Lock()
        self._reserved_tokens = 0
        self._reserved_usd = 0.0
        self.tokens = 0
        self.usd = 0.0

    @contextmanager
    def reserved(self, request: ChatRequest) -> Iterator[list[Reply]]:
        """Reserve the maximum cost of ``request``; the block appends the reply to the list that it gets.

        A ``RunIncomplete`` if the cap would be exceeded. A request without a reply is counted by its input.
        """
        tokens = request.n_input_tokens + request.max_answer_tokens
        usd = self._cost(request.model, request.n_input_tokens, request.max_answer_tokens)
        with self._lock:
            self._check(tokens, usd)
            self._reserved_tokens += tokens
            self._reserved_usd += usd
        replies: list[Reply] = []
        try:
            yield replies
        finally:
            spent_in = replies[0].input_tokens if replies else request.n_input_tokens
            spent_out = replies[0].output_tokens if replies else 0
            with self._lock:
                self._reserved_tokens -= tokens
                self._reserved_usd -= usd
                self.tokens += spent_in + spent_out
                self.usd += self._cost(request.model, spent_in, spent_out)

    def _cost(self, model: str, input_tokens: int, output_tokens: int) -> float:
        cost = cost_usd(self._config, model, input_tokens, output_tokens)
        if cost is None and self._config.budget_usd:
            raise ConfigError(
                f"budget_usd is set but model '{model}' has no price; add [perception.language.prices.\"{model}\"] "
                "with input_usd and output_usd, or cap budget_tokens"
            )
        return cost or 0.0

    def _check(self, tokens: int, usd: float) -> None:
        cap = self._config
        if cap.budget_tokens and self.tokens + self._reserved_tokens + tokens > cap.budget_tokens:
            raise RunIncomplete(
                f"language: budget_tokens = {cap.budget_tokens:,} is reached ({self.tokens:,} spent); replies "
                "so far are stored: raise the cap and run the same command again"
            )
        if cap.budget_usd and self.usd + self._reserved_usd + usd > cap.budget_usd:
            raise RunIncomplete(
                f"language: budget_usd = {cap.budget_usd:g} is reached ({self.usd:.4f} USD spent); replies so far "
                "are stored: raise the cap and run the same command again"
            )
