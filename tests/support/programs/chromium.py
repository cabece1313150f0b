"""A headless Chromium for tests, driven through its DevTools protocol over a pipe: no driver, no network."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS: tuple[str, ...] = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-extensions", "--disable-dev-shm-usage", "--mute-audio",
    "--remote-debugging-pipe",
)  # fmt: skip
WAIT_S = 120.0
# Key names as seen by the page's controls.
KEY_CODES = {
    "Tab": 9, "Enter": 13, "Escape": 27, "Space": 32, "End": 35, "Home": 36, "ArrowLeft": 37, "ArrowUp": 38,
    "ArrowRight": 39, "ArrowDown": 40, "Backspace": 8,
}  # fmt: skip


def find_chromium() -> str | None:
    """Path of the browser; None if none is installed."""
    return next((found for name in NAMES if (found := shutil.which(name)) is not None), None)


needs_chromium = pytest.mark.skipif(find_chromium() is None, reason="needs Chromium: apt-get install chromium")


# Answers of the browser if the page navigates away.
LEAVES = ("navigated or closed", "context was destroyed")


class PageLeftError(Exception):
    """The page navigated away before it answered."""


class Chromium:
    """A browser with one page; its profile stays in ``folder``, so that a second one can use it."""

    def __init__(self, folder: Path, *, width: int = 1280, height: int = 800, is_phone: bool = False) -> None:
        program = find_chromium()
        assert program is not None
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        self._rest, self._number = b"", 0
        command = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
        # The protocol uses descriptors 3 and 4; plain sh can access descriptors above 9 only by path.
        shell = ["sh", "-c", f'exec "$@" 3</dev/fd/{to_browser} 4>/dev/fd/{from_browser}', "sh", *command]
        self._process = subprocess.Popen(
            shell, pass_fds=(to_browser, from_browser), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(to_browser)
        os.close(from_browser)
        self.messages: list[dict[str, Any]] = []
        target = self._call("Target.createTarget", {"url": "about:blank"}, None)["targetId"]
        self._session = self._call("Target.attachToTarget", {"targetId": target, "flatten": True}, None)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_phone}
        self.call("Emulation.setDeviceMetricsOverride", size)

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._call("Browser.close", {}, None)
            self._process.wait(timeout=20)
        except (OSError, AssertionError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def call(self, method: str, values: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Send a command to the page; unrelated messages received meanwhile are kept in ``messages``."""
        return self._call(method, values or {}, self._session)

    def _call(self, method: str, values: Mapping[str, Any], session: str | None) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": dict(values)}
        if session is not None:
            message["sessionId"] = session
        content = json.dumps(message).encode() + b"\0"
        while content:
            content = content[os.write(self._write, content) :]
        end = time.monotonic() + WAIT_S
        while True:
            answer = self._next(end)
            if answer.get("id") == self._number:
                if any(words in str(answer.get("error", "")) for words in LEAVES):
                    raise PageLeftError(answer["error"])
                assert "error" not in answer, answer["error"]
                result: dict[str, Any] = answer["result"]
                return result
            self.messages.append(answer)

    def _next(self, end: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], max(0.0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            part = os.read(self._read, 1 << 16)
            assert part, "the browser has exited"
            self._rest += part
        line, _, self._rest = self._rest.partition(b"\0")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def open(self, path: Path) -> None:
        """Open a file, like a double click on it."""
        self._arrive("Page.navigate", {"url": path.resolve().as_uri()})

    def reload(self, until: str, keep: str = "0") -> None:
        """Reload the page until an expression is true.

        Unlike ``open`` in the same process, which sees data just stored; repeated, because stored data
        may reach the browser's store only after a reload. ``keep``: a script to
        run before each load, because a browser whose store opens late loses earlier data.
        """

        def is_so() -> bool:
            self.run(keep)
            self._arrive("Page.reload", {})
            return bool(self.run(until))

        wait_until(is_so, f"not true of the reloaded page: {until}", WAIT_S)

    def _arrive(self, method: str, values: Mapping[str, Any]) -> None:
        self.run("window.isOfThePageBefore = true")
        self.call(method, values)
        there = "!window.isOfThePageBefore && document.readyState === 'complete' && location.protocol === 'file:'"

        def has_arrived() -> bool:
            try:
                return bool(self.run(there))
            except PageLeftError:  # the previous page closed during the call
                return False

        wait_until(has_arrived, f"the page did not load: {method}", WAIT_S)

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        answer = self.call("Runtime.evaluate", {"expression": script, "returnByValue": True, "awaitPromise": True})
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, script: str) -> None:
        """Wait until an expression is true."""
        wait_until(lambda: self.run(script), f"it did not become true: {script}", WAIT_S)

    def press(self, *keys: str) -> None:
        """Press keys one after another: ``1``, ``u``, ``ArrowLeft``, ``Enter``, ``Shift+Tab``."""
        for name in keys:
            *contents, key = name.split("+") if len(name) > 1 else [name]
            text = {"Enter": "\r", "Space": " "}.get(key, key if len(key) == 1 else "")
            values: dict[str, Any] = {
                "key": " " if key == "Space" else key,
                "modifiers": 8 if contents == ["Shift"] else 0,
            }
            if key in KEY_CODES:
                values |= {"code": key, "windowsVirtualKeyCode": KEY_CODES[key]}
            self.call("Input.dispatchKeyEvent", {"type": "keyDown", **values, **({"text": text} if text else {})})
            self.call("Input.dispatchKeyEvent", {"type": "keyUp", **values})

    def downloads_to(self, folder: Path) -> None:
        self._call("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)}, None)

    def faults(self) -> list[str]:
        """Complaints of the page: errors, blocked resources, every requested address."""
        self.run("0")
        found = []
        for one in self.messages:
            values = one.get("params", {})
            if one.get("method") == "Runtime.exceptionThrown":
                found.append(str(values["exceptionDetails"].get("text")))
            elif one.get("method") == "Log.entryAdded":
                found.append(str(values["entry"].get("text")))
            elif one.get("method") == "Network.requestWillBeSent":
                url = str(values["request"]["url"])
                found += [] if url.startswith(("file:", "data:", "blob:", "about:")) else [url]
            elif one.get("method") == "Network.webSocketCreated":
                found.append(str(values["url"]))
            elif one.get("method") == "Runtime.consoleAPICalled" and values["type"] in ("error", "warning", "assert"):
                found.append(str([each.get("value", each.get("description")) for each in values["args"]]))
        return found
