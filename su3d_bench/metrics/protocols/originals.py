"""Whose evaluation each protocol repeats, under which licences, and how far both were held against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.metrics.protocols.files import RULES, line_of, read_content, rules_file

Text = Annotated[str, Field(min_length=1, max_length=400)]
_OF_CODE = ("code", "commit", "files", "licence", "compared")


class Original(BaseModel):
    """The table ``[original]`` of a protocol's file.

    ``code`` is a repository of GitHub, as owner/name, whose ``files`` at ``commit`` evaluate; ``licence`` is that of
    the code and ``data`` the terms of what is scored, "none stated" where nobody says. ``compared`` says which numbers
    of both were held against each other, or why none were; ``problems``: how many made ones both answered, no number of
    them farther apart than ``largest_difference``; ``cases``: where some lie with the original's answers, as paths from
    the repository's root or patterns of such. ``none`` says why there is no original, in place of all but ``data``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    none: Text | None = None
    code: Annotated[str, Field(pattern=r"^[\w.-]+/[\w.-]+$")] | None = None
    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{7,40}$")] | None = None
    files: tuple[Text, ...] = ()
    licence: Text | None = None
    data: Text
    compared: Text | None = None
    problems: Annotated[int, Field(ge=0)] = 0
    largest_difference: Annotated[float, Field(ge=0)] | None = None
    cases: tuple[Text, ...] = ()

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        there = [field for field in _OF_CODE if getattr(self, field)]
        if self.none is not None:
            if there or self.problems or self.cases:
                raise ValueError("none: says that there is no original; leave out all else but data")
        elif lacking := [field for field in _OF_CODE if field not in there]:
            raise ValueError(
                f"{lacking[0]}: is missing; give {', '.join(_OF_CODE)}, or none = why there is no original"
            )
        if (self.largest_difference is not None) != (self.problems > 0):
            raise ValueError("largest_difference: belongs to problems that both answered, and these need it")
        return self

    @property
    def place(self) -> str | None:
        """Where the code can be read; None where there is no original."""
        return None if self.code is None else f"https://github.com/{self.code}/tree/{self.commit}"

    @property
    def held_together(self) -> str:
        """What was compared, how many problems both answered, by how much they differ and where cases lie.

        >>> Original(none="ours", data="made by the program").held_together
        ''
        """
        if self.compared is None:
            return ""
        parts = [self.compared]
        if self.largest_difference is not None:
            parts.append(f"{self.problems:,} made problems, largest difference {self.largest_difference:g}")
        if self.cases:
            parts.append(f"cases in {', '.join(self.cases)}")
        return "; ".join(parts)

    @property
    def in_short(self) -> str:
        """Everything in one sentence, for lists."""
        if self.none is not None:
            return f"no original: {self.none}; data: {self.data}"
        of_code = f"{self.code} at {str(self.commit)[:7]}, {', '.join(self.files)}"
        return f"original: {of_code}; code: {self.licence}; data: {self.data}; compared: {self.held_together}"

    @property
    def facts(self) -> dict[str, str]:
        """Everything by what it is called where it is shown, in order, without what is not said."""
        said = {
            "original": f"{self.code} at {self.commit}" if self.none is None else f"none: {self.none}",
            "its files": ", ".join(self.files),
            "licence of its code": self.licence or "",
            "licence of the data": self.data,
            "compared": self.held_together,
        }
        return {name: text for name, text in said.items() if text}


@dataclass(frozen=True)
class Stated:
    """The original that a protocol's file states, or takes over from the protocol called ``base`` that it extends."""

    original: Original
    base: str | None

    @property
    def in_short(self) -> str:
        """As that of the original."""
        told = self.original.in_short
        return told if self.base is None else f"of {self.base}, which these rules extend, {told}"

    @property
    def facts(self) -> dict[str, str]:
        """As those of the original; a protocol that takes it over has rules of its own on top."""
        told = self.original.facts
        return told if self.base is None else {"original of": f"{self.base}, which these rules extend", **told}


def original_of(name: str) -> Stated | None:
    """What the protocol called ``name``, or a file, says of its original; None where a file of one's own says nothing.

    A ``ConfigError`` for a table that is not whole, and for a built-in protocol without one.

    >>> original_of("scannet-instance").original.code
    'ScanNet/ScanNet'
    """
    file = rules_file(name)
    content = read_content(file)
    if content.original is None:
        if RULES in file.parents:
            raise ConfigError(
                f"{file}: the table [original] is missing; it says whose evaluation this is, or none = why"
            )
        return None
    where, table = content.original
    return Stated(read_original(where, table), None if where == file else where.stem)


def read_original(file: Path, table: Mapping[str, Any]) -> Original:
    """The table ``[original]`` of a file, as TOML has it; a ``ConfigError`` of one line where it is none."""
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    try:
        return Original.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_line(file, error)) from error


def _line(file: Path, error: ValidationError) -> str:
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    key = str(first["loc"][0]) if first["loc"] else ""
    if first["type"] == "extra_forbidden":
        return f"{line_of([file], key)}: unknown key 'original.{key}'{suggest(key, Original.model_fields)}"
    if first["type"] == "missing":
        return f"{file}: the key 'original.{key}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    return f"{line_of([file], key)}: original.{key}: {message}" if key else f"{file}: original.{message}"
