"""Timeline of a run: what is logged in order of time, and the file for rerun's viewer."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from painted_runs import painted_run, see_painted

from su3d_bench.analysis import timeline as places
from su3d_bench.analysis.page.maps import Spaces
from su3d_bench.analysis.timeline import MAX_POINTS, Recording, SceneTimeline
from su3d_bench.cli.main import main
from su3d_bench.core.types import Frame
from su3d_bench.runs.finished import read_run
from su3d_bench.store.records import read_updates

HOSTILE = "\x1b[31m/red <b>\n::stop-commands::x\u202e"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return painted_run(tmp_path_factory.mktemp("timeline") / "run")


@pytest.fixture
def _words_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    see_painted(monkeypatch)


@dataclass(frozen=True)
class Logged:
    """A logged entry: its kind, the place and the values, and the frame at which it was logged."""

    kind: str
    values: tuple[Any, ...]
    frame: int | None


class Kinds:
    """A stub of the viewer's library, whose objects are pairs of kind and values."""

    def __getattr__(self, kind: str) -> Any:
        return lambda *values, **named: (kind, (*values, *named.values()))


class Notes:
    """A stub of a recording that stores what is logged."""

    sdk = Kinds()

    def __init__(self) -> None:
        self.logged: list[Logged] = []
        self._frame: int | None = None

    def at(self, frame: int, seconds: float) -> None:
        self._frame = frame
        self.log(frame, ("at", (seconds,)))

    def photo(self, frame: Frame) -> None:
        self.log(frame, ("photo", ()))

    def log(self, place: Any, *contents: tuple[str, tuple[Any, ...]]) -> None:
        self.logged += [Logged(kind, (place, *values), self._frame) for kind, values in contents]

    def close(self, about: str) -> None:
        self.about = about

    def of(self, kind: str) -> list[Logged]:
        return [one for one in self.logged if one.kind == kind]


def written(one: SceneTimeline) -> Notes:
    notes: Any = Notes()
    one.write(notes)
    found: Notes = notes
    return found


def timeline(run: Path, stride: int = 0) -> SceneTimeline:
    return SceneTimeline(read_run(run), read_run(run).scenes[0], read_run(run).methods, stride, Spaces(()))


@pytest.mark.usefixtures("_words_are_known")
def test_every_frame_given_to_a_method_is_logged_at_its_index_and_time(run: Path) -> None:
    one = timeline(run)
    notes = written(one)
    updates = read_updates(read_run(run).folder.job(one.scene, "collector").updates, "updates")
    given = [int(frame) for frame in updates["frame"]]
    moments = [logged.values for logged in notes.of("at")]
    assert [frame for frame, _ in moments] == given == [logged.frame for logged in notes.of("photo")]
    assert moments[0][1] == 0
    assert [seconds for _, seconds in moments] == sorted(seconds for _, seconds in moments)
    assert (one.n_frames, one.n_maps, one.remarks) == (len(given), 1, [])
    place = (*places.GROWTH, places.CURVES[2], "collector")
    curve = [logged.values[1] for logged in notes.of("Scalars") if logged.values[0] == place]
    assert curve == updates["total_ms"].tolist()
    assert len(written(timeline(run, 2)).of("photo")) == -(-len(given) // 2)


@pytest.mark.usefixtures("_words_are_known")
@pytest.mark.parametrize("kind", [places.INSTANCES, places.CLASSES])
def test_map_grows_and_each_point_is_logged_once(run: Path, kind: str) -> None:
    notes = written(timeline(run))
    own = (*places.MAP, "collector", kind)
    grown = [logged for logged in notes.of("Points3D") if logged.values[0][:4] == own]
    assert len({logged.values[0] for logged in grown}) == len(grown), "later entries hide nothing"
    assert all(logged.frame is not None for logged in grown)
    points = np.concatenate([logged.values[1] for logged in grown])
    assert 0 < len(points) <= MAX_POINTS
    assert len(np.unique(points, axis=0)) == len(points)
    (names,) = [logged.values[1] for logged in notes.of("AnnotationContext") if logged.values[0] == own]
    used = {int(number) for logged in grown for number in logged.values[2]} - {0}
    assert used and used <= {values[0] for _, values in names}


@pytest.mark.usefixtures("_words_are_known")
def test_masks_have_the_size_of_their_photo_and_are_not_empty(run: Path) -> None:
    notes = written(timeline(run))
    sizes = {logged.values[0].rgb.shape[:2] for logged in notes.of("photo")}
    assert {logged.values[0] for logged in notes.of("SegmentationImage")} == {
        (*places.MASKS, "collector"),
        places.TRUE_MASKS,
    }
    assert all({logged.values[1].shape} == sizes and logged.values[1].any() for logged in notes.of("SegmentationImage"))


def frame(depth_m: float = 2.0, size: tuple[int, int] = (40, 60)) -> Frame:
    intrinsics = np.array([[50.0, 0, 29.5], [0, 50.0, 19.5], [0, 0, 1]])
    return Frame(0, 0.0, np.zeros((*size, 3), np.uint8), np.full(size, depth_m, np.float32), np.eye(4), intrinsics)


def test_logged_content_reaches_the_library_at_its_place_and_time() -> None:
    sdk, stream = MagicMock(__version__="0.41.0"), BytesIO()
    logged_at = sdk.RecordingStream.return_value
    logged_at.binary_stream.return_value.read.return_value = b"part"
    recording = Recording(sdk, HOSTILE, [HOSTILE], stream)
    recording.log(("world", HOSTILE), sdk.AnnotationContext([]))
    recording.at(40, 1.5)
    recording.photo(frame())
    recording.log(("world", HOSTILE), sdk.Boxes3D())
    recording.close("so")
    logged = [(call.args[0], call.kwargs["static"]) for call in logged_at.log.call_args_list]
    assert [is_static for _, is_static in logged] == [True] * 2 + [False] * 5 + [True]
    assert all("\x1b" not in part and "\n" not in part for path, _ in logged for part in path)
    logged_at.set_time.assert_any_call("frame", sequence=40)
    logged_at.set_time.assert_any_call("seconds", duration=1.5)
    assert sdk.RecordingStream.call_args.kwargs["send_properties"] is False
    assert "0.41.0" in sdk.TextDocument.call_args.args[0], "the version that can read it"
    assert not sdk.init.called and not sdk.spawn.called
    assert stream.getvalue().startswith(b"part")


@pytest.mark.usefixtures("_words_are_known")
def test_recording_can_be_read_and_nothing_else_is_written_or_requested(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("accessed the network")

    monkeypatch.setattr(socket, "create_connection", refuse)
    file = tmp_path / "a.rrd"
    assert main(["report", "rerun", str(run), "--out", str(file), "--quiet"]) == 0
    assert "2 scenes, 2 maps, 12 frames" in capsys.readouterr().out
    assert not list(home.rglob("*"))
    environment = {**os.environ, "HOME": str(tmp_path / "reader")}  # the reader writes its own settings
    read = subprocess.run([sys.executable, "-m", "rerun", "rrd", "stats", str(file)], env=environment,
                          capture_output=True, text=True, check=True).stdout  # fmt: skip
    counts = dict(line.rsplit(": ", 1) for line in read.splitlines() if line.startswith("/"))
    assert counts["/world/camera/colour"] == counts["/world/camera/depth"] == "12"
    assert {"/about", "/world/map/collector/boxes", "/world/truth/instances/room/all"} <= counts.keys()
    assert "frame: " in read and "seconds: " in read
