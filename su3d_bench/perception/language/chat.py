"""What is asked of a language model, and what it answered."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.digests import digest_bytes, digest_json
from su3d_bench.core.types import UInt8Array

Purpose = Literal["caption", "refine", "ask", "judge"]
CHARACTERS_A_TOKEN = 4  # OpenAI's rule of thumb for English
MESSAGE_TOKENS = 8  # what the frame of a message costs, roughly


@dataclass(frozen=True, eq=False)
class Image:
    """An RGB picture (h, w, 3) that goes along with a request."""

    rgb: UInt8Array

    @cached_property
    def digest(self) -> str:
        """A key of the pixels, whatever library packs them."""
        return digest_bytes(f"{self.rgb.shape}".encode() + np.ascontiguousarray(self.rgb).tobytes())

    @cached_property
    def png(self) -> bytes:
        import cv2

        done, packed = cv2.imencode(".png", np.ascontiguousarray(self.rgb[:, :, ::-1]))
        assert done, "a picture in memory is packed"
        return packed.tobytes()

    def n_tokens(self, detail: str) -> int:
        """Tokens by OpenAI's rule for GPT-4 with vision: 85, and 170 a tile of 512 pixels unless detail is low."""
        if detail == "low":
            return 85
        height, width = self.rgb.shape[:2]
        scale = min(1.0, 2048 / max(height, width))
        scale *= min(1.0, 768 / (min(height, width) * scale))
        return 85 + 170 * int(np.ceil(height * scale / 512) * np.ceil(width * scale / 512))


def fitted(rgb: UInt8Array, most_px: int) -> Image:
    """``rgb`` with its longer side at most ``most_px``."""
    longer = max(rgb.shape[:2])
    if longer <= most_px:
        return Image(rgb)
    import cv2

    height, width = (max(1, round(side * most_px / longer)) for side in rgb.shape[:2])
    return Image(np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8))


@dataclass(frozen=True)
class ChatRequest:
    """One question; ``key`` addresses it by content, the server that answers left aside.

    ``form``: the JSON that is asked of a server which can be held to a schema.
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
    form: type[BaseModel] | None = None

    def record(self) -> dict[str, Any]:
        """The request as it is stored: images by their digest."""
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
        }
        if self.form is not None:
            schema = {"name": self.form.__name__, "strict": True, "schema": self.form.model_json_schema()}
            body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return body if self.seed is None else body | {"seed": self.seed}

    @property
    def n_input_tokens(self) -> int:
        """A rough count of the tokens that go in."""
        words = n_tokens(self.system) + n_tokens(self.text) + 2 * MESSAGE_TOKENS
        return words + sum(image.n_tokens(self.image_detail) for image in self.images)


def n_tokens(text: str) -> int:
    """A rough count of the tokens of ``text``: one for every four bytes of UTF-8."""
    return -(-len(text.encode()) // CHARACTERS_A_TOKEN)


@dataclass(frozen=True)
class Reply:
    """What came of a request: ``text``, or the reason of a ``failure``.

    ``dropped`` names the parameters that the server would not take; ``was_stored``: nobody was asked.
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
