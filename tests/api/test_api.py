"""The public Python API: all docstring examples, tables equal to the files, one-line errors."""

from __future__ import annotations

import doctest
import inspect
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted_runs import see_painted
from places import ROOT, SCENES
from pydantic import BaseModel

import su3d_bench as su3d
from su3d_bench.cli.main import main
from su3d_bench.core.errors import RunIncomplete

SMALL = {"rooms.n_frames": 80, "rooms.width": 160, "rooms.height": 120}
PAINTED, COLLECTOR = f"{SCENES}/painted.py:Painted", f"{SCENES}/painted.py:Collector"
BOTH = ["rooms-semantic", "rooms-instance"]


def documented() -> Iterator[tuple[str, Any]]:
    """Every public name, and the public members of the result classes."""
    for name in su3d.__all__:
        value = getattr(su3d, name)
        yield name, value
        if inspect.isclass(value) and value.__module__ == "su3d_bench.api.tables":
            for inner, member in vars(value).items():
                if not inner.startswith("_") and (callable(member) or isinstance(member, property)):
                    yield f"{name}.{inner}", member


DOCUMENTED = dict(documented())


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, rooms_data: Path) -> Path:
    """A folder with the data of the examples: a run of a small room, predictions and their ground truth."""
    folder = tmp_path_factory.mktemp("api")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("SU3D_DATA", str(rooms_data))
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        methods = ["opensu3d", "oracle"]
        su3d.run("rooms/bathroom7", methods, protocols=BOTH, settings=SMALL, pictures=False, jobs=1, out="runs/demo")
        truth = np.repeat([5001, 5002], 200)
        for name in ("truth", "predictions/masks"):
            Path(name).mkdir(parents=True)
        np.savetxt("truth/scene0000_00.txt", truth, "%d")
        np.savetxt("predictions/masks/0.txt", truth == 5001, "%d")
        Path("predictions/scene0000_00.txt").write_text("masks/0.txt 5 0.9\n")
    return folder


@pytest.fixture
def here(place: Path, rooms_data: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(place)
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(place / "cache"))
    return place


@pytest.mark.parametrize("name", DOCUMENTED)
def test_each_public_name_has_a_running_example(name: str, here: Path) -> None:
    (found,) = doctest.DocTestFinder(recurse=False).find(DOCUMENTED[name], name, globs={})
    assert found.examples, f"{name}: its docstring has no example"
    ran = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(found)
    assert ran.failed == 0


def test_python_page_runs_as_one_script(rooms_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    blocks = (ROOT / "docs" / "python.md").read_text().split("```python\n")[1:]
    assert len(blocks) == 4
    (tmp_path / "page.py").write_text("\n".join(block.partition("```")[0] for block in blocks))
    done = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "rooms-instance (version" in done.stdout and "missed" in done.stdout


# tables


@pytest.fixture(scope="module")
def painted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two methods over four painted scenes, from the command line; one misses an object in each."""
    folder = tmp_path_factory.mktemp("painted") / "run"
    words = ["run", "--scenes", f"{PAINTED}/*", "--methods", COLLECTOR, "oracle", "--protocols", *BOTH]
    words += ["--set", "collector.drop=1"]
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main([*words, "--jobs", "1", "--no-pictures", "--quiet", "--out", str(folder)]) == 0
        yield folder


def test_metric_tables_equal_metrics_json(painted: Path) -> None:
    run = su3d.load_run(painted)
    results = json.loads((painted / "metrics.json").read_text())["results"]
    metrics = run.metrics.set_index(["method", "protocol", "metric"])
    scenes = run.scene_metrics.set_index(["method", "protocol", "scene", "metric"])["value"]
    classes = run.class_metrics.set_index(["method", "protocol", "class_name", "metric"])["value"]
    n = {"metrics": 0, "per_scene": 0, "per_class": 0}
    for result in results:
        where, numbers = (result["method"], result["protocol"]), result["result"]
        for metric, value in numbers["metrics"].items():
            row = metrics.loc[(*where, metric)]
            interval = numbers["intervals"].get(metric) or (None, None)
            known = np.array([value, *interval, result["ceiling"].get(metric)], float)
            np.testing.assert_array_equal(row[["value", "low", "high", "ceiling"]].astype(float), known)
            assert row["n_scenes"] == len(numbers["scenes"])
            assert row["is_headline"] == (metric in result["headline"])
            n["metrics"] += 1
        for kind, table in (("per_scene", scenes), ("per_class", classes)):
            for inner, values in numbers[kind].items():
                for metric, value in values.items():
                    np.testing.assert_array_equal(table.loc[(*where, inner, metric)], np.array(value, float))
                    n[kind] += 1
    assert (len(metrics), len(scenes), len(classes)) == tuple(n.values())
    assert min(n.values()) > 0


def test_updates_table_equals_every_updates_csv(painted: Path) -> None:
    run = su3d.load_run(painted)
    updates = run.updates
    for scene in run.scenes:
        file = painted / "scenes" / scene.replace("/", ".") / "collector" / "updates.csv"
        names, *lines = (line.split(",") for line in file.read_text().splitlines())
        own = updates.query("scene == @scene and method == 'collector'")
        np.testing.assert_array_equal(own[names].to_numpy(float), np.array(lines, float))
    assert str(updates["update"].dtype) == "int64" and str(updates["total_ms"].dtype) == "float64"


def test_errors_table_equals_the_attribute_command(painted: Path, tmp_path: Path) -> None:
    words = ["report", "attribution", str(painted), "--method", "collector"]
    assert main([*words, f"--json={tmp_path / 'errors.json'}"]) == 0
    errors = su3d.load_run(painted).errors
    own = errors[errors["method"] == "collector"].set_index(["protocol", "metric", "part", "kind"]).sort_index()
    for protocol in json.loads((tmp_path / "errors.json").read_text())["protocols"]:
        for metric, value in protocol["values"].items():
            rows = own.loc[(protocol["protocol"], metric)]
            assert set(rows["value"]) == {value}
            for kind, cause in protocol["causes"].items():
                row = rows.loc[("error", kind)]
                assert (row["n"], row["gain"]) == (cause["n"], cause["gains"][metric])
            assert value + rows.drop("stage", level="part")["gain"].sum() == pytest.approx(1, abs=1e-12)


def test_evaluated_run_has_the_numbers_of_the_evaluation(here: Path) -> None:
    scores = su3d.evaluate("predictions", ground_truth="truth", protocols="scannet-instance")
    run = su3d.evaluate("predictions", ground_truth="truth", protocols="scannet-instance", out="runs/again")
    assert type(scores) is su3d.Scores and isinstance(run, su3d.Run)
    assert scores.metrics.drop(columns="method").equals(run.metrics.drop(columns="method"))
    assert any("format: " in line for line in scores.remarks)
    assert any(line.startswith("again: external predictions") for line in run.remarks)
    found = run.instances
    assert found[["kind", "error", "is_hit_50"]].values.tolist() == [
        ["predicted", "", True], ["true", "", True], ["true", "missed", False]
    ]  # fmt: skip
    assert found["centre_x_m"].isna().all(), "files of truth say nothing of places"


# display


def test_terminal_and_notebook_show_escaped_tables(painted: Path) -> None:
    run = su3d.Run(painted, ["<script>alert(1)</script> \x1b[31m"])
    assert "collector" in str(run) and "\x1b" not in str(run) + repr(run)
    page = run._repr_html_()
    assert "<table>" in page and "&lt;script&gt;" in page and "<script>" not in page and "\x1b" not in page


# running


def test_script_without_main_guard_starts_workers_and_runs_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import su3d_bench as su3d\n"
        "print('begun')\n"
        f"run = su3d.run(['{PAINTED}/a', '{PAINTED}/b'], 'oracle', profile='oracle', jobs=2, pictures=False, "
        "protocols='rooms-instance', out='run')\n"
        "print(__file__, run.is_complete, len(run.scenes))\n"
    )
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.splitlines() == ["begun", f"{script} True 2"], done.stderr


def test_failed_scenes_raise_an_error_and_the_others_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    see_painted(monkeypatch)
    events = list[str]()
    with pytest.raises(RunIncomplete, match=r"1 of 2 scenes failed, the first with: .*frame 2 is missing.*load_run"):
        su3d.run(
            [f"{PAINTED}/a", f"{PAINTED}/b"],
            COLLECTOR,
            protocols=BOTH,
            jobs=1,
            pictures=False,
            settings={"painted.fault": "missing-frame"},
            out=tmp_path / "run",
            report=lambda event: events.append(event.unit),
        )
    run = su3d.load_run(tmp_path / "run")
    assert not run.is_complete and any(line.startswith("INCOMPLETE") for line in run.remarks)
    assert run.scene_metrics["scene"].unique().tolist() == ["painted/a"]
    assert {"painted/a", "painted/b"} <= set(events)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: su3d.run("rooms/none9"), "no scene matches 'rooms/none9'"),
        (lambda: su3d.run("rooms/living0", stride=-1), r"run\(stride=...\): stride = -1"),
        (
            lambda: su3d.run("rooms/living0", settings={"opensu3d.top_m": object()}),
            r"run\(settings=...\): no TOML form",
        ),
        (lambda: su3d.run("rooms/living0", into="other"), "run: into is 'other'; expected one of 'own', 'extend'"),  # type: ignore[arg-type]
        (lambda: su3d.evaluate({}, ground_truth="truth"), "no predictions; pass a folder"),
        (lambda: su3d.evaluate("x", ground_truth="t", confidences="files"), "confidences is 'files'; expected one of"),  # type: ignore[call-overload]
        (lambda: su3d.evaluate("x", datset="rooms"), "evaluate: got an unexpected keyword argument 'datset'"),  # type: ignore[call-overload]
        (lambda: su3d.run("rooms/living0", su3d), "methods: expected a name, a path or several, not <module"),  # type: ignore[arg-type]
        (lambda: su3d.run("rooms/living0", dict), "'Config' is missing; a method has Config, finish"),
        (lambda: su3d.load_run("nowhere"), "nowhere: contains no run.json"),
        (lambda: su3d.list_datasets("room"), "unknown dataset 'room'; did you mean 'rooms'"),
        (lambda: su3d.load_run("runs/demo").prediction("rooms/bathroom7"), "name one of them"),
        (lambda: su3d.load_run("runs/demo").prediction("rooms/x", "oracle"), "contains no map of rooms/x"),
        (lambda: su3d.load_run("runs/demo").select_instances(methods="sam3d"), "has no scores of the method 'sam3d'"),
    ],
)
def test_each_user_error_is_one_line(call: Any, line: str, here: Path) -> None:
    with pytest.raises(su3d.Su3dError, match=line) as raised:
        call()
    assert "\n" not in str(raised.value)


WRONG: tuple[Any, ...] = (
    None, 3, -1.5, "x", "a\0b", b"x", [], ["x", 3], {}, {"a": 1}, {"a": (None, np.zeros(2))}, object(), np.zeros(3),
    np.array("x"), (), lambda: 1, type, float("nan"), 10**30,
)  # fmt: skip
FUNCTIONS = [name for name in su3d.__all__ if inspect.isfunction(getattr(su3d, name))]


@pytest.mark.parametrize("name", [*FUNCTIONS, "Run", "Frame", "GroundTruth", "Detections", "LabelSet", "Instances.of"])
def test_values_of_any_type_are_accepted_or_a_typed_error(name: str, here: Path) -> None:
    function = su3d.Instances.of if name == "Instances.of" else getattr(su3d, name)
    parameters = inspect.signature(function).parameters.values()
    required = [one.name for one in parameters if one.default is one.empty and one.kind != one.VAR_KEYWORD]
    lines = list[str]()
    for one in parameters:
        for value in WRONG:
            fine = {"scenes": "rooms/none9", "points": np.zeros((4, 3), np.float32), "masks": [[0, 1]]}
            named = {other: fine.get(other, value) for other in required} | {one.name: value}
            try:
                function(**named if one.kind != one.VAR_KEYWORD else {"scenes": "rooms/none9", "seed": value})
            except su3d.Su3dError as error:
                lines.append(str(error))
    assert all("\n" not in line for line in lines) and (lines or not required)


# maps and classes in memory


def test_arrays_score_as_their_files(here: Path) -> None:
    files = su3d.evaluate("predictions", ground_truth="truth", protocols="scannet-instance")
    masks = np.repeat([1, 0], 200)[:, None] > 0
    arrays = masks, np.array([0.9]), np.array([5])
    names = ("pred_masks", "pred_scores", "pred_classes")
    for scene in (arrays, dict(zip(names, arrays, strict=True))):
        found = su3d.evaluate({"scene0000_00": scene}, ground_truth="truth", protocols="scannet-instance")
        assert found.metrics.equals(files.metrics)
    run = su3d.evaluate(
        {"mine": {"scene0000_00": arrays}, "files": "predictions"},
        ground_truth="truth", protocols="scannet-instance", out="runs/arrays",
    )  # fmt: skip
    assert run.metrics.groupby("method")["value"].first().to_dict() == {"mine": 0.5, "files": 0.5}
    for wrong, line in (((masks[:9], *arrays[1:]), "9 points"), ((masks, np.zeros(3)), "scores are an array of shape")):
        with pytest.raises(su3d.Su3dError, match=line):
            su3d.evaluate({"scene0000_00": wrong}, ground_truth="truth", protocols="scannet-instance")


def test_map_of_a_run_scores_as_its_file(here: Path) -> None:
    run = su3d.load_run("runs/demo")
    scenes = {"rooms/bathroom7": run.prediction("rooms/bathroom7", "oracle")}
    found = su3d.evaluate(scenes, dataset="rooms", protocols=BOTH)
    files = su3d.evaluate("runs/demo/scenes/rooms.bathroom7/oracle", dataset="rooms", protocols=BOTH)
    assert found.metrics.equals(files.metrics)


def test_class_runs_in_this_process_and_reads_the_mesh(here: Path) -> None:
    class Half:
        """Half of the scan's mesh is one bed."""

        name = "half"
        Config = type("Config", (BaseModel,), {})

        def __init__(self, config: Any) -> None:
            self.needs = su3d.PerceptionNeeds(masks="none")

        def start(self, scene: su3d.SceneInfo) -> None:
            self.points = scene.surface().vertices

        def update(self, frame: su3d.Frame, detections: su3d.Detections, timer: su3d.Timer) -> None:
            """Frames change nothing."""

        def finish(self) -> su3d.Instances:
            return su3d.Instances.of(self.points, [np.arange(len(self.points) // 2)], labels=["bed"])

    words: dict[str, Any] = {"settings": SMALL, "pictures": False, "out": "runs/half", "limit": 1}
    run = su3d.run("rooms/bathroom7", Half, **words)
    assert run.methods == ("half",) and run.protocols == ("rooms-semantic",)
    assert any("4 more protocols apply: su3d-bench run --extend --all-protocols" in line for line in run.remarks)
    assert len(run.prediction("rooms/bathroom7").points) > 1000
    assert su3d.run("rooms/bathroom7", Half, **words).is_complete  # the same class resumes
    for more in ({"jobs": 2}, {"executor": "processes"}):
        with pytest.raises(su3d.Su3dError, match=r"a class runs in this process; use jobs=1, or save it"):
            su3d.run("rooms/bathroom7", Half, **words, **more)
    other = type("Half", (Half,), {"__qualname__": Half.__qualname__})
    assert su3d.run("rooms/bathroom7", other, **words | {"out": "runs/other"}).methods == ("half",)


def test_scene_without_mesh_is_one_line() -> None:
    with pytest.raises(su3d.Su3dError, match="tum/desk: the dataset has no mesh, which this method needs"):
        su3d.SceneInfo("tum", "desk", 1, 1, "camera").surface()


# the notebook

NOTEBOOK = ROOT / "docs" / "python.ipynb"


def test_notebook_is_stored_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) > 8
    assert [cell["id"] for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []


@pytest.mark.proof
def test_every_notebook_cell_runs(rooms_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbclient
    import nbformat

    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    book = nbformat.read(NOTEBOOK, as_version=4)  # type: ignore[no-untyped-call]
    client = nbclient.NotebookClient(book, timeout=None, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    shown = {
        line
        for cell in book.cells
        for output in cell.get("outputs", ())
        for line in output.get("data", {}).get("text/plain", "").splitlines()
    }
    assert "<Run runs/small: complete, 1 scene, opensu3d, oracle under rooms-semantic, rooms-instance>" in shown
    assert any("missed" in line and "chair" in line for line in shown), "the instance that its predictions lack"
    pages = [
        output["data"].get("text/html", "")
        for cell in book.cells
        for output in cell.get("outputs", ())
        if "data" in output
    ]
    assert any("<table>" in page and "rooms-instance" in page for page in pages), "a run shows its tables"
