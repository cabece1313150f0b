"""One request for a file, or for the rest of one: who may answer, and what of an answer is believed."""

from __future__ import annotations

import http.client
import re
import urllib.error
import urllib.request
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any

from su3d_bench.core.errors import DataError, printable
from su3d_bench.fetching.sources import check_address

TIMEOUT_S = 30.0  # without a byte
STATUS_TO_TRY_AGAIN = frozenset({408, 425, 429})
MOST_REDIRECTIONS = 5
_RANGE = re.compile(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18})")
_NONE_OF_IT = re.compile(r"bytes \*/(\d{1,18})")


class Broken(Exception):
    """The connection failed or broke off; the next attempt may do better."""


class Stale(Exception):
    """What is held cannot be the beginning of what the server has, unless that has just ``n_bytes``."""

    def __init__(self, reason: str, n_bytes: int | None = None) -> None:
        super().__init__(reason)
        self.n_bytes = n_bytes


@dataclass(frozen=True)
class Validator:
    """By what a server knows a state of a file again: a strong entity tag, or a time of change."""

    etag: str = ""
    last_modified: str = ""

    @property
    def words(self) -> str:
        """For the header ``If-Range``; weak tags and nothing at all give nothing (RFC 9110, 13.1.5)."""
        return self.etag if self.etag.startswith('"') else self.last_modified


@dataclass
class Answer:
    """The body of a file from byte ``start`` on; ``n_bytes`` is the size of the whole, None where it is not said."""

    body: IO[bytes]
    start: int
    n_bytes: int | None
    validator: Validator


class _NamedHostsOnly(urllib.request.HTTPRedirectHandler):
    max_redirections = MOST_REDIRECTIONS

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = hosts

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        try:
            check_address(newurl, self._hosts)
        except ValueError as error:
            raise DataError(f"{req.full_url}: is redirected, which is refused: {error}") from error
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def ask(address: str, hosts: Sequence[str], start: int, validator: Validator, timeout_s: float = TIMEOUT_S) -> Answer:
    """The content of ``address`` from byte ``start`` on, or from its beginning where the server gives no part of it.

    The part is asked for on the condition that the file is still the one of ``validator``; without one nothing but the
    checksum at the end tells. Raises ``Broken``, ``Stale``, or ``DataError`` where no attempt will do better.
    """
    headers = {"Accept-Encoding": "identity", "User-Agent": "su3d-bench"}
    if start:
        headers["Range"] = f"bytes={start}-"
        if validator.words:
            headers["If-Range"] = validator.words
    opener = urllib.request.build_opener(_NamedHostsOnly(hosts))
    try:
        response = opener.open(urllib.request.Request(address, headers=headers), timeout=timeout_s)
    except urllib.error.HTTPError as error:
        with error:
            raise _judged(address, error, start) from None
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise Broken(f"the connection failed: {printable(str(reason), 120) or type(error).__name__}") from None
    try:
        return _answer(address, response, start)
    except BaseException:
        response.close()
        raise


def _judged(address: str, error: urllib.error.HTTPError, start: int) -> Exception:
    if error.code == 416 and start:
        whole = _NONE_OF_IT.fullmatch((error.headers.get("Content-Range") or "").strip())
        return Stale(f"the server has {whole[1]} bytes", int(whole[1])) if whole else Stale("the server has less")
    if error.code in STATUS_TO_TRY_AGAIN or error.code >= 500:
        return Broken(f"status {error.code}: {printable(str(error.reason), 80)}")
    advice = {
        401: "it asks who you are, and nothing of the kind is sent; name a mirror with --mirror",
        403: "it gives you nothing; name a mirror with --mirror",
        404: "there is no such file any more; name where it lies now with --mirror",
        410: "there is no such file any more; name where it lies now with --mirror",
    }.get(error.code, "name a mirror with --mirror")
    return DataError(f"{address}: status {error.code} ({printable(str(error.reason), 80)}): {advice}")


def _answer(address: str, response: Any, start: int) -> Answer:
    headers = response.headers
    if (headers.get("Content-Encoding") or "identity").strip().lower() != "identity":
        raise DataError(f"{address}: comes packed, which was not asked for; name a mirror with --mirror")
    length = None
    with suppress(ValueError):
        length = int(headers.get("Content-Length") or "")
    if length is not None and length < 0:
        length = None
    tag = (headers.get("ETag") or "").strip()[:300]
    validator = Validator(tag, (headers.get("Last-Modified") or "").strip()[:100])
    if response.status == 206:
        part = _RANGE.fullmatch((headers.get("Content-Range") or "").strip())
        if part is None or int(part[1]) != start or int(part[2]) != int(part[3]) - 1:
            raise Stale("the server gave another part than the one that was asked for")
        return Answer(response, start, int(part[3]), validator)
    if response.status != 200:
        raise DataError(f"{address}: status {response.status}; name a mirror with --mirror")
    return Answer(response, 0, length, validator)
