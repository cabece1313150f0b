"""Damaged copies of a file that know a little of its format, so that damage gets past checksums and outer layers."""

from __future__ import annotations

import functools
import gzip
import io
import json
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

from bombs import MIB, Member, deflated, gzip_of, whole_member, zip_of

MOST_BYTES = 4 << 20  # of a copy
SWOLLEN = (*(1 << 16,) * 30, 32 << 20)  # zeros behind the member of an archive
MOST_INSIDE = 64 << 20  # bytes of a packed sample that are unpacked to be damaged
BOMBS = (1, 40, 2500)  # mebibytes that few bytes unpack to: what may be, and what may not
NUMBERS = (
    *("0", "-0", "1", "-1", "2", "0.5", "1e-320", "1e308", "-1e308", "1e999", "nan", "NaN", "inf", "-inf", "Infinity"),
    *("127", "128", "255", "256", "65535", "65536", "2147483647", "2147483648", "-2147483649", "4294967296"),
    *("9223372036854775807", "9223372036854775808", "-9223372036854775809", "18446744073709551616", "1" * 400),
    *("1" * 5000, "0x10", "1_000", "\u0663", "1,5", "+5", "1e5", "00012", "--1", "1.2.3", "0b1", "1e", "."),
)
TEXTS = (
    *("", " ", "\0", "\x1b[31m", "\u202e", "\u2028", "\x85", "\r", "\n", "\t", "\x7f", "\ud800", "\ufeff", "\u00fc"),
    *("\U0001f600", "../../etc/passwd", "/etc/passwd", "/dev/zero", "~root", ".", "..", "*", "a" * 20_000, "%s", "{0}"),
    *("{{7*7}}", "=1+1", "<script>", "</script>", "\\", '"', "'", "[", "]", "{", "}", "#", ",", ";", "null", "true"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, 2**63, -(2**63), 10**30, 0.5, 1e308, float("nan"), float("inf"), -0.0),
    *([], {}, [[]], [None], {"": None}, [0] * 1000, "", "x", "\0", "\x1b[31m", "\u202e\u2028", "../../etc/passwd"),
    *("/dev/zero", "a" * 20_000, "1", "nan", [1, [2, [3]]], {"a": {"b": {}}}),
)
WORDS = (
    *(0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 20, 1 << 28, 1 << 40),
    *(0x7FFFFFFFFFFFFFFF, 0x8000000000000000, 0xFFFFFFFFFFFFFFFF, 0x3FF0000000000000, 0x7FF8000000000000),
)
TOKEN = re.compile(r"[-+]?\d[\d.eE+-]*|[^\W\d]\w*|[^\w\s]")
NUMBER = re.compile(r"^[-+]?\d")
Mutation = Callable[[bytes, random.Random], bytes]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """A damaged copy of ``content``, at most ``MOST_BYTES`` long where ``content`` is."""
    draw = rng.random()
    if draw < 0.04:
        return rng.choice(SPECIAL)(content, rng)[: max(MOST_BYTES, len(content))]
    damaged = content
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        change = _of_format(damaged)
        damaged = (change if change is not None and rng.random() < 0.75 else _bytes)(damaged, rng)
        if not damaged:
            break
    return damaged[: max(MOST_BYTES, len(content))]


def _of_format(content: bytes) -> Mutation | None:
    for magic, change in MAGICS.items():
        if content.startswith(magic):
            return change
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return None
    if "\0" in text:
        return None
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return _text
    return _json


# --- bytes


def _bytes(content: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(content)
    at = rng.randrange(len(damaged)) if damaged else 0
    if rng.random() < 0.3:
        at = min(at, rng.randrange(256))  # headers stand in front
    end = min(len(damaged), at + rng.choice((1, 1, 2, 4, 8, 64)))
    kind = rng.randrange(8)
    if kind == 0:
        damaged[at:end] = rng.randbytes(end - at)
    elif kind == 1:
        damaged[at:end] = bytes([rng.choice((0, 0x20, 0x7F, 0x80, 0xFF))]) * (end - at)
    elif kind == 2:
        del damaged[at:end]
    elif kind == 3:
        damaged[at:at] = damaged[at:end] * rng.choice((1, 1, 100))
    elif kind == 4 and damaged:
        damaged[at] ^= 1 << rng.randrange(8)
    elif kind == 5:
        del damaged[at:]
    elif kind == 6:
        other = rng.randrange(len(damaged) + 1)
        damaged[at:end] = damaged[other : other + end - at]
    else:
        size = rng.choice((2, 4, 8))
        word = rng.choice(WORDS) & (256**size - 1)
        damaged[at : at + size] = word.to_bytes(size, rng.choice(("little", "big")))
    return bytes(damaged)


# --- text


def _text(content: bytes, rng: random.Random) -> bytes:
    text = content.decode("utf-8", "surrogatepass")
    kind = rng.randrange(8)
    if kind < 4:
        found = list(TOKEN.finditer(text))
        if not found:
            return _bytes(content, rng)
        one = rng.choice(found)
        pool = NUMBERS if NUMBER.match(one.group()) and rng.random() < 0.75 else TEXTS
        text = text[: one.start()] + rng.choice(pool) + text[one.end() :]
    elif kind < 7:
        lines = text.splitlines(keepends=True) or [text]
        at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        if kind == 4:
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == 5:
            lines[at:at] = [lines[other]] * _times(rng.choice((1, 1, 500)), len(lines[other]))
        else:
            del lines[at : at + rng.choice((1, 1, 5))]
        text = "".join(lines)
    else:
        at = rng.randrange(len(text) + 1)
        text = text[:at] + rng.choice(TEXTS) + text[at:]
    return text.encode("utf-8", "surrogatepass")


def _json(content: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.3:
        return _text(content, rng)
    tree = json.loads(content)
    holders = [([tree], 0), *_places(tree)]
    holder, key = rng.choice(holders)
    root = holder if key == 0 and holder == [tree] else [tree]
    kind = rng.randrange(6)
    if kind < 3:
        holder[key] = rng.choice(VALUES)
    elif kind == 3:
        del holder[key]
    elif kind == 4 and isinstance(holder, dict):
        holder[rng.choice(TEXTS)] = holder.pop(key)
    else:
        holder[key] = [holder[key]] * _times(rng.choice((1, 2, 300)), len(content))
    text = json.dumps(root[0] if root else None, ensure_ascii=rng.random() < 0.5)
    return text.encode("utf-8", "surrogatepass")


def _times(times: int, size: int) -> int:
    """``times``, or fewer where ``size`` bytes so many times are far more than a damaged copy may have."""
    return min(times, 1 + 2 * MOST_BYTES // max(size, 1))


def _places(tree: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    open_ends = [tree]
    while open_ends and len(found) < 5000:
        node = open_ends.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        found += [(node, key) for key in keys]
        open_ends += [node[key] for key in keys]
    return found


# --- files with an inside


def _gzip(content: bytes, rng: random.Random) -> bytes:
    unpacking = zlib.decompressobj(31)
    try:
        inside = unpacking.decompress(content, MOST_INSIDE)
    except zlib.error:
        return _bytes(content, rng)
    if not unpacking.eof:
        return _bytes(content, rng)
    if rng.random() < 0.02:
        return gzip_bomb()
    if rng.random() < 0.02:
        at = rng.randrange(len(inside) + 1)
        return gzip_of(inside[:at], rng.choice(BOMBS), rng.choice((0, 0x20, 0x5D, 0x94)), inside[at:])
    return gzip.compress(mutated(inside, rng), 1, mtime=0)


@functools.cache
def gzip_bomb() -> bytes:
    """64 KiB that inflate to 64 MiB of nothing."""
    return gzip.compress(bytes(64 << 20), 9, mtime=0)


def _zip(content: bytes, rng: random.Random) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if any(
                info.file_size > MOST_INSIDE or info.compress_size > info.file_size + MIB for info in archive.filelist
            ):
                return _bytes(content, rng)  # a bomb already
            members = [(info.filename, archive.read(info), info.compress_type) for info in archive.filelist]
    except Exception:  # noqa: BLE001 - it was damaged already, in any way
        return _bytes(content, rng)
    if not members:
        return _bytes(content, rng)
    at = rng.randrange(len(members))
    name, inside, method = members[at]
    kind = rng.randrange(10)
    if rng.random() < 0.05:
        return _swollen([(one, text) for one, text, _ in members], at, rng)
    if kind < 6:
        members[at] = (name, mutated(inside, rng), method)
    elif kind == 6:
        del members[at]
    elif kind == 7:
        members.append((name, mutated(inside, rng), method))
    elif kind == 8:
        members[at] = (rng.choice((f"../{name}", f"/{name}", name.upper(), f"{name}\x1b", "x" * 300)), inside, method)
    else:
        members[at] = (name, inside + bytes(rng.choice(SWOLLEN)), zipfile.ZIP_DEFLATED)
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w") as archive:
        warnings.simplefilter("ignore")  # two members of one name are meant
        for name, inside, method in members:
            archive.writestr(zipfile.ZipInfo(name), inside, method, 1)
    return out.getvalue()


def _swollen(members: list[tuple[str, bytes]], at: int, rng: random.Random) -> bytes:
    """An archive of which one member goes on for mebibytes, says so or not, and may be packed as nobody packs."""
    name, inside = members[at]
    n = rng.choice(BOMBS)
    packed = deflated(inside, n, rng.choice((0, 0x20)))
    promised = rng.choice((len(inside) + n * MIB, len(inside) + n * MIB, len(inside), 1 << 17))
    method = rng.choice((zipfile.ZIP_DEFLATED,) * 4 + (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2))
    whole = [whole_member(one, text) for one, text in members]
    whole[at] = Member(name, packed, promised, method)
    return zip_of(whole)


DOCTYPES = (
    *('<!DOCTYPE a [<!ENTITY b "bb">]>', '<!DOCTYPE a SYSTEM "file:///etc/passwd">', "<!DOCTYPE a>"),
    '<!DOCTYPE a [<!ENTITY b "bbbbbbbb"><!ENTITY c "&b;&b;&b;&b;">]>',
)
ENCODINGS = ("utf-8", "utf-16", "utf-16-le", "iso-8859-1", "cp1252", "utf-7", "cp037")
TAG = re.compile(r"<[^<>]*>")


def _xml(content: bytes, rng: random.Random) -> bytes:
    """XML with a document type, in another encoding, with elements again and again or within each other."""
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return _bytes(content, rng)
    tags = list(TAG.finditer(text))
    kind = rng.randrange(6)
    if kind > 3 or not tags:
        return _text(content, rng)
    one = rng.choice(tags)
    if kind == 0:
        encoding, body = rng.choice(ENCODINGS), text.partition("?>")[2] or text
        said = f'<?xml version="1.0" encoding="{encoding}"?>{rng.choice(DOCTYPES)}{body}'
        return said.encode(encoding, "replace")
    if kind < 3:
        again = one.group() * _times(rng.choice((1, 300, 300_000)), len(one.group()))
        text = text[: one.start()] + again + text[one.start() :]
    else:
        value = re.sub(r'"[^"]*"', f'"{rng.choice((*NUMBERS, *TEXTS))}"', one.group(), count=1)
        text = text[: one.start()] + value + text[one.end() :]
    return text.encode("utf-8", "surrogatepass")


def _npy(content: bytes, rng: random.Random) -> bytes:
    """An array whose header says something else."""
    if len(content) < 12 or rng.random() < 0.4:
        return _bytes(content, rng)
    wide = content[6] > 1
    start = 12 if wide else 10
    size = int.from_bytes(content[8:start], "little")
    header, body = content[start : start + size], content[start + size :]
    draw = rng.random()
    if draw < 0.5:
        shapes = ("()", "(0,)", "(1099511627776,)", "(4294967296, 4294967296)", "(-1,)", "(2,)*40", "(3.0,)", "5")
        shape = rng.choice(shapes).encode()
        header = re.sub(rb"\([^)]*\)", lambda _: shape, header, count=1)
    elif draw < 0.75:
        types = ("|O", "<f2", ">f8", "<U1", "|V0", "|S0", "<M8[ns]", "<c16", "<i16", "\x1b", "|b1", "[('a','<f4')]")
        kind = repr(rng.choice(types)).encode()
        header = re.sub(rb"'[<>|=][^']*'", lambda _: kind, header, count=1)
    else:
        header = _text(header, rng) if header.isascii() else header
    header = header[:60_000]
    return content[:8] + len(header).to_bytes(4 if wide else 2, "little") + header + body


def _png(content: bytes, rng: random.Random) -> bytes:
    """A PNG of another size, depth or colour, with the checksum that goes with it."""
    if rng.random() < 0.5 or len(content) < 33:
        return _bytes(content, rng)
    fields = list(struct.unpack(">IIBBBBB", content[16:29]))
    k = rng.randrange(7)
    sizes = (0, 1, 7, 65_535, 1_000_000, 2**31 - 1, 2**32 - 1)
    fields[k] = rng.choice(sizes) if k < 2 else rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    header = struct.pack(">IIBBBBB", *fields)
    return content[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + content[33:]


def _jpeg(content: bytes, rng: random.Random) -> bytes:
    """A JPEG that says it has another size, or says its scans again and again."""
    scan = content.find(b"\xff\xda")
    if scan > 0 and rng.random() < 0.1:
        pixels = content[scan:].removesuffix(b"\xff\xd9")
        return content[:scan] + pixels * _times(rng.choice((2, 500)), len(pixels)) + b"\xff\xd9"
    at = max(content.find(b"\xff\xc0"), content.find(b"\xff\xc2"))
    if at < 0 or rng.random() < 0.5:
        return _bytes(content, rng)
    size = rng.choice((0, 1, 9, 20_000, 65_535)).to_bytes(2, "big")
    where = at + rng.choice((5, 7))
    return content[:where] + size + content[where + 2 :]


SNIPPETS = (
    *(b"cos\nsystem\n", b"cbuiltins\neval\n", b"\x93", b"R", b"b", b"(", b"t", b"\x85", b"0", b"2", b"\x94", b"a"),
    *(b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f", b"\x8b\xff\xff\xff\x7f", b"X\xff\xff\xff\xff", b"u"),
    *(b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff", b"B\xff\xff\xff\x7f", b"h\x00", b"j\xff\xff\xff\xff", b"q\x00"),
    *(b"r\xff\xff\xff\xff", b"]" * 99, b"(" * 2000, b"}" * 500, b"P1\n", b"Q", b"I99\n", b"F1e999\n", b"L1L\n"),
    *(b"\x95\xff\xff\xff\xff\xff\xff\xff\xff", b"\x96\xff\xff\xff\xff\xff\xff\xff\x7f", b"\x97", b"\x98", b"\x82\x01"),
    *(b"i", b"o", b"\x81", b"\x92", b".", b"N0" * 999),
)


def _pickle(content: bytes, rng: random.Random) -> bytes:
    """A pickle with opcodes put in or in place of others."""
    if rng.random() < 0.5:
        return _bytes(content, rng)
    at = rng.randrange(len(content))
    return content[:at] + rng.choice(SNIPPETS) + content[at + rng.choice((0, 0, 1, 2)) :]


MAGICS: dict[bytes, Mutation] = {
    b"\x1f\x8b": _gzip,
    b"PK\x03\x04": _zip,
    b"\x93NUMPY": _npy,
    b"\x89PNG": _png,
    b"\xff\xd8": _jpeg,
    b"<": _xml,
    b"\x80\x02": _pickle,
    b"\x80\x04": _pickle,
}
SPECIAL: tuple[Mutation, ...] = (
    lambda content, rng: b"",
    lambda content, rng: b"\xef\xbb\xbf" + content,
    lambda content, rng: content.decode("latin-1").encode("utf-16"),
    lambda content, rng: bytes(rng.choice((1, 100, 100_000))),
    lambda content, rng: rng.randbytes(rng.choice((1, 100, 5000))),
    lambda content, rng: b"[" * 100_000,
    lambda content, rng: b'{"a":' * 50_000,
    lambda content, rng: b"a = " + b"[" * 20_000,
    lambda content, rng: content * max(2, min(1000, (1 << 20) // max(1, len(content)))),
    lambda content, rng: content + content,
    lambda content, rng: content.replace(b"\n", b"\r\n"),
    lambda content, rng: content.replace(b"\n", b"\r"),
    lambda content, rng: content.replace(b"\n", b" "),
    lambda content, rng: content[: rng.randrange(len(content) + 1)],
    lambda content, rng: b"1" * 1_000_000,
    lambda content, rng: b"\x1b[31m" + content,
)
