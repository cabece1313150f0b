"""An extension of Griffe, which reads the code for mkdocstrings: examples in docstrings are blocks of code."""

from __future__ import annotations

from typing import Any

import griffe
from site_text import with_examples


class DoctestBlocks(griffe.Extension):  # type: ignore[misc]
    """Each docstring as the site wants it."""

    def on_instance(self, *, obj: Any, **rest: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = with_examples(obj.docstring.value)
