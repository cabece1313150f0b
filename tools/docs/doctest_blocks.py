"""A Griffe extension (Griffe reads the code for mkdocstrings) that turns docstring examples into code blocks."""

from __future__ import annotations

from typing import Any

import griffe
from site_text import with_examples


class DoctestBlocks(griffe.Extension):  # type: ignore[misc]
    """Each docstring in the form used by the site."""

    def on_instance(self, *, obj: Any, **rest: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = with_examples(obj.docstring.value)
