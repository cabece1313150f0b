"""Damaged copies of a file that respect parts of its format, so that damage gets past checksums and outer layers."""

from __future__ import annotations

import gzip
import io
import random
import re
import warnings
import zipfile
import zlib

from decompression_bombs import MIB, Member, deflated, gzip_of, whole_member, zip_of

from su3d_bench.core.files.atomic import DAMAGE

MAX_BYTES = 4 << 20  # of a copy
MAX_INSIDE = 64 << 20  # bytes of a packed sample to unpack for damaging
BOMBS = (1, 40, 2500)  # mebibytes that few bytes unpack to: allowed and excessive
NUMBERS = (
    *("0", "-0", "1", "-1", "2", "0.5", "1e-320", "1e308", "1e999", "nan", "NaN", "-inf", "Infinity", "127", "256"),
    *("65536", "2147483648", "-2147483649", "4294967296", "9223372036854775808", "18446744073709551616", "1" * 5000),
    *("0x10", "1_000", "\u0663", "1,5", "+5", "00012", "--1", "1.2.3", "1e", "."),
)
TEXTS = (
    *("", " ", "\0", "\x1b[31m", "\u202e", "\u2028", "\x85", "\r", "\n", "\t", "\ud800", "\ufeff", "\u00fc"),
    *("\U0001f600", "../../etc/passwd", "/dev/zero", "~root", "..", "*", "a" * 20_000, "%s", "{0}", "=1+1"),
    *("<script>", '<!DOCTYPE a [<!ENTITY b "bb">]>', "\\", '"', "'", "[", "]", "{", "}", "#", ",", ";", "null", "true"),
    *("[]", "{}", "[[[]]]", "1e400", "-1", "[" * 100_000),
)
WORDS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 28, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
TOKEN = re.compile(r"[-+]?\d[\d.eE+-]*|[^\W\d]\w*|[^\w\s]")
SNIPPETS = (  # of pickles
    *(b"cos\nsystem\n", b"\x93", b"R", b"b", b"(", b"t", b"\x85", b"2", b"\x94", b"a", b"u", b"h\x00", b"\x81", b"."),
    *(b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f", b"\x8d" + b"\xff" * 8, b"B\xff\xff\xff\x7f", b"]" * 99, b"Q", b"i"),
)


def mutated(content: bytes, rng: random.Random) -> bytes:
    """A damaged copy of ``content``, at most ``MAX_BYTES`` long if ``content`` is."""
    damaged = content
    if rng.random() < 0.04:
        damaged = rng.choice((b"", b"\xef\xbb\xbf" + content, bytes(1000), b"1" * 1_000_000, rng.randbytes(500)))
    for _ in range(rng.choice((1, 1, 1, 2, 3)) if damaged is content else 0):
        if rng.random() < 0.25:
            damaged = _bytes(damaged, rng)
        elif damaged.startswith(b"\x1f\x8b"):
            damaged = _gzip(damaged, rng)
        elif damaged.startswith(b"PK\x03\x04"):
            damaged = _zip(damaged, rng)
        elif damaged.startswith((b"\x80\x02", b"\x80\x04")):
            at = rng.randrange(len(damaged))
            damaged = damaged[:at] + rng.choice(SNIPPETS) + damaged[at + rng.choice((0, 1, 2)) :]
        else:
            damaged = _text(damaged, rng)
    return damaged[: max(MAX_BYTES, len(content))]


def _bytes(content: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(content)
    at = rng.randrange(len(damaged)) if damaged else 0
    if rng.random() < 0.3:
        at = min(at, rng.randrange(256))  # headers are at the beginning
    end = min(len(damaged), at + rng.choice((1, 1, 2, 4, 8, 64)))
    kind = rng.randrange(7)
    if kind == 0:
        damaged[at:end] = rng.randbytes(end - at)
    elif kind == 1:
        damaged[at:end] = bytes([rng.choice((0, 0x20, 0x7F, 0x80, 0xFF))]) * (end - at)
    elif kind == 2:
        del damaged[at:end]
    elif kind == 3:
        damaged[at:at] = damaged[at:end] * rng.choice((1, 1, 100))
    elif kind == 4:
        del damaged[at:]
    elif kind == 5:
        other = rng.randrange(len(damaged) + 1)
        damaged[at:end] = damaged[other : other + end - at]
    else:
        size = rng.choice((2, 4, 8))
        word = rng.choice(WORDS) & (256**size - 1)
        damaged[at : at + size] = word.to_bytes(size, rng.choice(("little", "big")))
    return bytes(damaged)


def _text(content: bytes, rng: random.Random) -> bytes:
    """A text, or text at the beginning of a binary file, with changed words and lines."""
    end = len(content) if b"\0" not in content[:4096] else content.find(b"\n") + 1
    try:
        text = content[:end].decode()
    except UnicodeDecodeError:
        return _bytes(content, rng)
    found = list(TOKEN.finditer(text[: 1 << 20]))
    if not found:
        return _bytes(content, rng)
    kind = rng.randrange(8)
    if kind < 5:
        one = rng.choice(found)
        pool = NUMBERS if one.group()[-1].isdigit() and rng.random() < 0.75 else TEXTS
        text = text[: one.start()] + rng.choice(pool) + text[one.end() :]
    else:
        lines = text.splitlines(keepends=True)
        at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        if kind == 5:
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == 6:
            lines[at:at] = [lines[other]] * min(rng.choice((1, 1, 500)), 1 + MAX_BYTES // len(lines[other]))
        else:
            del lines[at : at + rng.choice((1, 1, 5))]
        text = "".join(lines)
    return text.encode("utf-8", "surrogatepass") + content[end:]


def _gzip(content: bytes, rng: random.Random) -> bytes:
    unpacking = zlib.decompressobj(31)
    try:
        inside = unpacking.decompress(content, MAX_INSIDE)
    except zlib.error:
        return _bytes(content, rng)
    if not unpacking.eof:
        return _bytes(content, rng)
    if rng.random() < 0.03:
        at = rng.randrange(len(inside) + 1)
        return gzip_of(inside[:at], rng.choice(BOMBS), rng.choice((0, 0x20, 0x5D, 0x94)), inside[at:])
    return gzip.compress(mutated(inside, rng), 1, mtime=0)


def _zip(content: bytes, rng: random.Random) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            sizes = [max(info.file_size, info.compress_size * 64) for info in archive.filelist]
            if sum(sizes) > MAX_INSIDE:
                return _bytes(content, rng)  # a bomb already
            members = [(info.filename, archive.read(info), info.compress_type) for info in archive.filelist]
        at = rng.randrange(len(members))
    except DAMAGE:  # it is already damaged
        return _bytes(content, rng)
    name, inside, method = members[at]
    kind = rng.randrange(10)
    if rng.random() < 0.05:
        n = rng.choice(BOMBS)
        promised = rng.choice((len(inside) + n * MIB, len(inside), 1 << 17))
        whole = [whole_member(one, text) for one, text, _ in members]
        whole[at] = Member(name, deflated(inside, n, rng.choice((0, 0x20))), promised)
        return zip_of(whole)
    if kind < 7:
        members[at] = (name, mutated(inside, rng), method)
    elif kind == 7:
        del members[at]
    elif kind == 8:
        members.append((name, mutated(inside, rng), method))
    else:
        members[at] = (rng.choice((f"../{name}", f"/{name}", name.upper(), f"{name}\x1b", "x" * 300)), inside, method)
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w") as archive:
        warnings.simplefilter("ignore")  # duplicate member names are intended
        for name, inside, method in members:
            archive.writestr(zipfile.ZipInfo(name), inside, method, 1)
    return out.getvalue()
