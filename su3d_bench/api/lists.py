"""The available datasets, methods and protocols, as pandas tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

from su3d_bench.api.frames import TEXT, TRUTH, WHOLE, frame
from su3d_bench.api.tables import Names
from su3d_bench.core.arguments import several

if TYPE_CHECKING:
    import pandas


def list_datasets(names: Names = ()) -> pandas.DataFrame:
    """The datasets and their available scenes, one row per scene; a dataset without scenes has one row without a scene.

    Columns: ``dataset``, ``scene``, the address for ``run``, ``state``, the number of frames or the problem,
    ``summary`` of the dataset (string); ``is_available`` (bool). Raises ``ConfigError`` for an unknown name.

    >>> import su3d_bench as su3d
    >>> scenes = su3d.list_datasets("rooms")
    >>> scenes["scene"][0], bool(scenes["is_available"].all())
    ('rooms/living0', True)
    """
    from su3d_bench.runs.catalogue import known_datasets
    from su3d_bench.runs.scenes import data_root

    rows: list[tuple[object, ...]] = []
    for one in known_datasets(several("names", names), data_root()):
        rows += [(one["name"], scene["scene"], scene["status"], one["summary"], True) for scene in one["scenes"]]
        if not one["scenes"]:
            rows.append((one["name"], "", one["error"] or "has no scene", one["summary"], False))
    columns = {"dataset": TEXT, "scene": TEXT, "state": TEXT, "summary": TEXT, "is_available": TRUTH}
    return frame(columns, rows)


def list_methods() -> pandas.DataFrame:
    """The methods that can be run by name: ``name``, ``summary``, ``paper``, ``source``, ``licence``, ``status`` and
    ``needs``, separated by commas (string, empty for none).

    >>> import su3d_bench as su3d
    >>> "opensu3d" in su3d.list_methods()["name"].tolist()
    True
    """
    from su3d_bench.runs.catalogue import known_methods

    columns = dict.fromkeys(("name", "summary", "paper", "source", "licence", "status", "needs"), TEXT)
    rows = [[", ".join(one[key]) if key == "needs" else one[key] or "" for key in columns] for one in known_methods()]
    return frame(columns, rows)


def list_protocols() -> pandas.DataFrame:
    """The built-in protocols: ``name``, ``summary``, ``kind``, ``datasets`` and ``headline`` metrics, separated by
    commas, ``label_space``, ``original`` (string), ``version`` (int64). ``load_protocol`` returns all rules of one.

    ``original`` is the repository and commit whose evaluation it reproduces, or "none: " and the reason; ``su3d-bench
    protocols show`` reports what was compared, and the differences.

    >>> import su3d_bench as su3d
    >>> protocols = su3d.list_protocols().set_index("name")
    >>> protocols.loc["rooms-instance", "headline"]
    'AP, AP50, AP25'
    """
    from su3d_bench.metrics.protocols.loading import load_protocol, original_of, protocol_names

    columns = dict.fromkeys(("name", "summary", "kind", "datasets", "headline", "label_space", "original"), TEXT)
    rows = []
    for name in protocol_names():
        one, stated = load_protocol(name), original_of(name)
        lists = (", ".join(one.datasets), ", ".join(one.headline))
        original = stated.facts["original"] if stated is not None else ""
        rows.append((one.name, one.summary, one.kind, *lists, one.label_space or "", original, one.version))
    return frame({**columns, "version": WHOLE}, rows)
