"""Files of a repository on Hugging Face's hub: which there are, and what the hub states of each.

``huggingface_hub`` is asked for names, sizes and checksums of one revision; the bytes come as those of any server do:
bounded, resumed, checked against what was stated. No token of the user's is sent.
"""

from __future__ import annotations

import os
from typing import Any
from urllib.parse import urlsplit

from su3d_bench.core.errors import ConfigError, DataError, printable
from su3d_bench.core.system.devices import require
from su3d_bench.fetching.download import Stated, Wanted
from su3d_bench.fetching.sources import Source, check_address

HUB = "https://huggingface.co"
TIMEOUT_S = 30.0


def hub_files(source: Source) -> list[Wanted]:
    """The files that ``source`` names, of the revision that ``main`` stands for just now, the weights last.

    Raises ``ModelMissing`` without ``huggingface_hub``, ``ConfigError`` where the user keeps it from asking, and
    ``DataError`` where the hub does not answer or lacks a file.
    """
    assert source.hub is not None
    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
    hub = require("huggingface_hub", f"fetch {source.name}")
    constants = require("huggingface_hub.constants", f"fetch {source.name}")
    endpoint = _endpoint(source)
    hosts = source.hosts if endpoint == HUB else (*source.hosts, urlsplit(endpoint).hostname or "")
    try:
        check_address(endpoint)
    except ValueError as error:
        raise ConfigError(f"HF_ENDPOINT: {error}") from error
    if constants.HF_HUB_OFFLINE:
        raise ConfigError(f"fetch {source.name}: HF_HUB_OFFLINE is set, so nobody is asked; unset it to fetch")
    repository = source.hub.repository
    info = _info(hub, endpoint, repository)
    stated = {file.rfilename: file for file in info.siblings or ()}
    names = _names(source, stated)
    known = {weights.name: weights for weights in source.hub.weights}
    wanted = []
    for name in names:
        file, ours = stated[name], known.get(name)
        sha256 = None if file.lfs is None else str(file.lfs.sha256)
        if ours is not None and None not in (ours.sha256, sha256) and ours.sha256 != sha256:
            raise DataError(
                f"{endpoint}/{repository}: states SHA-256 {printable(str(sha256), 80)} of {name}, known is "
                f"{ours.sha256}: the file was changed; name its facts with --sources if that is as it should be"
            )
        n_bytes = file.size if ours is None or file.size is not None else ours.n_bytes
        checksums = Stated(sha256=sha256, git_blob=None if sha256 else file.blob_id)
        address = hub.hf_hub_url(repository, name, revision=info.sha, endpoint=endpoint)
        wanted.append(Wanted(name, address, hosts, n_bytes, checksums))
    return wanted


def _info(hub: Any, endpoint: str, repository: str) -> Any:
    try:
        info = hub.HfApi(endpoint=endpoint, token=False).model_info(repository, files_metadata=True, timeout=TIMEOUT_S)
    except Exception as error:  # of HTTP, of JSON, of what a server left out: the library gives them no class in common
        if isinstance(error, MemoryError):
            raise
        reason = printable(str(error).split("\n")[0], 200) or type(error).__name__
        raise DataError(f"{endpoint}/{repository}: the hub does not say what is there: {reason}") from error
    if not isinstance(info.sha, str) or not info.sha.isalnum():
        raise DataError(f"{endpoint}/{repository}: the hub names no revision; name another with --mirror")
    return info


def _names(source: Source, stated: Any) -> list[str]:
    """What is to be brought: of each requirement the first alternative that is there whole, weights last."""
    assert source.hub is not None
    chosen: list[str] = []
    for requirement in source.hub.files:
        parts = [[name.strip() for name in part.split("+")] for part in requirement.split("|")]
        there = next((names for names in parts if all(name in stated for name in names)), None)
        if there is None:
            said = requirement.replace(" | ", " or ").replace(" + ", " and ")
            raise DataError(f"hub repository {source.hub.repository}: has no {said}; name another with --mirror")
        chosen += there
    settings = [*chosen[1:], *(name for name in source.hub.optional if name in stated)]
    return [*dict.fromkeys(name for name in settings if name != chosen[0]), chosen[0]]


def hub_addresses(source: Source) -> list[str]:
    """Where the files lie, as far as that can be said without asking which of the alternatives are there."""
    assert source.hub is not None
    first = [name.strip() for requirement in source.hub.files for name in requirement.split("|")[0].split("+")]
    names = dict.fromkeys((*first, *source.hub.optional))
    return [f"{_endpoint(source)}/{source.hub.repository}/resolve/main/{name}" for name in names]


def _endpoint(source: Source) -> str:
    return source.endpoint or os.environ.get("HF_ENDPOINT", "").rstrip("/") or HUB
