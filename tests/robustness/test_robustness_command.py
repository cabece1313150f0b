"""The commands of ``robustness`` on a small room with perfect masks."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from su3d_bench.baselines.openmask3d import method, proposals
from su3d_bench.cli.main import build_parser, main
from su3d_bench.cli.run import plan_of
from su3d_bench.core.errors import StoreError
from su3d_bench.core.registry import METHODS
from su3d_bench.corruptions.apply import CORRUPTIONS
from su3d_bench.perception import cache, profiles
from su3d_bench.perception.oracle import ORACLE_CAVEAT
from su3d_bench.runs.verify import read_checked

SMALL = "--set rooms.width=160 rooms.height=120 rooms.n_frames=40 --stride 10 --profile oracle --jobs 1"
ROOM = f"rooms/bathroom0 {SMALL} --protocols rooms-instance"
NAMES = "depth/holes pose/jitter-translation masks/eroded names/distractors time/lost-bursts light/exposure"


def prediction(run: str, name: str) -> bytes:
    return Path(run, "scenes", "rooms.bathroom0", name, "prediction.npz").read_bytes()


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep") / "run"
    words = f"robustness run {ROOM} --corruptions {NAMES} --severities 0 4 --out {folder}"
    assert main(words.split()) == 0
    return folder


def test_severity_0_is_the_clean_run_byte_for_byte(sweep: Path) -> None:
    clean = prediction(str(sweep), "opensu3d")
    for name in NAMES.replace("/", "-").split():
        assert prediction(str(sweep), f"opensu3d~{name}-0") == clean
    for name in ("depth-holes", "pose-jitter-translation", "masks-eroded", "time-lost-bursts"):
        assert prediction(str(sweep), f"opensu3d~{name}-4") != clean
    assert prediction(str(sweep), "opensu3d~names-distractors-4") == clean


def test_cell_run_alone_equals_the_cell_of_the_sweep(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for text, more in (("depth/holes/4", ""), ("time/lost-bursts/4", "--scenes rooms/studio0 --jobs 2")):
        out = tmp_path / text.replace("/", "-")
        assert main(f"robustness run {ROOM} --only {text} --out {out} {more}".split()) == 0
        said = capsys.readouterr()
        assert f"2 cells on {'2 scenes' if more else '1 scene'}: about " in said.err
        assert f"next: su3d-bench robustness report {out} --tolerance" in said.err
        assert "under corruptions**" in said.out
        name = f"opensu3d~{text.replace('/', '-')}"
        assert prediction(str(out), name) == prediction(str(sweep), name)


def test_corrupted_openmask3d_shares_proposals_and_segments_a_frame_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, segmented = Mock(wraps=proposals.make_proposals), Mock(wraps=cache.cached_regions)
    monkeypatch.setattr(method, "make_proposals", made)
    monkeypatch.setattr(profiles, "cached_regions", segmented)
    words = f"robustness run {ROOM.replace('oracle', 'embedded')} --methods openmask3d --severities 2 --corruptions"
    assert main(f"{words} pose/jumps pose/jitter-rotation --out {tmp_path / 'both'}".split()) == 0
    assert made.call_count == 2  # the clean method's time counts
    assert segmented.call_count <= 3 * 4
    assert main(f"{words} pose/jitter-rotation --out {tmp_path / 'alone'}".split()) == 0
    name = "openmask3d~pose-jitter-rotation-2"
    assert prediction(str(tmp_path / "both"), name) == prediction(str(tmp_path / "alone"), name)


def test_sweep_is_resumed_and_extended_in_its_folder(sweep: Path, tmp_path: Path) -> None:
    out = shutil.copytree(sweep, tmp_path / "run")
    words = f"robustness run {ROOM} --corruptions {NAMES} --out {out} --severities"
    cell = out / "scenes" / "rooms.bathroom0" / "opensu3d~pose-jitter-translation-4"
    shutil.rmtree(cell)
    assert main(f"{words} 0 4".split()) == 0
    assert prediction(str(out), cell.name) == prediction(str(sweep), cell.name)
    assert main(f"{words} 2 --extend".split()) == 0
    assert len(list(cell.parent.iterdir())) == 2 + 3 * len(NAMES.split())  # with the oracle


def test_report_has_every_family_and_writes_its_figure(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    figure = tmp_path / "figure.png"
    assert main(f"robustness report {sweep} --figure {figure} --json".split()) == 0
    (found,) = json.loads(capsys.readouterr().out)["methods"]
    assert list(found["families"]) == ["depth", "pose", "masks", "names", "time", "light"]
    assert found["cells"]["masks/eroded/4"]["difference"] < 0
    assert found["cells"]["masks/eroded/0"]["difference"] == 0
    assert figure.read_bytes()[:4] == b"\x89PNG"
    assert main(f"robustness report {sweep} --format latex".split()) == 0
    assert r"\begin{tabular}" in capsys.readouterr().out


def test_cell_whose_records_hide_perfect_masks_is_refused(sweep: Path, tmp_path: Path) -> None:
    run = shutil.copytree(sweep, tmp_path / "run")
    read_checked(run)
    name = "opensu3d~depth-holes-4"
    metrics = json.loads((run / "metrics.json").read_text())
    for result in metrics["results"]:
        result["caveat"] = None if result["method"] == name else result["caveat"]
    (run / "metrics.json").write_text(json.dumps(metrics))
    done = run / "scenes" / "rooms.bathroom0" / name / "done.json"
    done.write_text(done.read_text().replace(json.dumps(ORACLE_CAVEAT), "null"))
    with pytest.raises(StoreError, match=f"{name} .*the method used ground truth"):
        read_checked(run)


def test_bundle_of_a_sweep_is_scored_again(sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bundle = tmp_path / "sweep.zip"
    assert main(f"report bundle {sweep} --out {bundle} --quiet".split()) == 0
    capsys.readouterr()
    assert main(["report", "verify", str(bundle)]) == 0
    assert "verified (bit-exact)" in capsys.readouterr().out


def test_tolerance_between_the_severities_of_a_sweep(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(f"robustness report {sweep} --tolerance --json".split()) == 0
    answer = json.loads(capsys.readouterr().out)
    clean, cells = answer["methods"][0]["clean"], answer["methods"][0]["cells"]
    found = {one["corruption"]: one for one in answer["tolerances"]}
    assert list(found) == NAMES.split()
    for name, one in found.items():
        worst = cells[f"{name}/4"]["value"]
        expected = 4.0 if worst >= 0.95 * clean else 4 * 0.05 * clean / (clean - worst)
        assert one["severity"] == pytest.approx(expected)
        assert one["is_beyond"] == (worst >= 0.95 * clean)
        assert one["value"] == pytest.approx(CORRUPTIONS[name].value_at(expected))
    assert main(f"robustness report {sweep} --tolerance --format markdown".split()) == 0
    assert "Tolerated errors of masks" in capsys.readouterr().out


def test_method_without_instances_is_left_out_of_the_scores_of_instances(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = ROOM.replace("rooms-instance", "rooms-instance rooms-semantic")
    words = f"robustness run {both} --only depth/holes/4 --methods opensu3d conceptfusion --out {tmp_path / 'run'}"
    assert main(words.split()) == 0
    for protocol, expected in (("instance", ["opensu3d"]), ("semantic", ["opensu3d", "conceptfusion"])):
        capsys.readouterr()
        assert main(f"robustness report {tmp_path / 'run'} --protocol rooms-{protocol} --tolerance --json".split()) == 0
        assert [one["method"] for one in json.loads(capsys.readouterr().out)["methods"]] == expected


def test_tolerance_is_between_the_severities_that_keep_and_lose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    words = f"robustness tolerance {ROOM} --corruptions masks/eroded --quiet --json --out {tmp_path / 'run'}"
    assert main(words.split()) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert 0 < found["severity"] < 5
    assert found["corruption"] == "masks/eroded"


def test_show_draws_every_stage_at_every_severity(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = "rooms/bathroom0 --set rooms.width=160 rooms.height=120 rooms.n_frames=40"
    names = "depth/scale pose/jumps time/reordered masks/split names/typos calibration/focal"
    words = f"robustness show {room} --corruptions {names} --out {tmp_path / 'show.png'} --json"
    capsys.readouterr()
    assert main(words.split()) == 0
    assert json.loads(capsys.readouterr().out)["n_pictures"] == 36
    assert (tmp_path / "show.png").read_bytes()[:4] == b"\x89PNG"


def test_update_that_loses_all_depth_has_no_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = CORRUPTIONS["depth/holes"]
    monkeypatch.setitem(CORRUPTIONS, row.address, replace(row, values=(1.0, 1.0, 1.0, 1.0, 1.0)))
    words = f"robustness run {ROOM} --only depth/holes/1 --methods conceptgraphs opensu3d --out {tmp_path / 'run'}"
    assert main(words.split()) == 0


def test_methods_come_from_the_flag_or_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.toml").write_text('methods = ["sam3d"]\npictures = true\n')
    for words, methods, draws in (
        ("--methods all", {*METHODS} - {"oracle", "command"}, False),
        (f"--config {tmp_path / 'run.toml'}", {"sam3d"}, True),
    ):
        words = f"robustness run rooms/bathroom0 --only image/jpeg/3 --dry-run --json {words}"
        arguments = build_parser("robustness").parse_args(words.split())
        arguments.call(arguments)
        jobs = json.loads(capsys.readouterr().out)["jobs"]
        assert {job["method"] for job in jobs} == {one + end for one in methods for end in ("", "~image-jpeg-3")}
        assert plan_of(arguments).jobs[0].config.pictures is draws
    words = f"robustness tolerance rooms/bathroom0 --config {tmp_path / 'run.toml'} --corruptions image/jpeg --dry-run"
    assert main(f"{words} --out {tmp_path / 'out'}".split()) == 0
    assert "sam3d~image-jpeg-5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run rooms/bathroom0 --corruptions dpeth", "did you mean 'depth'"),
        ("run rooms/bathroom0 --only depth/holes/9", "severity from 0 to 5"),
        ("run rooms/bathroom0 --only depth/holes+pose/jumps/3", "'depth/holes': expected depth/holes/SEVERITY"),
        ("run rooms/bathroom0 --methods sam3d~depth/holes/3", "is already under a corruption"),
        ("run rooms/bathroom0 --severities 7", "expected 0 to 5"),
        ("tolerance rooms/bathroom0 --share 2 --out out", "must be above 0 and below 1"),
        ("tolerance rooms/bathroom0", "name the run folder with --out"),
        ("show rooms/bathroom0 --set rooms.n_frames=40 --frame 40 --out show.png", "has frames 0 to 39"),
        ("report none", "none"),
    ],
)
def test_wrong_request_is_one_line(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robustness", *words.split()]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_list_has_every_corruption_with_its_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robustness", "list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) >= 47
    assert all(len(row["values"]) == 5 and row["source"] for row in rows)
