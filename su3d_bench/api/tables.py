"""Results of a run, an evaluation or a comparison, as pandas tables and as text for a terminal or notebook."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.api import frames
from su3d_bench.core.arguments import several, typed
from su3d_bench.core.errors import ConfigError, counted, printable, some
from su3d_bench.core.safe_output import terminal_width

if TYPE_CHECKING:
    import pandas

    from su3d_bench.core.maps import Prediction
    from su3d_bench.formats.tables.table import Prose, Table
    from su3d_bench.runs.finished import FinishedRun
    from su3d_bench.store.records import MetricsRecord

MAX_NAMED = 4  # methods and protocols in one line
Place = str | Path
Names = str | Sequence[str]


class Printable(ABC):
    """Base class of results that are shown as tables by ``print`` and in notebooks; ``repr`` is one line."""

    @abstractmethod
    def _line(self) -> str: ...

    @abstractmethod
    def _parts(self) -> Sequence[Table | Prose]: ...

    def __repr__(self) -> str:
        return f"<{printable(self._line())}>"

    def __str__(self) -> str:
        from su3d_bench.reports.tables.formats import plain

        return plain(self._parts(), terminal_width()).rstrip("\n")

    def _repr_html_(self) -> str:
        from su3d_bench.reports.tables.formats import html_tables, safe

        return f"<p><b>{safe(self._line())}</b></p>\n{html_tables(self._parts())}"


class Scores(Printable):
    """The numbers of methods under protocols, as returned by ``evaluate``; those in a folder are a ``Run``.

    All values are fractions in full precision, ``n_...`` are counts, NaN is an undefined value.
    >>> import su3d_bench as su3d
    >>> scores = su3d.evaluate("predictions", ground_truth="truth", protocols="scannet-instance")
    >>> float(scores.metrics.set_index("metric")["value"]["AP50"])
    0.5
    >>> scores
    <Scores: predictions under scannet-instance>
    """

    def __init__(self, metrics: MetricsRecord, remarks: Sequence[str] = ()) -> None:
        self._record = metrics
        self._remarks = tuple(printable(line) for line in remarks)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Lines that must be reported with the numbers: formats, missing scenes, partial runs, and every warning.

        >>> import su3d_bench as su3d
        >>> any("all confidences are 1" in line for line in su3d.load_run("runs/demo").remarks)
        True
        """
        notes = [line for part in self._parts() for line in getattr(part, "notes", ())]
        return tuple(dict.fromkeys((*self._remarks, *map(printable, notes))))

    @property
    def metrics(self) -> pandas.DataFrame:
        """Every value over all scenes, one row per method, protocol and metric, bit-identical to ``metrics.json``.

        Columns: ``method``, ``protocol`` and ``metric`` (string); ``is_headline`` (bool), whether tables show it;
        ``value``, ``low`` and ``high`` of its 95 % confidence interval over scenes, ``ceiling``, the ground-truth
        ceiling (float64, NaN for none); ``n_scenes`` (int64).

        >>> import su3d_bench as su3d
        >>> metrics = su3d.load_run("runs/demo").metrics
        >>> metrics.query("is_headline and method == 'oracle'")["value"].unique().tolist()
        [1.0]
        """
        return frames.metrics_frame(self._record)

    @property
    def scene_metrics(self) -> pandas.DataFrame:
        """Every value of each single scene, one row per method, protocol, scene and metric.

        Columns: ``method``, ``protocol``, ``scene``, ``metric`` (string), ``value`` (float64).

        >>> import su3d_bench as su3d
        >>> su3d.load_run("runs/demo").scene_metrics["scene"].unique().tolist()
        ['rooms/bathroom7']
        """
        return frames.scenes_frame(self._record)

    @property
    def class_metrics(self) -> pandas.DataFrame:
        """Every value of each class over all scenes, one row per method, protocol, class and metric.

        Columns: ``method``, ``protocol``, ``class_name``, ``metric`` (string), ``value`` (float64).

        >>> import su3d_bench as su3d
        >>> classes = su3d.load_run("runs/demo").class_metrics.query("metric == 'AP' and method == 'oracle'")
        >>> float(classes["value"].min())
        1.0
        """
        return frames.classes_frame(self._record)

    def _line(self) -> str:
        methods = dict.fromkeys(result.method for result in self._record.results)
        protocols = dict.fromkeys(result.protocol for result in self._record.results)
        return f"Scores: {some(list(methods), MAX_NAMED)} under {some(list(protocols), MAX_NAMED)}"

    def _parts(self) -> Sequence[Table | Prose]:
        from su3d_bench.formats.tables.table import Prose
        from su3d_bench.reports.tables.run import run_tables
        from su3d_bench.store.records import plain

        remarks = [Prose(self._remarks, is_list=True)] if self._remarks else []
        return [*run_tables(plain(self._record)), *remarks]


class Run(Scores):
    """A finished run: a folder written by ``run``, or by ``evaluate`` with ``out``; it is read-only here.

    ``path`` is the folder, ``scenes``, ``methods`` and ``protocols`` are their names, ``is_complete``: no scene failed.
    ``print(run)`` and notebooks show the tables.

    >>> import su3d_bench as su3d
    >>> run = su3d.load_run("runs/demo")
    >>> run
    <Run runs/demo: complete, 1 scene, opensu3d, oracle under rooms-semantic, rooms-instance>
    >>> run.scenes, run.methods, run.is_complete
    (('rooms/bathroom7',), ('opensu3d', 'oracle'), True)
    """

    @typed
    def __init__(self, path: Place, remarks: Sequence[str] = ()) -> None:
        from su3d_bench.runs.verify import read_checked
        from su3d_bench.store.records import MetricsRecord

        run: FinishedRun = read_checked(Path(path))
        results = tuple(run.results.values())
        super().__init__(
            MetricsRecord(is_partial=run.record.is_partial, limit=run.limit, scenes=run.scenes, results=results),
            list(dict.fromkeys([*_state_of(run), *run.elsewhere_lines(), *run.record.warnings, *remarks])),
        )
        self._run = run
        self.path = run.folder.path
        self.scenes = run.scenes
        self.methods = run.methods
        self.protocols = tuple(run.protocols)
        self.is_complete = not run.is_incomplete

    @property
    def updates(self) -> pandas.DataFrame:
        """The cost of each update, one row per method, scene and update, with every column of the ``updates.csv``.

        Columns: ``method``, ``scene`` (string), ``update`` (int64), ``frame`` (Int64), then float64: sizes (``n_...``,
        ``rss_bytes``), milliseconds of each stage (``..._ms``), of the method and in total; NaN if a method has no
        such column. Methods that use no frames have no rows.

        >>> import su3d_bench as su3d
        >>> updates = su3d.load_run("runs/demo").updates
        >>> updates.query("method == 'opensu3d'")[["update", "frame"]].values.tolist()[:2]
        [[0, 0], [1, 40]]
        """
        from su3d_bench.runs.finished import read_update_times

        return frames.updates_frame([one for method in self.methods for one in read_update_times(self._run, method)])

    @property
    def instances(self) -> pandas.DataFrame:
        """Every predicted and ground-truth instance, for each protocol of masks or points.

        >>> import su3d_bench as su3d
        >>> instances = su3d.load_run("runs/demo").instances
        >>> masks = instances.query("protocol == 'rooms-instance'")
        >>> predicted = masks.query("method == 'oracle' and kind == 'predicted' and is_counted")
        >>> bool((predicted["best_iou"] == 1).all())
        True
        """
        return frames.instances_frame(self._all_instance_rows)

    @cached_property
    def _all_instance_rows(self) -> Any:
        return self._instance_rows()

    @typed
    def select_instances(self, *, methods: Names = (), protocols: Names = (), scenes: Names = ()) -> pandas.DataFrame:
        """The instances of some methods, protocols and scenes: the rows of ``su3d-bench report instances``.

        The ground truth is read again: raises ``DataError`` if the scenes' data is missing (``SU3D_DATA``), and
        ``ConfigError`` for a name that the run does not have, or if there are no instances. ``su3d-bench report
        instances --describe-columns`` describes the columns; boxes are in metres.

        >>> import su3d_bench as su3d
        >>> found = su3d.load_run("runs/demo").select_instances(methods="opensu3d", protocols="rooms-instance")
        >>> found["kind"].unique().tolist()
        ['predicted', 'true']
        """
        chosen = {"methods": methods, "protocols": protocols, "scenes": scenes}
        return frames.instances_frame(self._instance_rows(*(several(name, some) for name, some in chosen.items())))

    def _instance_rows(self, *chosen: tuple[str, ...]) -> Any:
        from su3d_bench.analysis.instances import Selection, instance_rows

        return instance_rows([self.path], Selection(*chosen)).rows

    @property
    def errors(self) -> pandas.DataFrame:
        """The cost of each kind of error for each method, as in ``su3d-bench report attribution``.

        Columns: ``method``, ``protocol``, ``metric`` (string); ``value`` (float64), of the run; ``part`` (string):
        ``error``, ``overlap``, ``rest`` or ``stage``; ``kind`` (string) of the error or the stage; ``n`` (Int64), their
        number; ``gain`` (float64), the increase of the value if only these errors are fixed. For each metric, the value
        and the gains, except those of stages, sum to 1. Only for protocols of kind ``instance`` and ``semantic``;
        raises ``DataError`` if the scenes' data is missing.

        >>> import su3d_bench as su3d
        >>> errors = su3d.load_run("runs/demo").errors.query("method == 'opensu3d' and metric == 'AP'")
        >>> gains = errors.query("part != 'stage'")["gain"].sum()
        >>> round(float(errors["value"].iloc[0] + gains), 12)
        1.0
        """
        return frames.errors_frame(self._attributions)

    @cached_property
    def _attributions(self) -> Any:
        from su3d_bench.analysis.attribution import attribute
        from su3d_bench.metrics.attribution.arrays import EXPLAINED

        wanted = {
            method: [
                name
                for (whose, name), result in self._run.results.items()
                if whose == method and result.kind in EXPLAINED and result.result is not None
            ]
            for method in self.methods
        }
        return [attribute(self.path, method=method, protocols=names) for method, names in wanted.items() if names]

    @typed
    def prediction(self, scene: str, method: str | None = None) -> Prediction:
        """The map of a scene (``Instances``, ``Partition`` or ``DenseFeatures``), points in metres.

        Raises ``StoreError`` if the run has no such map, and ``ConfigError`` if ``method`` is None and the run has
        several methods.

        >>> import su3d_bench as su3d
        >>> prediction = su3d.load_run("runs/demo").prediction("rooms/bathroom7", "oracle")
        >>> prediction.points.shape[1], len(prediction) == len(prediction.labels)
        (3, True)
        """
        from su3d_bench.runs.finished import map_of_scene

        if method is None and len(self.methods) > 1:
            raise ConfigError(f"{self._run.name}: has the methods {', '.join(self.methods)}; name one of them")
        return map_of_scene(scene, method or self.methods[0], self.path)[2]

    @typed
    def compare(
        self,
        other: Run | Place,
        *,
        method: str | None = None,
        other_method: str | None = None,
        protocols: Names = (),
        per_class: bool = False,
    ) -> Comparison:
        """Compare this run with ``other``, as ``su3d-bench compare``: differences are other - this.

        Methods of the same name are compared, or ``method`` with ``other_method`` (default: the same). Raises
        ``ConfigError`` if the two cannot be compared, with the first difference.

        >>> import su3d_bench as su3d
        >>> run = su3d.load_run("runs/demo")
        >>> compared = run.compare(run, method="opensu3d", other_method="oracle", protocols="rooms-instance")
        >>> compared.differences["metric"].tolist(), bool((compared.differences["difference"] > 0).all())
        (['AP', 'AP50', 'AP25'], True)
        """
        from su3d_bench.analysis.comparison import compare

        place = other.path if isinstance(other, Run) else Path(other)
        sides = [
            str(folder) if name is None else f"{folder}:{name}"
            for folder, name in ((self.path, method), (place, other_method or method))
        ]
        return Comparison(compare(*sides, protocols=several("protocols", protocols), per_class=per_class).to_json())

    def _line(self) -> str:
        state = "complete" if self.is_complete else self._run.record.status
        partial = ", PARTIAL" if self._run.record.is_partial else ""
        what = f"{some(self.methods, MAX_NAMED)} under {some(self.protocols, MAX_NAMED) or 'no protocol'}"
        return f"Run {self._run.name}: {state}{partial}, {counted(len(self.scenes), 'scene')}, {what}"


class Comparison(Printable):
    """The comparison of two runs, from ``Run.compare``; ``remarks`` must be reported with the differences.

    >>> import su3d_bench as su3d
    >>> run = su3d.load_run("runs/demo")
    >>> run.compare(run, method="opensu3d", other_method="oracle")
    <Comparison: runs/demo and runs/demo: opensu3d and oracle>
    """

    def __init__(self, comparison: dict[str, Any]) -> None:
        self._comparison = comparison
        own = [line for protocol in comparison["protocols"] for line in protocol["remarks"]]
        self.remarks = tuple(printable(line) for line in dict.fromkeys([*comparison["remarks"], *own]))

    @property
    def differences(self) -> pandas.DataFrame:
        """One row per protocol and metric, and with ``per_class`` one row per class.

        Columns: ``protocol``, ``left``, ``right``, the methods, ``class_name``, empty for all classes, ``metric``
        (string); ``value_left``, ``value_right``, ``difference``, right - left, ``low`` and ``high`` of its 95 %
        confidence interval, ``p`` of the exact test over scenes, ``p_of_all`` corrected for all comparisons (float64,
        NaN for none); ``n_scenes`` in common (int64).

        >>> import su3d_bench as su3d
        >>> run = su3d.load_run("runs/demo")
        >>> run.compare(run, method="opensu3d", other_method="oracle").differences.columns[:3].tolist()
        ['protocol', 'left', 'right']
        """
        return frames.differences_frame(self._comparison)

    def _line(self) -> str:
        pairs = dict.fromkeys(f"{one['left']} and {one['right']}" for one in self._comparison["protocols"])
        return f"Comparison: {self._comparison['left']} and {self._comparison['right']}: {some(list(pairs), MAX_NAMED)}"

    def _parts(self) -> Sequence[Table | Prose]:
        from su3d_bench.reports.tables.comparison import comparison_tables

        return comparison_tables(self._comparison)


def _state_of(run: FinishedRun) -> list[str]:
    lines = []
    if run.record.is_partial:
        lines.append(f"PARTIAL: only the first {counted(run.limit, 'frame')} of each scene")
    if run.is_incomplete:
        lines.append("INCOMPLETE: scenes that failed are not in these numbers")
    return lines


@typed
def load_run(path: Place) -> Run:
    """The finished run in the folder ``path``, which is not changed.

    Raises ``StoreError`` if the folder has no run, or an unfinished one.

    >>> import su3d_bench as su3d
    >>> su3d.load_run("runs/demo").protocols
    ('rooms-semantic', 'rooms-instance')
    >>> su3d.load_run("runs/none")
    Traceback (most recent call last):
    su3d_bench.core.errors.StoreError: runs/none: contains no run.json; name the folder of a run, such as runs/my-run
    """
    return Run(path)
