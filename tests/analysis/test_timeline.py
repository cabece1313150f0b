"""What stands on the timeline of a run: records in the order of time, and the file that rerun's viewer reads."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from painted import WordEncoder
from painted_runs import painted_run

from su3d_bench.analysis.page.maps import Spaces
from su3d_bench.analysis.timeline import MOST_POINTS, SEEN_M, SceneTimeline, ids_of, in_view, owned_of_truth, smaller
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ModelMissing
from su3d_bench.core.types import Frame, GroundTruth, LabelSet
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reports.timeline import records as kinds
from su3d_bench.reports.timeline.records import Moment, Record
from su3d_bench.reports.timeline.rrd import rerun_sdk, write_rrd
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs.finished import read_run
from su3d_bench.store.records import read_updates

SCENE = "painted/a"
HOSTILE = "\x1b[31m/red <b>\n::stop-commands::x\u202e"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return painted_run(tmp_path_factory.mktemp("timeline") / "run")


@pytest.fixture
def _words_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finished_run, "encoder_of", lambda folder, device="cpu": WordEncoder())


def timeline(run: Path, stride: int = 0) -> SceneTimeline:
    return SceneTimeline(read_run(run), read_run(run).scenes[0], read_run(run).methods, stride, Spaces(()))


def of_kind(records: list[Record], kind: type) -> list[Record]:
    return [record for record in records if isinstance(record.content, kind)]


@pytest.mark.usefixtures("_words_are_known")
def test_every_frame_that_a_method_was_given_stands_at_its_index_and_second(run: Path) -> None:
    one = timeline(run)
    records = list(one.records())
    job = read_run(run).folder.job(one.scene, "collector")
    given = [int(frame) for frame in read_updates(job.updates, "updates")["frame"]]
    poses = of_kind(records, kinds.CameraPose)
    assert [record.moment.frame for record in poses if record.moment] == given
    seconds = [record.moment.seconds for record in poses if record.moment]
    assert seconds[0] == 0
    assert seconds == sorted(seconds)
    assert (one.n_frames, one.n_maps, one.remarks) == (len(given), 1, [])
    for kind in (kinds.ColourImage, kinds.DepthImage):
        assert len(of_kind(records, kind)) == len(given)
    moments = [record.moment.frame for record in records if record.moment]
    assert moments == sorted(moments), "in the order of time"


@pytest.mark.usefixtures("_words_are_known")
def test_a_stride_takes_every_nth_of_the_frames_given(run: Path) -> None:
    every, second = timeline(run), timeline(run, 2)
    n = len(of_kind(list(every.records()), kinds.CameraPose))
    assert len(of_kind(list(second.records()), kinds.CameraPose)) == -(-n // 2)


@pytest.mark.usefixtures("_words_are_known")
@pytest.mark.parametrize("kind", [kinds.INSTANCES, kinds.CLASSES])
def test_the_map_grows_and_each_point_of_it_comes_once(run: Path, kind: str) -> None:
    records = list(timeline(run).records())
    grown = [record for record in of_kind(records, kinds.Points) if record.place[:4] == (*kinds.MAP, "collector", kind)]
    assert len({record.place for record in grown}) == len(grown), "what comes later hides nothing"
    assert all(record.moment is not None for record in grown)
    points = np.concatenate([record.content.points for record in grown if isinstance(record.content, kinds.Points)])
    assert 0 < len(points) <= MOST_POINTS
    assert len(np.unique(points, axis=0)) == len(points)
    (names,) = [record for record in of_kind(records, kinds.Names) if record.place == (*kinds.MAP, "collector", kind)]
    assert isinstance(names.content, kinds.Names)
    told = {number for number, _, _ in names.content.entries}
    used = {int(i) for record in grown if isinstance(record.content, kinds.Points) for i in record.content.ids} - {0}
    assert used
    assert used <= told


@pytest.mark.usefixtures("_words_are_known")
def test_masks_are_of_the_size_of_their_photo_and_name_what_stands_there(run: Path) -> None:
    records = list(timeline(run).records())
    sizes = {record.content.rgb.shape[:2] for record in records if isinstance(record.content, kinds.ColourImage)}
    places = {record.place for record in of_kind(records, kinds.IdImage)}
    assert places == {(*kinds.MASKS, "collector"), kinds.TRUE_MASKS}
    for record in records:
        if isinstance(record.content, kinds.IdImage):
            assert {record.content.ids.shape} == sizes
            assert record.content.ids.any()


@pytest.mark.usefixtures("_words_are_known")
def test_the_curves_are_what_the_updates_say(run: Path) -> None:
    one = timeline(run)
    records = list(one.records())
    updates = read_updates(read_run(run).folder.job(one.scene, "collector").updates, "updates")
    curve = [record.content.value for record in records if record.place == (*kinds.GROWTH, kinds.CURVES[2], "collector")
             if isinstance(record.content, kinds.Number)]  # fmt: skip
    assert curve == updates["total_ms"].tolist()


@pytest.mark.usefixtures("_words_are_known")
def test_without_the_data_the_map_stands_alone_and_it_is_said(run: Path) -> None:
    one = timeline(run)
    changed = replace(one._run, data=replace(one._run.data, digests={}))
    alone = SceneTimeline(changed, one.scene, ["collector"], 0, Spaces(()))
    records = list(alone.records())
    assert any("data are not those of the run" in line for line in alone.remarks)
    assert (alone.n_frames, alone.n_maps) == (0, 1)
    assert of_kind(records, kinds.Points)
    assert all(record.moment is None for record in records)
    (about,) = of_kind(records, kinds.Text)
    assert isinstance(about.content, kinds.Text)
    assert "data are not those of the run" in about.content.text


def frame(depth_m: float = 2.0, size: tuple[int, int] = (40, 60)) -> Frame:
    intrinsics = np.array([[50.0, 0, 29.5], [0, 50.0, 19.5], [0, 0, 1]])
    return Frame(0, 0.0, np.zeros((*size, 3), np.uint8), np.full(size, depth_m, np.float32), np.eye(4), intrinsics)


def test_a_point_is_in_view_where_the_camera_measured_it_alone() -> None:
    points = np.array([[0, 0, 2], [0, 0, 2 + 2 * SEEN_M], [0, 0, 1], [9, 0, 2], [0, 0, -2]], np.float32)
    assert in_view(points, frame()).tolist() == [True, False, False, False, False]


def test_a_smaller_frame_shows_the_same_place_at_the_same_share_of_its_width() -> None:
    full = frame()
    small = smaller(full, 20)
    assert small.rgb.shape == (13, 20, 3)
    assert small.depth_m.shape == (13, 20)
    ray = np.array([0.3, -0.2, 1.0])
    (u, v, _), (x, y, _) = full.intrinsics @ ray, small.intrinsics @ ray
    assert ((u + 0.5) / 60, (v + 0.5) / 40) == pytest.approx(((x + 0.5) / 20, (y + 0.5) / 13))
    assert smaller(full, 60) is full


def test_ids_beyond_what_the_viewer_can_tell_are_nobodys() -> None:
    assert ids_of(np.array([-1, 0, 65533, 65534, 1 << 20])).tolist() == [0, 1, 65534, 0, 0]


def test_the_ceiling_stands_in_a_place_of_its_own() -> None:
    rules = load_protocol("rooms-instance")
    entry = rules.classes[0]
    spots = np.random.default_rng(0).uniform((0, 0, 0), (3, 3, 2.5), (4000, 3)).astype(np.float32)
    labels = LabelSet("rooms", (entry.id,), (entry.name,))
    truth = GroundTruth(
        spots, np.full(4000, entry.id, np.int32), np.ones(4000, np.int32), labels, "mesh-vertices", "made"
    )
    owned = owned_of_truth(rules, truth)
    parts = {record.place: record.content for record in owned.static(kinds.TRUTH)}
    room = parts[*kinds.TRUTH, kinds.CLASSES, kinds.ROOM, "all"]
    top = parts[*kinds.TRUTH, kinds.CLASSES, kinds.TOP, "all"]
    assert isinstance(room, kinds.Points)
    assert isinstance(top, kinds.Points)
    assert room.points[:, 2].max() < top.points[:, 2].min()
    assert len(room.points) + len(top.points) == len(owned.cloud.points)


def every_kind() -> list[Record]:
    pose = kinds.CameraPose(np.eye(4), np.eye(3), 4, 2)
    ids = np.ones((2, 4), np.uint16)
    points = kinds.Points(np.zeros((3, 3), np.float32), np.array([0, 1, 2], np.uint16), 0.01)
    boxes = kinds.Boxes(np.zeros((1, 2, 3), np.float32), (HOSTILE,), ((1, 2, 3),))
    contents: list[kinds.Content] = [
        pose, kinds.ColourImage(np.zeros((2, 4, 3), np.uint8)), kinds.DepthImage(np.ones((2, 4), np.float32)),
        kinds.IdImage(ids), points, boxes, kinds.Number(3.0),
    ]  # fmt: skip
    moving = [Record(("world", HOSTILE, str(k)), one, Moment(40, 1.5)) for k, one in enumerate(contents)]
    names = Record(("world", HOSTILE), kinds.Names(((1, HOSTILE, (1, 2, 3)),)))
    return [names, *moving, Record(kinds.ABOUT, kinds.Text("so"))]


def test_records_reach_the_viewers_library_at_their_place_and_moment(tmp_path: Path) -> None:
    sdk = MagicMock(__version__="0.41.0")
    recording = sdk.RecordingStream.return_value
    recording.binary_stream.return_value.read.return_value = b"part"
    with (tmp_path / "a.rrd").open("wb") as stream:
        write_rrd([(HOSTILE, every_kind())], [HOSTILE], stream, sdk)
    logged = [(call.args[0], call.kwargs["static"]) for call in recording.log.call_args_list]
    assert len(logged) == 1 + 9 + 1, "the axes of the world, each record, and of a camera its pose and its lens"
    assert all("\x1b" not in part and "\n" not in part for path, _ in logged for part in path)
    assert [is_static for _, is_static in logged].count(False) == 8
    recording.set_time.assert_any_call("frame", sequence=40)
    recording.set_time.assert_any_call("seconds", duration=1.5)
    assert sdk.RecordingStream.call_args.kwargs["send_properties"] is False
    assert "0.41.0" in sdk.TextDocument.call_args.args[0], "which version reads it"
    assert not sdk.init.called
    assert not sdk.spawn.called
    assert (tmp_path / "a.rrd").read_bytes() == b"part" * 10


@pytest.mark.parametrize(
    ("module", "said"),
    [
        (None, "pip install 'su3d-bench[rerun]'"),
        (SimpleNamespace(__version__="0.22.1"), "rerun-sdk 0.41 or later, here is 0.22.1"),
        (SimpleNamespace(), "or later, here is another"),
        (MagicMock(__version__="0.41.0", **{"RecordingStream.return_value.is_enabled.return_value": False}), "unset"),
    ],
)
def test_a_library_that_is_not_there_too_old_or_off_is_one_line(
    module: Any,
    said: str,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", module)
    with pytest.raises(ModelMissing):
        rerun_sdk()
    assert main(["report", "rerun", str(run), "--out", str(tmp_path / "a.rrd")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "a.rrd", "--stride", "0"], "--stride 0: expected 1 or more"),
        (["--out", "a.bin"], "ends in .rrd"),
        (["--out", "a.rrd", "--scenes", "painted/z"], "has no scene 'painted/z'"),
        (["--out", "a.rrd", "--methods", "colector"], "did you mean 'collector'?"),
    ],
)
def test_a_wrong_request_is_one_line(
    words: list[str], said: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["report", "rerun", str(run), *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


@pytest.mark.usefixtures("_words_are_known")
def test_nothing_to_show_leaves_no_file(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sdk = MagicMock(__version__="0.41.0")
    sdk.RecordingStream.return_value.binary_stream.return_value.read.return_value = b""
    monkeypatch.setitem(sys.modules, "rerun", sdk)
    monkeypatch.setattr(SceneTimeline, "records", lambda self, tell: iter(()))
    assert main(["report", "rerun", str(run), "--out", str(tmp_path / "a.rrd")]) == 2
    assert "nothing to show" in capsys.readouterr().err
    assert not list(tmp_path.iterdir()), "no file, nor a half one"


@pytest.mark.usefixtures("_words_are_known")
def test_the_file_is_read_back_and_nothing_else_is_written_or_asked(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun", reason="the rerun extra is not installed")
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("asked the network")

    monkeypatch.setattr(socket, "create_connection", refuse)
    file = tmp_path / "a.rrd"
    assert main(["report", "rerun", str(run), "--out", str(file), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "2 scenes, 2 maps, 12 frames" in said
    assert not list(home.rglob("*"))
    environment = {**os.environ, "HOME": str(tmp_path / "reader")}  # the reader has settings of its own
    read = subprocess.run([sys.executable, "-m", "rerun", "rrd", "stats", str(file)], env=environment,
                          capture_output=True, text=True, check=True).stdout  # fmt: skip
    counts = dict(line.rsplit(": ", 1) for line in read.splitlines() if line.startswith("/"))
    assert counts["/world/camera/colour"] == counts["/world/camera/depth"] == "12"
    assert {"/about", "/world/map/collector/boxes", "/world/truth/instances/room/all"} <= counts.keys()
    assert "frame: " in read
    assert "seconds: " in read
