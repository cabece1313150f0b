"""An OpenAI-compatible server on loopback that behaves as a test tells it to, and counts what it is asked."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from su3d_bench.perception.language.chat import LanguageConfig

KEY = "sk-test-0123456789abcdef"
Body = dict[str, Any]


@dataclass
class Answered:
    """What the server does with a request: a chat completion of ``text``, or something else."""

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


class ChatServer:
    """``script`` is worked off first, one answer a request; after it ``answer`` says what to do with a body."""

    def __init__(self) -> None:
        self.forget()
        self.stop = threading.Event()
        self._lock = threading.Lock()
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle(self) -> None:
                """Clients that give up close the connection at any moment, also while its next request is awaited."""
                with suppress(ConnectionError):
                    super().handle()

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                server.respond(self, body)

            def log_message(self, *words: Any) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}/v1"
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def forget(self) -> None:
        """As nothing had been asked: no script, "ok" to every body, nothing counted."""
        self.script: list[Answered] = []
        self.answer: Callable[[Body], Answered] = lambda body: Answered()
        self.bodies: list[Body] = []
        self.headers: list[dict[str, str]] = []

    @property
    def n_asked(self) -> int:
        return len(self.bodies)

    def respond(self, handler: BaseHTTPRequestHandler, body: Body) -> None:
        with self._lock:
            self.bodies.append(body)
            self.headers.append({name.lower(): value for name, value in handler.headers.items()})
            answered = self.script.pop(0) if self.script else self.answer(body)
        self.stop.wait(answered.wait_s)
        content = answered.raw if answered.raw is not None else completion(body, answered)
        stated = {"Content-Type": answered.kind, "Content-Length": str(len(content)), **answered.headers}
        with suppress(OSError):
            handler.send_response(answered.status)
            for name, value in stated.items():
                handler.send_header(name, value)
            handler.end_headers()
            handler.wfile.write(content)

    def close(self) -> None:
        self.stop.set()
        self._http.shutdown()
        self._http.server_close()


def chat_server() -> closing[ChatServer]:
    return closing(ChatServer())


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
