"""Files that hold rows of every scene of a folder: the rows of a made scene join them when the scene is whole."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import StoreError, printable
from su3d_bench.core.files.atomic import json_text, remove_file, write_json, write_text
from su3d_bench.core.system.files import file_text


@dataclass(frozen=True)
class JoinedList:
    """A JSON file at ``place``: a list of rows, or an object with one under ``list_key``.

    A row says under ``scene_key`` which scene it is of, as ``name_of`` has it from the scene's name in the layout.
    ``staged``: where the rows of a scene stand while it is built.
    """

    staged: str
    place: Path
    scene_key: str
    list_key: str = ""
    name_of: Callable[[str], str] = str

    def stage(self, folder: Path, rows: Sequence[dict[str, Any]]) -> None:
        """Keep the rows of the scene that is built in ``folder``."""
        write_json(folder / self.staged, list(rows))

    def has(self, scene: str) -> bool:
        """Whether the file has a row of the scene."""
        return self.place.is_file() and self.name_of(scene) in self._scenes(self._rows())

    def check_is_ours(self, made: Collection[str]) -> None:
        """A ``StoreError`` where the file has rows of other scenes than those that were ``made`` here."""
        if self.place.exists() and (strange := self._scenes(self._rows()) - {self.name_of(scene) for scene in made}):
            raise StoreError(
                f"{self.place}: has '{printable(min(strange), 60)}' and was made elsewhere; choose another folder with "
                "--out"
            )

    def join(self, folder: Path, scene: str) -> None:
        """Put the rows that are staged in ``folder`` in the place of those of the scene."""
        name, staged = self.name_of(scene), folder / self.staged
        others = [row for row in self._rows() if row[self.scene_key] != name] if self.place.exists() else []
        rows = sorted([*others, *json.loads(file_text(staged))], key=lambda row: str(row[self.scene_key]))
        self.place.parent.mkdir(parents=True, exist_ok=True)
        write_text(self.place, json_text({self.list_key: rows} if self.list_key else rows))
        remove_file(staged)

    def _scenes(self, rows: Sequence[dict[str, Any]]) -> set[str]:
        return {str(row[self.scene_key]) for row in rows}

    def _rows(self) -> list[dict[str, Any]]:
        try:
            content = json.loads(file_text(self.place))
            rows = content[self.list_key] if self.list_key else content
            known = [dict(row) for row in rows if row[self.scene_key] is not None]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise StoreError(
                f"{self.place}: is no list of scenes ({printable(str(error), 80)}); delete it, or choose another "
                "folder with --out"
            ) from error
        return known
