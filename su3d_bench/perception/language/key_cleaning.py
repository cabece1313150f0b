"""The key of a server kept out of whatever that server says.

A server knows the key that it is given and can always find words of its own for it; what is found here is the key, or
eight characters of it or more, in capitals or small letters, backwards, with blanks, marks or quotes between, escaped
as in JSON, Python, HTML or addresses, once or several times over, as numbers, in ROT13, and in base 16, 32 or 64.
"""

from __future__ import annotations

import base64
import codecs
import html
import re
import unicodedata
from collections.abc import Iterator, Sequence
from itertools import permutations
from urllib.parse import unquote_to_bytes

PLACE = "(key)"
LEAST, SHORTEST = 8, 4  # letters and digits of a key that give it away; what is shorter than the shortest is no secret
# What servers of one's own take for a key: words that answers hold, too.
NO_SECRETS = frozenset({b"empty", b"none", b"null", b"test", b"dummy", b"fake", b"ollama", b"lmstudio", b"notneeded"})
MOST_ROUNDS = 4  # of escapes within escapes
KEY_LIKE = re.compile(r"\b(?:sk|pk|key|gsk|hf)[-_][A-Za-z0-9_\-*]{6,}", re.IGNORECASE)
ESCAPE = re.compile(
    r"\\(?:u\{?([0-9a-f]{1,8})\}?|U([0-9a-f]{8})|x([0-9a-f]{2})|([0-7]{3})|N\{([^}]{1,80})\}|.)",
    re.IGNORECASE | re.DOTALL,
)
OTHERS = bytes(byte for byte in range(256) if not chr(byte).isalnum() or byte > 127)
HEX, BASE_32 = re.compile("[^0-9a-f]"), re.compile("[^a-z2-7]")


class Secret:
    """What is known of a key, so that texts can be cleaned of it; one that is no secret cleans nothing."""

    def __init__(self, key: str) -> None:
        letters = _letters(key)
        self._length = min(LEAST, len(letters))
        is_secret = len(letters) >= SHORTEST and letters not in NO_SECRETS
        both = (letters, letters[::-1]) if is_secret else ()
        starts = range(len(letters) - self._length + 1)
        self._pieces = frozenset(one[k : k + self._length] for one in both for k in starts)

    def cleaned(self, text: str) -> str:
        """``text`` with ``(key)`` where the key stood, or nothing but that where it was hidden; writable as UTF-8."""
        text = text.encode("utf-8", "replace").decode("utf-8")
        if not self._pieces:
            return text
        text = self._without(text)
        return PLACE if any(map(self._is_in, _views(text))) else text

    def shown(self, text: str) -> str:
        """``text`` cleaned, and without what looks like any key."""
        return KEY_LIKE.sub(PLACE, self.cleaned(text)).replace(PLACE + PLACE, PLACE)

    def is_split(self, parts: Sequence[str]) -> bool:
        """Whether ``parts``, each cleaned, tell the key when they are put together in some order."""
        return any(self._is_in(b"".join(map(_letters, order))) for order in permutations(parts))

    def _is_in(self, letters: bytes) -> bool:
        return any(piece in letters for piece in self._pieces)

    def _without(self, text: str) -> str:
        """``text`` without the places whose letters and digits, one after the other, are of the key."""
        if not self._is_in(_letters(text)):
            return text
        letters = [(letter, at) for at, character in enumerate(text) for letter in _letters(character)]
        line = bytes(letter for letter, _ in letters)
        is_key = bytearray(len(text))
        for start in range(len(line) - self._length + 1):
            if line[start : start + self._length] in self._pieces:
                first, last = letters[start][1], letters[start + self._length - 1][1]
                is_key[first : last + 1] = b"\1" * (last + 1 - first)
        parts, end = [], 0
        for match in re.finditer(rb"\x01+", is_key):
            parts += [text[end : match.start()], PLACE]
            end = match.end()
        return "".join([*parts, text[end:]])


def _letters(text: str) -> bytes:
    """The letters and digits of ``text`` that a key may have, in one case, whatever form of them Unicode has.

    >>> _letters("SK-\uff41 b.1")
    b'skab1'
    """
    plain = unicodedata.normalize("NFKC", text).casefold() if not text.isascii() else text.lower()
    return _plain(plain.encode("ascii", "ignore"))


def _plain(content: bytes) -> bytes:
    return content.lower().translate(None, OTHERS)


def _views(text: str) -> Iterator[bytes]:
    """The letters of what ``text`` says where it is taken for escaped or encoded."""
    for _ in range(MOST_ROUNDS):
        yield from map(_plain, _decoded(text))
        whole = html.unescape(ESCAPE.sub(_unescaped, text)).encode("utf-8", "surrogatepass")  # a half of a pair, too
        plain = unquote_to_bytes(whole).decode("utf-8", "replace")
        if plain == text:
            return
        text = plain
        yield _letters(text)


def _unescaped(match: re.Match[str]) -> str:
    """The character that an escape stands for; a blank where it is none."""
    if match[0] == "\\\\":
        return "\\"  # the escape of an escape, for the next round
    short, long, byte, octal, name = match.groups()
    digits = next((one for one in (short, long, byte) if one is not None), None)
    try:
        if name is not None:
            return unicodedata.lookup(name)
        return " " if digits is None and octal is None else chr(int(octal, 8) if digits is None else int(digits, 16))
    except (KeyError, ValueError, OverflowError):
        return " "


def _decoded(text: str) -> Iterator[bytes]:
    """``text`` as numbers of characters, in ROT13, and in base 16, 32 and 64.

    Digits begin at every one that may be the first, are read backwards, too, and what stands between them is passed
    over.
    """
    yield codecs.encode(text, "rot13").encode("ascii", "ignore")
    numbers = (int(word) for word in re.findall(r"\d{2,3}", text))
    yield bytes(number for number in numbers if number < 128)
    small = text.lower()
    for digits in _both_ways(HEX.sub("", small.replace("0x", " "))):
        for start in range(2):
            yield bytes.fromhex(digits[start : start + (len(digits) - start) // 2 * 2])
    for digits in _both_ways(BASE_32.sub("", small).upper()):
        for start in range(8):
            yield base64.b32decode(digits[start : start + (len(digits) - start) // 8 * 8])
    joined = re.sub(r"[^A-Za-z0-9+/]", "", text)
    of_addresses = re.sub(r"[^A-Za-z0-9+/]", "", text.translate({ord("-"): "+", ord("_"): "/"}))
    for one in {joined, of_addresses}:
        for digits in (*_both_ways(one), one.swapcase()):
            for start in range(4):
                yield base64.b64decode(digits[start : start + (len(digits) - start) // 4 * 4])


def _both_ways(digits: str) -> tuple[str, str]:
    return digits, digits[::-1]
