"""JSON files of other programs: one pydantic model per format, and one form of message for validation errors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, FailFast, Field, Strict, TypeAdapter, ValidationError

from su3d_bench.core.errors import DataError, printable
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import read_bytes

Content = TypeVar("Content")
MAX_ID, MAX_SEGMENT_ID, MAX_M = 2**31 - 2, 2**32 - 1, 1e6
# Numbers that some programs write as strings.
WholeNumber = Annotated[int, Strict(False), Field(ge=0, le=MAX_ID)]
SegmentIds = Annotated[list[Annotated[int, Strict(False), Field(ge=0, le=MAX_SEGMENT_ID)]], FailFast()]
Metres = Annotated[float, Field(ge=-MAX_M, le=MAX_M)]
Lengths = Annotated[list[Annotated[float, Field(ge=0, le=MAX_M)]], Field(min_length=3, max_length=3)]
Point = Annotated[list[Metres], Field(min_length=3, max_length=3)]


class FileModel(BaseModel):
    """Base class of file models: strict types for the keys that are read; other keys are ignored."""

    model_config = ConfigDict(frozen=True, strict=True)


def checked_json(content: Any, where: str, kind: type[Content], advice: str = "copy the file again") -> Content:
    """``content`` as a ``kind``; raises ``DataError`` with the first invalid key."""
    try:
        value: Content = TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = printable(".".join(map(str, fault["loc"])), 120)
        found = printable(repr(fault["input"])[:200], 40)
        reason = "expected an object" if fault["type"] == "model_type" else fault["msg"].removeprefix("Value error, ")
        raise DataError(f"{where}: {f'{place}: ' if place else ''}{reason}; found {found}; {advice}") from error
    return value


def read_json(path: Path, where: str, kind: type[Content], advice: str = "copy the file again") -> Content:
    """The content of a JSON file as a ``kind``; ``where`` names the file in messages."""
    return checked_json(parsed_json(read_bytes(path, where, advice), where, advice), where, kind, advice)
