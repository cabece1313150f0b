"""The worksheets of an XLSX file as texts: what its relationships call a worksheet, wherever in the archive it lies.

Source: ECMA-376, Office Open XML, parts 1 and 2. Three kinds of parts are parsed: relationships, the workbook and its
worksheets, and the texts that cells share; pictures, styles and all else stay packed. The parser is told to end at a
document type, so that no entity is ever defined, whatever the encoding. Formulas are texts.
"""

from __future__ import annotations

import io
import lzma
import posixpath
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.files.unpacking import ENCRYPTED, METHODS, PIECE
from su3d_bench.formats.tables.csv_text import MOST_ROWS

MOST_XML_BYTES = 32 << 20  # of all parts that are parsed together: some ten thousand answers and more
MOST_CELLS = 2_000_000  # of all worksheets, and of the texts that they share
MOST_COLUMNS = 64  # beyond which nothing is looked at
MOST_CHARACTERS = 32_767  # of a cell, the limit of the format
MOST_DEPTH = 64  # of elements within each other; the format has a dozen
MOST_SHEETS = 1000
PACKAGE = "_rels/.rels"
REFERENCE = re.compile(r"([A-Z]{1,3})([0-9]{1,7})")
# What a damaged archive or text in it makes zipfile and expat raise.
DAMAGE = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, OverflowError, LookupError, ValueError,
    RuntimeError, struct.error, expat.ExpatError,
)  # fmt: skip

Row = tuple[int, list[str | None]]  # its number from 1 on, and its cells from column A on
Attributes = Mapping[str, str]


@dataclass(frozen=True)
class Worksheet:
    """The rows of a worksheet that have cells, in the order of the file."""

    name: str
    rows: list[Row]


def read_workbook(content: bytes, where: str) -> list[Worksheet]:
    """Every worksheet in the order of the workbook; ``DataError``, which begins with ``where``, for anything else."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            parts = _Parts(archive, where)
            book, *_ = [*(one.target for one in parts.relations("", "officeDocument").values()), ""]
            sheets = _Sheets()
            parts.parse(book, sheets)
            shared = _Shared()
            for one in parts.relations(book, "sharedStrings").values():
                parts.parse(one.target, shared)
            pages = parts.relations(book, "worksheet")
            cells = _Count()
            found = []
            for name, key in sheets.found:
                if key in pages:
                    page = _Cells(shared.texts, cells)
                    parts.parse(pages[key].target, page)
                    found.append(Worksheet(name, page.rows))
            return found
    except DataError:
        raise
    except _TooMuchError as error:
        raise DataError(f"{where}: {error}") from error
    except DAMAGE as error:
        reason = printable(f"{type(error).__name__}: {error}", 120)
        raise DataError(f"{where}: is no whole .xlsx file ({reason}); save the workbook as .xlsx again") from error


class _TooMuchError(Exception):
    """A workbook holds more than any of ours."""


@dataclass(frozen=True)
class _Relation:
    kind: str
    target: str


class _Content:
    """What is made of a part: its elements come as they begin and end, without their namespaces, and texts between."""

    def begin(self, name: str, attributes: Attributes) -> None: ...

    def end(self, name: str) -> None: ...

    def text(self, text: str) -> None: ...


class _Parts:
    """The parts of a workbook, unpacked piece by piece and no further than all of them together may be."""

    def __init__(self, archive: zipfile.ZipFile, where: str) -> None:
        self._archive, self._where = archive, where
        self._n_left = MOST_XML_BYTES

    def relations(self, part: str, kind: str) -> dict[str, _Relation]:
        """The relationships of ``part`` ("": of the package) of one kind, by their ids."""
        folder, name = posixpath.split(part)
        found = _Relations(folder)
        self.parse(posixpath.join(folder, "_rels", f"{name}.rels"), found)
        return {key: one for key, one in found.found.items() if one.kind == kind}

    def parse(self, name: str, content: _Content) -> None:
        """Everything in a part, in its order, to ``content``."""
        parser = expat.ParserCreate(None, " ", None)  # without a table of names, which a file could make any length
        parser.buffer_text = True
        parser.buffer_size = 1 << 16
        depth = 0

        def begin(name: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            if depth > MOST_DEPTH:
                raise _TooMuchError(f"'{printable(name, 40)}' lies {depth} elements deep; save it as .xlsx again")
            content.begin(_local(name), attributes)

        def end(name: str) -> None:
            nonlocal depth
            depth -= 1
            content.end(_local(name))

        def refuse(*_: Any) -> None:
            raise DataError(f"{self._where}: defines entities, which no workbook needs; save it as .xlsx again")

        parser.StartElementHandler, parser.EndElementHandler = begin, end
        parser.CharacterDataHandler = content.text
        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
        for piece in self._pieces(name):
            parser.Parse(piece, False)
        parser.Parse(b"", True)

    def _pieces(self, name: str) -> Iterator[bytes]:
        info = self._archive.getinfo(name)
        if info.flag_bits & ENCRYPTED or info.compress_type not in METHODS:
            raise zipfile.BadZipFile(f"{name} is encrypted or packed in an unusual way")
        with self._archive.open(info) as member:
            while piece := member.read(PIECE):
                self._n_left -= len(piece)
                if self._n_left < 0:
                    raise _TooMuchError(
                        f"unpacks to more than {MOST_XML_BYTES >> 20} MiB of text; no workbook of su3d-bench sheets "
                        "make does"
                    )
                yield piece


def _local(name: str) -> str:
    """A name without its namespace: the strict and the transitional form of the format differ in nothing else here."""
    return name.rpartition(" ")[2]


class _Relations(_Content):
    """The relationships of a part in ``folder``, external ones left out."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self.found: dict[str, _Relation] = {}

    def begin(self, name: str, attributes: Attributes) -> None:
        if name == "Relationship" and attributes.get("TargetMode") != "External":
            kind = attributes.get("Type", "").rpartition("/")[2]
            target = posixpath.normpath(posixpath.join("/", self._folder, attributes.get("Target", ""))).lstrip("/")
            self.found[attributes.get("Id", "")] = _Relation(kind, target)


class _Sheets(_Content):
    """Name and relationship of each sheet."""

    def __init__(self) -> None:
        self.found: list[tuple[str, str]] = []

    def begin(self, name: str, attributes: Attributes) -> None:
        if name == "sheet":
            key = next((value for key, value in attributes.items() if _local(key) == "id"), "")
            self.found.append((attributes.get("name", ""), key))
            if len(self.found) > MOST_SHEETS:
                raise _TooMuchError(f"has more than {MOST_SHEETS} worksheets")


@dataclass
class _Count:
    """How many cells there were so far."""

    n: int = 0

    def one_more(self) -> None:
        self.n += 1
        if self.n > MOST_CELLS:
            raise _TooMuchError(f"has more than {MOST_CELLS} cells or shared texts; a file of answers is smaller")


class _Text:
    """The text in an element of which some children hold text; phonetic guides (``rPh``) are no part of it."""

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.n = 0
        self.is_open = self.is_guide = False

    def begin(self, name: str) -> None:
        self.is_guide |= name == "rPh"
        self.is_open = name in ("t", "v", "f") and not self.is_guide

    def end(self, name: str) -> None:
        self.is_open = False
        if name == "rPh":
            self.is_guide = False

    def add(self, text: str) -> None:
        if self.is_open:
            self.n += len(text)
            if self.n > MOST_CHARACTERS:
                raise _TooMuchError(f"a cell holds more than {MOST_CHARACTERS} characters; a file of answers does not")
            self.parts.append(text)

    def taken(self) -> str:
        """The whole text, which begins anew."""
        text = "".join(self.parts)
        self.parts, self.n = [], 0
        return text


class _Shared(_Content):
    """The texts that cells share."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self._count, self._text = _Count(), _Text()

    def begin(self, name: str, attributes: Attributes) -> None:
        self._text.begin(name)

    def text(self, text: str) -> None:
        self._text.add(text)

    def end(self, name: str) -> None:
        self._text.end(name)
        if name == "si":
            self._count.one_more()
            self.texts.append(self._text.taken())


@dataclass
class _Cells(_Content):
    """The rows of a worksheet; ``shared`` are the texts that its cells share with others."""

    shared: list[str]
    count: _Count
    rows: list[Row] = field(default_factory=list)
    _text: _Text = field(default_factory=_Text)
    _column: int = 0
    _kind: str = "n"
    _formula: str | None = None

    def begin(self, name: str, attributes: Attributes) -> None:
        if name == "row":
            number = _number(attributes.get("r"), self.rows[-1][0] + 1 if self.rows else 1)
            if not 1 <= number <= MOST_ROWS or len(self.rows) == MOST_ROWS:
                raise _TooMuchError(f"has a row {printable(str(number), 20)}; at most {MOST_ROWS} are read")
            self.rows.append((number, []))
            self._column = 0
        elif name == "c":
            self.count.one_more()
            place = REFERENCE.fullmatch(attributes.get("r", ""))
            self._column = self._column + 1 if place is None else _column_of(place[1])
            self._kind, self._formula = attributes.get("t", "n"), None
        else:
            self._text.begin(name)

    def text(self, text: str) -> None:
        self._text.add(text)

    def end(self, name: str) -> None:
        self._text.end(name)
        if name == "f":
            self._formula = f"={self._text.taken()}"
        elif name == "c":
            value = self._value(self._text.taken())
            if self.rows and value is not None and self._column <= MOST_COLUMNS:
                cells = self.rows[-1][1]
                cells += [None] * (self._column - len(cells))
                cells[self._column - 1] = value

    def _value(self, text: str) -> str | None:
        """The text of a cell: of a formula itself, of a number as short as it can be said."""
        if self._formula is not None:
            return self._formula
        if self._kind == "s":
            place = _number(text, -1)
            return self.shared[place] if 0 <= place < len(self.shared) else None
        if self._kind == "b":
            return "TRUE" if text.strip() == "1" else "FALSE"
        if self._kind == "n" and len(text) > 15:
            try:
                return f"{float(text):.15g}"  # as many digits as a spreadsheet shows
            except ValueError:
                return text
        return text or None


def _number(text: str | None, otherwise: int) -> int:
    """A number of at most ten digits, ``otherwise`` where it is none."""
    text = "" if text is None else text.strip()
    return int(text) if text.isascii() and text.isdigit() and len(text) <= 10 else otherwise


def _column_of(letters: str) -> int:
    """The number of a column, from 1 on.

    >>> _column_of("A"), _column_of("AB")
    (1, 28)
    """
    number = 0
    for letter in letters:
        number = number * 26 + ord(letter) - ord("A") + 1
    return number
