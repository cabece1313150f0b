"""What can be run: the datasets with their available scenes, and the methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError, ScenesMissing, Su3dError, counted


def known_datasets(names: Sequence[str], root: Path) -> list[dict[str, Any]]:
    """A description of each named dataset (all if none is named), with its scenes below ``root``.

    A dataset may list the folders it searches (``places``) and the state of a scene (``status``).
    """
    return [_dataset(name, registry.load("dataset", name), root) for name in names or registry.names("dataset")]


def _dataset(name: str, dataset_class: Any, root: Path) -> dict[str, Any]:
    from su3d_bench.core.interfaces import ListsFolders

    dataset = dataset_class(root, dataset_class.Options())
    row: dict[str, Any] = {
        "name": name,
        "summary": (dataset_class.__doc__ or "").strip().partition("\n")[0].replace("`", ""),
        "places": [str(place) for place in (dataset.places() if isinstance(dataset, ListsFolders) else ())],
        "ground_truth": list(dataset_class.variants),
        "scenes": [],
        "error": None,
        "is_missing": False,
    }
    try:
        row["scenes"] = [{"scene": f"{name}/{scene}", "status": _status(dataset, scene)} for scene in dataset.scenes()]
    except DataError as error:
        row |= {"error": str(error), "is_missing": isinstance(error, ScenesMissing)}
    return row


def _status(dataset: Any, scene: str) -> str:
    from su3d_bench.core.interfaces import HasStatus

    try:
        if isinstance(dataset, HasStatus):
            return str(dataset.status(scene))
        return counted(dataset.info(scene, 1).n_frames, "frame")
    except Su3dError as error:
        return str(error)


def known_methods() -> list[dict[str, Any]]:
    """A description of every method that can be run by its name."""
    return [about_method(name, registry.load("method", name)) for name in registry.names("method")]


def about_method(name: str, method: Any) -> dict[str, Any]:
    """The description of a method in a list; a plug-in only needs the first sentence of its docstring."""
    row: dict[str, Any] = {"name": name, "summary": (method.__doc__ or "").strip().partition("\n")[0]}
    about = getattr(method, "about", None)
    for field in ("paper", "source", "licence", "status"):
        row[field] = getattr(about, field, None) or None
    row["needs"] = list(getattr(about, "needs", ()))
    return row
