"""Requests to language models and their replies."""

from __future__ import annotations

import base64
import dataclasses
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_validator, model_validator

from su3d_bench.core.digests import digest_bytes, digest_json
from su3d_bench.core.files.atomic import json_text, make_folder, write_bytes, write_error, write_text
from su3d_bench.core.files.locks import hold_folder
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import UInt8Array
from su3d_bench.store.run_folder import check_no_links

Purpose = Literal["caption", "refine", "ask", "judge"]
PRICES = parse_toml(file_text(Path(__file__).with_name("prices.toml")))
CHARACTERS_PER_TOKEN = 4  # OpenAI's rule of thumb for English
MESSAGE_TOKENS = 8  # approximate overhead per message


@dataclass(frozen=True, eq=False)
class Image:
    """An RGB image (h, w, 3) that is part of a request."""

    rgb: UInt8Array

    @cached_property
    def digest(self) -> str:
        """A digest of the pixels, independent of the image encoder."""
        return digest_bytes(f"{self.rgb.shape}".encode() + np.ascontiguousarray(self.rgb).tobytes())

    @cached_property
    def png(self) -> bytes:
        import cv2

        done, packed = cv2.imencode(".png", np.ascontiguousarray(self.rgb[:, :, ::-1]))
        assert done, "an image in memory can be encoded"
        return packed.tobytes()

    def n_tokens(self, detail: str) -> int:
        """Tokens by OpenAI's rule for GPT-4 with vision: 85, plus 170 per tile of 512 pixels unless detail is low."""
        if detail == "low":
            return 85
        height, width = self.rgb.shape[:2]
        scale = min(1.0, 2048 / max(height, width))
        scale *= min(1.0, 768 / (min(height, width) * scale))
        return 85 + 170 * int(np.ceil(height * scale / 512) * np.ceil(width * scale / 512))


def fitted(rgb: UInt8Array, max_px: int) -> Image:
    """``rgb`` with its longer side at most ``max_px``."""
    longer = max(rgb.shape[:2])
    if longer <= max_px:
        return Image(rgb)
    import cv2

    height, width = (max(1, round(side * max_px / longer)) for side in rgb.shape[:2])
    return Image(np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8))


@dataclass(frozen=True)
class ChatRequest:
    """One question; ``key`` identifies it by content, independent of the server.

    ``form``: the JSON schema requested from servers that support one.
    """

    purpose: Purpose
    model: str
    system: str
    text: str
    images: tuple[Image, ...] = ()
    max_answer_tokens: int = 1000
    temperature: float = 0.0
    seed: int | None = 0
    image_detail: str = "auto"
    reasoning_effort: str = ""
    form: type[BaseModel] | None = None

    def record(self) -> dict[str, Any]:
        """The request as stored, with images as digests."""
        schema = {} if self.form is None else {"schema": self.form.model_json_schema()}
        return schema | {
            "model": self.model,
            "system": self.system,
            "text": self.text,
            "images": [image.digest for image in self.images],
            "image_detail": self.image_detail if self.images else None,
            "max_answer_tokens": self.max_answer_tokens,
            "temperature": self.temperature,
            "seed": self.seed,
            **({"reasoning_effort": self.reasoning_effort} if self.reasoning_effort else {}),
        }

    @cached_property
    def key(self) -> str:
        return digest_json(self.record())

    def body(self) -> dict[str, Any]:
        """The arguments of a chat completion."""
        content: list[dict[str, Any]] = [{"type": "text", "text": self.text}]
        urls = ("data:image/png;base64," + base64.b64encode(image.png).decode("ascii") for image in self.images)
        content += [{"type": "image_url", "image_url": {"url": url, "detail": self.image_detail}} for url in urls]
        messages: list[dict[str, Any]] = [{"role": "system", "content": self.system}] if self.system else []
        messages.append({"role": "user", "content": content if self.images else self.text})
        body: dict[str, Any] = {
            "model": self.model,
            "messages": messages,
            "temperature": self.temperature,
            "max_tokens": self.max_answer_tokens,
            **({"reasoning_effort": self.reasoning_effort} if self.reasoning_effort else {}),
        }
        if self.form is not None:
            schema = {"name": self.form.__name__, "strict": True, "schema": self.form.model_json_schema()}
            body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return body if self.seed is None else body | {"seed": self.seed}

    @property
    def n_input_tokens(self) -> int:
        """A rough count of the input tokens."""
        words = n_tokens(self.system) + n_tokens(self.text) + 2 * MESSAGE_TOKENS
        return words + sum(image.n_tokens(self.image_detail) for image in self.images)


def n_tokens(text: str) -> int:
    """A rough count of the tokens of ``text``: one for every four bytes of UTF-8."""
    return -(-len(text.encode()) // CHARACTERS_PER_TOKEN)


@dataclass(frozen=True)
class Reply:
    """The result of a request: ``text``, or the reason of a ``failure``.

    ``dropped`` names the parameters that the server did not accept; ``was_stored``: no request was sent.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    text: str
    finish_reason: str = ""
    model: str = ""
    input_tokens: Annotated[int, Field(ge=0)] = 0
    output_tokens: Annotated[int, Field(ge=0)] = 0
    dropped: tuple[str, ...] = ()
    failure: str = ""
    was_stored: bool = field(default=False, compare=False)


Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]


class Price(BaseModel):
    """US dollars per million tokens; ``date`` and ``source`` of the price."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    input_usd: float = Field(ge=0, allow_inf_nan=False)
    output_usd: float = Field(ge=0, allow_inf_nan=False)
    date: str = ""
    source: str = ""


# "current": OpenAI's replacement for its GPT-4 models, which reads images; without reasoning it takes a temperature.
# "paper": the models of section III-A; OpenAI has withdrawn both since.
PRESETS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "current": {"vision_model": "gpt-6-luna", "text_model": "gpt-6-luna", "reasoning_effort": "none"},
        "paper": {"vision_model": "gpt-4-vision-preview", "text_model": "gpt-4-1106-preview", "reasoning_effort": ""},
    }
)


class LanguageConfig(BaseModel):
    """Which models are used, timeouts, and what a command may spend.

    ``base_url`` empty: ``$OPENAI_BASE_URL``, otherwise the service of OpenAI. The key is only read from the environment
    variable ``key_variable``. ``preset``: the defaults of ``vision_model``, ``text_model`` and ``reasoning_effort``
    (empty: not sent). ``budget_tokens``, ``budget_usd`` and ``requests_per_minute`` 0: no limit.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    base_url: str = ""
    key_variable: str = Field(default="OPENAI_API_KEY", pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,80}$")
    preset: Literal["current", "paper"] = "current"
    vision_model: str = Field(default=PRESETS["current"]["vision_model"], min_length=1, max_length=200)
    text_model: str = Field(default=PRESETS["current"]["text_model"], min_length=1, max_length=200)
    reasoning_effort: str = Field(default=PRESETS["current"]["reasoning_effort"], pattern=r"^[a-z]{0,20}$")
    temperature: float = Field(default=0.0, ge=0, le=2)  # 0: the paper's
    # Sent if a server accepts it; the paper names none.
    seed: int | None = Field(default=0, ge=0, lt=2**31)
    max_answer_tokens: int = Field(default=1000, ge=1, le=100_000)
    # Total tokens that the text model reads and writes: 128,000 for gpt-4-1106-preview.
    context_tokens: int = Field(default=128_000, ge=1000)
    image_detail: Literal["auto", "low", "high"] = "auto"
    # A larger crop is scaled down: OpenAI's models see the shorter side of an image at no more than 768 pixels.
    max_image_px: int = Field(default=768, ge=32, le=4096)
    timeout_s: Seconds = 120.0  # without a byte of the answer
    max_retries: int = Field(default=4, ge=0, le=20)  # of the client library, with growing pauses
    max_answer_bytes: int = Field(default=1_000_000, ge=1000, le=100_000_000)
    requests_per_minute: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    max_concurrent: int = Field(default=4, ge=1, le=64)
    # This many consecutive failed requests end the command, because the server is most likely down.
    max_failures_in_a_row: int = Field(default=5, ge=1)
    budget_tokens: int = Field(default=0, ge=0)
    budget_usd: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    prices: dict[str, Price] = {name: Price(**one) for name, one in PRICES.items()}

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, values: Any) -> Any:
        known = isinstance(values, dict) and PRESETS.get(str(values.get("preset", "current")))
        return {**known, **values} if known else values

    @field_validator("base_url")
    @classmethod
    def _is_a_plain_address(cls, value: str) -> str:
        check_address(value)
        return value


def check_address(address: str) -> None:
    """A ``ValueError`` if ``address`` is not an http or https URL, or contains a user name, a password or a query."""
    if not address:
        return
    try:
        parts = urlsplit(address)
        is_address = parts.scheme in ("http", "https") and bool(parts.hostname)
        has_secret = parts.username is not None or parts.password is not None or bool(parts.query)
    except ValueError:
        is_address = has_secret = False
    if not is_address:
        raise ValueError("expected an http or https URL, such as http://localhost:8000/v1")
    if has_secret:
        raise ValueError("contains credentials or a query; set keys in the environment")


SCHEMA = 1
IMAGES = "images"
MAX_ENTRY_BYTES = 200_000_000  # twice the largest answer that a configuration can allow


_REPLY = TypeAdapter(Reply)


class ReplyStore:
    """The folder ``language`` of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, key: str) -> Path:
        return self.folder / f"{key}.json"

    def load(self, key: str) -> Reply | None:
        """The reply under ``key``; None if missing or damaged."""
        path = self.path(key)
        try:
            if not path.is_file() or path.stat().st_size > MAX_ENTRY_BYTES:
                return None
            entry: Any = json.loads(file_text(path))
            digests = digest_json(entry["request"]), digest_json(entry["reply"])
            if entry["schema"] != SCHEMA or digests != (key, entry["reply_sha256"]):
                return None
            return dataclasses.replace(_REPLY.validate_python(entry["reply"]), was_stored=True)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def save(self, request: ChatRequest, reply: Reply, server: str, *, replace: bool = False) -> Reply:
        """The stored reply: ``reply``, or the one that another process stored meanwhile unless ``replace``."""
        check_no_links(self.folder.parent, self.folder / IMAGES)
        make_folder(self.folder)
        with self._locked():
            earlier = None if replace else self.load(request.key)
            if earlier is not None:
                return earlier
            self._save_images(request)
            answer = _REPLY.dump_python(reply, mode="json", exclude={"was_stored"})
            entry = {
                "schema": SCHEMA,
                "purpose": request.purpose,
                "server": server,
                "request": request.record(),
                "reply": answer,
                "reply_sha256": digest_json(answer),
            }
            write_text(self.path(request.key), json_text(entry))
        return reply

    def _save_images(self, request: ChatRequest) -> None:
        if request.images:
            make_folder(self.folder / IMAGES)
        for image in request.images:
            path = self.folder / IMAGES / f"{image.digest}.png"
            if not path.is_file():
                write_bytes(path, image.png)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock the folder against other threads and processes; leaves no lock file behind."""
        try:
            handle = hold_folder(self.folder, waits=True)
        except OSError as error:
            raise write_error(self.folder, error) from error
        try:
            yield
        finally:
            os.close(handle)
