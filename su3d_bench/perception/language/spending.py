"""What asking costs: an estimate beforehand, a count as one goes, and a cap."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from su3d_bench.core.errors import ConfigError, RunIncomplete
from su3d_bench.perception.language.chat import ChatRequest, Reply
from su3d_bench.perception.language.config import LanguageConfig


@dataclass(frozen=True)
class Estimate:
    """What ``n_requests`` different requests would cost at most; ``usd`` is None where a model has no price."""

    n_requests: int
    n_stored: int
    input_tokens: int
    output_tokens: int
    usd: float | None
    models: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"models": list(self.models)}

    def line(self) -> str:
        """The estimate for people."""
        to_send = self.n_requests - self.n_stored
        cost = "no price in the table" if self.usd is None else f"at most {self.usd:.4f} USD"
        models = ", ".join(self.models) or "no model"
        return (
            f"{self.n_requests} requests, {self.n_stored} of them answered before; {to_send} to send to {models}: "
            f"about {self.input_tokens:,} tokens in, at most {self.output_tokens:,} out, {cost}"
        )


def cost_usd(config: LanguageConfig, model: str, input_tokens: int, output_tokens: int) -> float | None:
    """US dollars by the price table; None where it has no such model."""
    price = config.prices.get(model)
    if price is None:
        return None
    return (input_tokens * price.input_usd + output_tokens * price.output_usd) / 1e6


def estimate_of(config: LanguageConfig, to_send: Sequence[ChatRequest], n_stored: int) -> Estimate:
    """The most that sending ``to_send`` can cost, beside ``n_stored`` requests that have replies."""
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
    """What was spent so far, with the cap of the configuration; may be used from several threads."""

    def __init__(self, config: LanguageConfig) -> None:
        self._config = config
        self._lock = threading.Lock()
        self._reserved_tokens = 0
        self._reserved_usd = 0.0
        self.tokens = 0
        self.usd = 0.0
        self.n_attempts = 0

    @contextmanager
    def reserved(self, request: ChatRequest) -> Iterator[list[Reply]]:
        """Holds what ``request`` may cost; the block puts the reply into the list that it gets.

        A ``RunIncomplete`` where the cap would be passed. An attempt without a reply is counted by its input.
        """
        tokens = request.n_input_tokens + request.max_answer_tokens
        usd = self._cost(request.model, request.n_input_tokens, request.max_answer_tokens)
        with self._lock:
            self._check(tokens, usd)
            self._reserved_tokens += tokens
            self._reserved_usd += usd
            self.n_attempts += 1
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
                f"budget_usd is set and model '{model}' has no price; add [perception.language.prices.\"{model}\"] "
                "with input_usd and output_usd, or cap budget_tokens"
            )
        return cost or 0.0

    def _check(self, tokens: int, usd: float) -> None:
        cap = self._config
        if cap.budget_tokens and self.tokens + self._reserved_tokens + tokens > cap.budget_tokens:
            raise RunIncomplete(
                f"language: budget_tokens = {cap.budget_tokens:,} is reached ({self.tokens:,} spent); what was "
                "answered is kept: raise the cap and give the same command again"
            )
        if cap.budget_usd and self.usd + self._reserved_usd + usd > cap.budget_usd:
            raise RunIncomplete(
                f"language: budget_usd = {cap.budget_usd:g} is reached ({self.usd:.4f} USD spent); what was answered "
                "is kept: raise the cap and give the same command again"
            )
