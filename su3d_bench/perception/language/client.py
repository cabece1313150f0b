"""Asking language models: each question once, with pauses and retries, within the budget, and kept with the run."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from time import monotonic, sleep
from typing import Protocol

from su3d_bench.core.errors import ModelMissing, StoreError
from su3d_bench.perception.language.chat import ChatRequest, Reply
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.perception.language.reply_store import ReplyStore
from su3d_bench.perception.language.spending import Estimate, Spending, estimate_of
from su3d_bench.perception.language.transport import GiveUp, Transport, TryAgain


class LanguageModel(Protocol):
    """What captions, names and reasoning need of a language model."""

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        """A reply to each of ``requests``, in their order."""
        ...


class ChatClient:
    """An OpenAI-compatible server behind a store of replies; may be used from several threads.

    ``offline``: a question without a stored reply is a ``StoreError``. A request that failed for good is stored as
    that, so that a rerun is identical; ``ask_failed_again`` gives it another chance.
    """

    def __init__(
        self, config: LanguageConfig, store: ReplyStore, *, offline: bool = False, ask_failed_again: bool = False
    ) -> None:
        self._config = config
        self._store = store
        self._offline = offline
        self._ask_failed_again = ask_failed_again
        self._transport = Transport(config)
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
        """The stored reply, or that of the server; a request that cannot be answered gives a reply with a failure.

        Raises ``ModelMissing`` where the server, the key or the model is not there, ``RunIncomplete`` at the cap.
        """
        with self._lock:
            own = self._locks.setdefault(request.key, threading.Lock())
        with own:
            known = self._known(request)
            if known is not None:
                return known
            if self._offline:
                raise StoreError(
                    f"{self._store.folder}: holds no reply to this {request.purpose} request of model "
                    f"'{request.model}' ({request.key[:12]}); give the command without --offline to ask for it"
                )
            reply = self._send(request)
            self._sent.add(request.key)
            return self._store.save(request, reply, self._transport.server, replace=self._ask_failed_again)

    def _known(self, request: ChatRequest) -> Reply | None:
        reply = self._store.load(request.key)
        is_wanted_again = self._ask_failed_again and request.key not in self._sent and not self._offline
        return None if reply is not None and reply.failure and is_wanted_again else reply

    def estimate(self, requests: Sequence[ChatRequest]) -> Estimate:
        """The most that ``ask_all`` of ``requests`` can cost; nothing is sent."""
        different = {request.key: request for request in requests}
        to_send = [request for request in different.values() if self._known(request) is None]
        return estimate_of(self._config, to_send, len(different) - len(to_send))

    def _send(self, request: ChatRequest) -> Reply:
        wait_s = self._config.backoff_s
        for attempt in range(self._config.max_retries + 1):
            self._pace.wait()
            try:
                with self.spending.reserved(request) as replies:
                    replies.append(self._transport.send(request))
            except GiveUp as refused:
                self._count(failed=False)  # the server is there and has spoken
                return Reply("", failure=str(refused))
            except TryAgain as failed:
                if failed.wait_s is not None and failed.wait_s > self._config.max_wait_s:
                    return self._failed(f"{failed}; it asks to wait {failed.wait_s:.0f} s", failed)
                if attempt == self._config.max_retries:
                    return self._failed(f"{failed}; tried {attempt + 1} times", failed)
                sleep(wait_s if failed.wait_s is None else failed.wait_s)
                wait_s = min(2 * wait_s, self._config.max_wait_s)
            else:
                self._count(failed=False)
                return replies[0]
        raise AssertionError("the last attempt returns")

    def _failed(self, reason: str, last: TryAgain) -> Reply:
        server = self._transport.server
        if not last.is_answered:
            raise ModelMissing(f"{server}: cannot be reached ({reason}); start the server or name another --base-url")
        if self._count(failed=True) >= self._config.max_failures_in_a_row:
            raise ModelMissing(
                f"{server}: {self._config.max_failures_in_a_row} requests failed one after the other ({reason}); what "
                "was answered is kept: give the same command again when the server is well"
            )
        return Reply("", failure=reason)

    def _count(self, *, failed: bool) -> int:
        with self._lock:
            self._n_failures_in_a_row = self._n_failures_in_a_row + 1 if failed else 0
            return self._n_failures_in_a_row


class _Pace:
    """Lets requests pass no faster than the limit, all threads together."""

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
