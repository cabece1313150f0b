"""The table of what can be fetched: addresses, sizes, checksums, licences, and where each of these was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.system.files import file_text, parse_toml

Group = Literal["models", "replica", "scannet"]
TABLE = Path(__file__).with_name("sources.toml")
LOOPBACK = ("localhost", "127.0.0.1", "::1")
MAX_BYTES = 1 << 44  # of one file; the largest release of the field has 2**41
Text = Annotated[str, Field(min_length=1, max_length=400)]
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}$")]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Bytes = Annotated[int, Field(ge=0, le=MAX_BYTES)]


def check_address(address: str, hosts: Sequence[str] | None = None) -> None:
    """``ValueError`` where bytes of ``address`` could be changed on their way, or its host is none of ``hosts``.

    ``*.hf.co`` among ``hosts`` stands for every host whose name ends so.

    >>> check_address("http://127.0.0.1:8000/a"), check_address("https://us.cdn.hf.co/a", ["*.hf.co"])
    (None, None)
    """
    try:
        parts = urlsplit(address)
        host, _ = parts.hostname or "", parts.port
    except ValueError as error:
        raise ValueError(f"'{address}' is no address: {error}") from error
    if not host or parts.scheme not in ("http", "https") or not address.isascii() or not address.isprintable():
        raise ValueError(f"'{address}' is no address; expected https://HOST/...")
    if parts.username or parts.password:
        raise ValueError(f"an address with a name or password in it: '{host}'; leave them out")
    if parts.scheme == "http" and host not in LOOPBACK:
        raise ValueError(f"'{address}' is not encrypted, so anybody on the way may change what comes; use https")
    if hosts is not None and not any(host == name or (name[:2] == "*." and host.endswith(name[1:])) for name in hosts):
        raise ValueError(f"host '{host}' is not named for it ({', '.join(hosts) or 'none is'})")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Licence(_Strict):
    """The terms that come with a source; ``signed_with``: to whom they must be sent signed before anything is given."""

    name: Text
    address: Text
    read_at: Text
    signed_with: Text | None = None


class RemoteFile(_Strict):
    """One file; ``md5_prefix`` is what a publisher writes of an MD5 into the file's name. Sizes in bytes."""

    name: FileName
    address: Text
    n_bytes: Bytes | None = None
    sha256: Sha256 | None = None
    md5_prefix: Annotated[str, Field(pattern=r"^[0-9a-f]{6,32}$")] | None = None
    read_at: Text

    @field_validator("address")
    @classmethod
    def _is_safe(cls, address: str) -> str:
        check_address(address)
        return address


class HubWeights(_Strict):
    """What is known beforehand of a file of weights on the hub; the hub itself states both when it is asked."""

    name: FileName
    n_bytes: Bytes
    sha256: Sha256 | None = None
    read_at: Text


class HubFiles(_Strict):
    """Files of a repository on Hugging Face's hub.

    An entry of ``files`` such as ``tokenizer.json | vocab.json + merges.txt`` names alternatives, the preferred one
    first; ``optional`` are taken where they are there.
    """

    repository: Annotated[str, Field(pattern=r"^[\w.-]+/[\w.-]+$")]
    files: Annotated[tuple[Text, ...], Field(min_length=1)]
    optional: tuple[FileName, ...] = ()
    weights: tuple[HubWeights, ...] = ()
    read_at: Text


class SceneCounts(_Strict):
    """How many scenes and frames a source of recordings has in all."""

    n_scenes: Annotated[int, Field(ge=1, le=1_000_000)]
    n_frames: Annotated[int, Field(ge=1, le=MAX_BYTES)]
    read_at: Text


class Source(_Strict):
    """One thing that can be fetched: ``files`` or a repository of the ``hub``, from ``hosts`` alone.

    ``about_bytes`` is a size that was told in round numbers; ``archive`` what the files are, one after another;
    ``scenes`` what recordings there are in it.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,59}$")]
    group: Group
    what: Text
    licence: Licence
    hosts: tuple[Text, ...]
    archive: Literal["zip", "tar.gz"] | None = None
    about_bytes: Bytes | None = None
    about_read_at: Text | None = None
    files: tuple[RemoteFile, ...] = ()
    hub: HubFiles | None = None
    scenes: SceneCounts | None = None
    endpoint: Text | None = None  # of the hub, where a mirror was named

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if (self.hub is not None) + bool(self.files) != (self.group != "scannet"):
            raise ValueError(f"{self.name}: give either files or hub (scannet: neither)")
        if self.archive == "zip" and len(self.files) != 1:
            raise ValueError(f"{self.name}: a zip archive is one file")
        if len({file.name for file in self.files}) < len(self.files):
            raise ValueError(f"{self.name}: two files of one name")
        for file in self.files:
            check_address(file.address, self.hosts)
        return self

    @property
    def n_bytes(self) -> int | None:
        """What is to be brought here, as far as it is known without asking; None where nobody states it."""
        if self.hub is not None:
            return sum(file.n_bytes for file in self.hub.weights) or self.about_bytes
        sizes = [file.n_bytes for file in self.files if file.n_bytes is not None]
        return sum(sizes) if sizes and len(sizes) == len(self.files) else self.about_bytes

    @property
    def is_exact(self) -> bool:
        """Whether ``n_bytes`` holds to the byte."""
        return bool(self.files) and all(file.n_bytes is not None for file in self.files)

    def mirrored(self, address: str) -> Source:
        """The same files out of the folder ``address`` of another server; for the hub, another endpoint."""
        check_address(address)
        hosts = (urlsplit(address).hostname or "",)
        if self.hub is not None:  # mirrors of the hub leave large files in its own store
            return self.model_copy(update={"endpoint": address.rstrip("/"), "hosts": (*self.hosts, *hosts)})
        files = tuple(file.model_copy(update={"address": f"{address.rstrip('/')}/{file.name}"}) for file in self.files)
        return self.model_copy(update={"files": files, "hosts": hosts})


class _Table(_Strict):
    sources: Annotated[tuple[Source, ...], Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [source.name for source in self.sources]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"two sources are called '{twice}'")
        return self


@dataclass(frozen=True)
class Sources:
    """Every source by its name."""

    entries: dict[str, Source]

    def of(self, group: Group) -> tuple[Source, ...]:
        return tuple(source for source in self.entries.values() if source.group == group)

    def named(self, name: str, group: Group | None = None) -> Source:
        """The source called ``name``; ``ConfigError`` for any other name."""
        known = [source.name for source in self.entries.values() if group in (None, source.group)]
        if name not in known:
            raise ConfigError(f"nothing called '{name}' can be fetched{suggest(name, known)}")
        return self.entries[name]


@cache
def built_in() -> Sources:
    """The table that comes with the program."""
    return Sources({source.name: source for source in _read(TABLE)})


def load_sources(own: Path | None = None, mirrors: Sequence[str] = ()) -> Sources:
    """The table with the entries of the file ``own`` in place of those of their names, and ``NAME=URL`` of ``mirrors``.

    Raises ``ConfigError`` for a name that is none of the table's, and for an address that cannot be trusted.
    """
    sources = dict(built_in().entries)
    for source in _read(own) if own is not None else ():
        group = built_in().named(source.name).group
        if source.group != group:
            raise ConfigError(f"{own}: {source.name}: group = '{source.group}'; it is '{group}'")
        sources[source.name] = source
    for mirror in mirrors:
        name, equals, address = mirror.partition("=")
        if not equals:
            raise ConfigError(f"--mirror '{mirror}': expected NAME=URL, such as sam-vit-h=https://example.org/sam")
        source = Sources(sources).named(name)
        try:
            sources[name] = source.mirrored(address)
        except ValueError as error:
            raise ConfigError(f"--mirror {name}: {error}") from error
    return Sources(sources)


def _read(path: Path) -> tuple[Source, ...]:
    try:
        return _Table.model_validate(parse_toml(file_text(path))).sources
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ConfigError(f"{path}: {where}: {str(first['msg']).removeprefix('Value error, ')}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: is no TOML: {error}") from error
