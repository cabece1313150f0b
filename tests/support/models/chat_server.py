"""An OpenAI-compatible server on loopback that behaves as instructed by a test, and records requests."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from typing import Any

from file_server import LocalServer, send

from su3d_bench.perception.language.chat import LanguageConfig

KEY = "sk-test-0123456789abcdef"
Body = dict[str, Any]


@dataclass
class Answered:
    """The server's reaction to a request: a chat completion of ``text``, or something else."""

    text: str = "ok"
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    raw: bytes | None = None
    kind: str = "application/json"
    wait_s: float = 0.0
    usage: tuple[int, int] | None = (10, 5)
    finish: str = "stop"
    model: str | None = None


def error(status: int, message: str = "no", code: str | None = None) -> Answered:
    raw = json.dumps({"error": {"message": message, "code": code, "type": "x"}}).encode()
    return Answered(status=status, raw=raw, headers={"retry-after-ms": "1"})


def completion(body: Body, answered: Answered) -> bytes:
    value: Body = {
        "id": "1",
        "object": "chat.completion",
        "created": 0,
        "model": body.get("model", "") if answered.model is None else answered.model,
        "choices": [
            {"index": 0, "finish_reason": answered.finish, "message": {"role": "assistant", "content": answered.text}}
        ],
    }
    if answered.usage is not None:
        value["usage"] = {"prompt_tokens": answered.usage[0], "completion_tokens": answered.usage[1]}
    return json.dumps(value).encode()


class ChatServer(LocalServer):
    """``script`` is used up first, one answer per request; after that ``answer`` maps a body to an answer."""

    def __init__(self) -> None:
        self.forget()
        self.stop = threading.Event()
        self._lock = threading.Lock()
        super().__init__()
        self.url = f"http://127.0.0.1:{self.port}/v1"

    def forget(self) -> None:
        """Reset: no script, "ok" to every body, no recorded requests."""
        self.script: list[Answered] = []
        self.answer: Callable[[Body], Answered] = lambda body: Answered()
        self.bodies: list[Body] = []
        self.headers: list[dict[str, str]] = []

    @property
    def n_asked(self) -> int:
        return len(self.bodies)

    def respond(self, handler: BaseHTTPRequestHandler) -> None:
        body = json.loads(handler.rfile.read(int(handler.headers["Content-Length"])))
        with self._lock:
            self.bodies.append(body)
            self.headers.append({name.lower(): value for name, value in handler.headers.items()})
            answered = self.script.pop(0) if self.script else self.answer(body)
        self.stop.wait(answered.wait_s)
        content = answered.raw if answered.raw is not None else completion(body, answered)
        stated = {"Content-Type": answered.kind, "Content-Length": str(len(content)), **answered.headers}
        send(handler, answered.status, stated, content)

    def __exit__(self, *error: object) -> None:
        self.stop.set()
        super().__exit__(*error)


def quick_config(server: ChatServer | None = None, **changes: Any) -> LanguageConfig:
    """A configuration for tests: short waits, and one retry."""
    values: dict[str, Any] = {
        "base_url": "http://127.0.0.1:9/v1" if server is None else server.url,
        "key_variable": "SU3D_TEST_KEY",
        "timeout_s": 5.0,
        "max_retries": 1,
        "max_failures_in_a_row": 50,
    }
    return LanguageConfig(**(values | changes))
