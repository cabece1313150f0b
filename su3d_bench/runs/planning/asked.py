"""What is asked of a run, by flags or from Python, as its settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from su3d_bench.core.config import KeyPath, Setting, Settings, read_file


def asked_settings(
    values: Mapping[str, Any], *, device: str | None, config: Path | None, source_of: Callable[[str], str]
) -> Settings:
    """The settings of the file ``config``, then those of ``values``, which win; None stands for what was not asked.

    ``values`` are by key of a run, ``source_of`` says of a key where it was asked, which begins an error's line.
    """
    settings = Settings() if config is None else read_file(config)
    given: list[tuple[KeyPath, Any]] = [((name,), value) for name, value in values.items()]
    given.append((("perception", "models", "device"), device))
    return settings + Settings(
        tuple(Setting(path, value, source_of(path[-1])) for path, value in given if value is not None)
    )
