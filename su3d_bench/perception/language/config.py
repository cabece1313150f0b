"""How language models are reached and what they may cost."""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, field_validator

Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]


class Price(BaseModel):
    """US dollars for a million tokens."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    input_usd: float = Field(ge=0, allow_inf_nan=False)
    output_usd: float = Field(ge=0, allow_inf_nan=False)


# OpenAI's price list of November 2023: 0.01 US dollars for 1,000 tokens in, 0.03 for 1,000 out, for both models.
_GPT4_TURBO = Price(input_usd=10.0, output_usd=30.0)


class LanguageConfig(BaseModel):
    """Which models are asked, how long one waits for them, and what a command may spend.

    ``base_url`` empty: ``$OPENAI_BASE_URL``, else the service of OpenAI. The key is read from the environment variable
    ``key_variable`` and stands nowhere else. ``budget_tokens``, ``budget_usd`` and ``requests_per_minute`` 0: no limit.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    base_url: str = ""
    key_variable: str = Field(default="OPENAI_API_KEY", pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,80}$")
    # The paper's models (section IV-A); OpenAI has withdrawn both since.
    vision_model: str = Field(default="gpt-4-vision-preview", min_length=1, max_length=200)
    text_model: str = Field(default="gpt-4-1106-preview", min_length=1, max_length=200)
    temperature: float = Field(default=0.0, ge=0, le=2)  # 0: the paper's
    # Sent where a server takes it; the paper names none.
    seed: int | None = Field(default=0, ge=0, lt=2**31)
    max_answer_tokens: int = Field(default=1000, ge=1, le=100_000)
    # Tokens that the text model reads and writes in all: 128,000 of gpt-4-1106-preview.
    context_tokens: int = Field(default=128_000, ge=1000)
    image_detail: Literal["auto", "low", "high"] = "auto"
    # A larger crop is scaled down: OpenAI's models see the shorter side of an image at 768 pixels at most.
    max_image_px: int = Field(default=768, ge=32, le=4096)
    timeout_s: Seconds = 120.0  # without a byte of the answer
    max_retries: int = Field(default=4, ge=0, le=20)  # of the client library, with growing pauses
    max_answer_bytes: int = Field(default=1_000_000, ge=1000, le=100_000_000)
    requests_per_minute: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    max_concurrent: int = Field(default=4, ge=1, le=64)
    # So many requests given up one after the other end the command: the server is down, not the request bad.
    max_failures_in_a_row: int = Field(default=5, ge=1)
    budget_tokens: int = Field(default=0, ge=0)
    budget_usd: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    prices: dict[str, Price] = {"gpt-4-vision-preview": _GPT4_TURBO, "gpt-4-1106-preview": _GPT4_TURBO}

    @field_validator("base_url")
    @classmethod
    def _is_a_plain_address(cls, value: str) -> str:
        check_address(value)
        return value


def check_address(address: str) -> None:
    """A ``ValueError`` where ``address`` is no http or https address, or holds a user name or a password."""
    if not address:
        return
    try:
        parts = urlsplit(address)
        is_address = parts.scheme in ("http", "https") and bool(parts.hostname)
        has_secret = parts.username is not None or parts.password is not None or bool(parts.query)
    except ValueError:
        is_address = has_secret = False
    if not is_address:
        raise ValueError("expected an http or https address, such as http://localhost:8000/v1")
    if has_secret:
        raise ValueError("holds a name, a password or a query; keys belong in the environment")
