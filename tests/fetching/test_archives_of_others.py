"""Archives as publishers pack them, and as somebody may who wants to write where he should not."""

from __future__ import annotations

import gzip
import io
import stat
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from bombs import MIB, Member, deflated, gzip_of, zip_of

from su3d_bench.core.errors import DataError
from su3d_bench.fetching.archives import members, unpack_tar_gz, unpack_zip

LONG = "a" * 150 + "/" + "b" * 150


def anywhere(path: PurePosixPath) -> PurePosixPath:
    return path


def of_room(path: PurePosixPath) -> PurePosixPath | None:
    return path if path.parts[0] == "room" else None


def silent(name: str, done: int, total: int | None) -> None:
    pass


def zipped(place: Path, contents: dict[str, bytes], mode: int = 0) -> Path:
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            info = zipfile.ZipInfo(name)
            info.external_attr = mode << 16
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, content)
    return place


def tarred(place: Path, contents: dict[str, bytes], form: int = tarfile.GNU_FORMAT, kind: bytes = b"0") -> Path:
    with tarfile.open(place, "w:gz", format=form) as archive:
        for name, content in contents.items():
            info = tarfile.TarInfo(name)
            info.size, info.type, info.linkname = (len(content) if kind == b"0" else 0), kind, "/etc/passwd"
            archive.addfile(info, io.BytesIO(content))
    return place


def test_a_file_without_a_name_is_refused(tmp_path: Path) -> None:
    nameless = tmp_path / "a.zip"
    nameless.write_bytes(zipped(tmp_path / "b.zip", {"x": b"1"}).read_bytes().replace(b"x", b"."))
    with pytest.raises(DataError, match="holds a file without a name"):
        unpack_zip(nameless, tmp_path / "out", of_room, silent)
    with pytest.raises(DataError, match="holds a file without a name"):
        unpack_tar_gz([tarred(tmp_path / "a.tar.gz", {".": b"1"})], tmp_path / "out", of_room, silent)


def test_a_zip_archive_with_an_empty_name_is_listed(tmp_path: Path) -> None:
    """Where ``zipfile.ZipInfo.is_dir`` of Python 3.11 fails."""
    archive = tmp_path / "a.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr(zipfile.ZipInfo(""), b"1")
    assert members(archive) == [("", 1)]


def test_wanted_members_of_a_zip_archive_come_and_no_others(tmp_path: Path) -> None:
    archive = zipped(tmp_path / "a.zip", {"room/traj.txt": b"poses", "room/results/f.jpg": b"x" * 70000, "b/c": b"no"})
    assert unpack_zip(archive, tmp_path / "out", of_room, silent) == 2
    assert (tmp_path / "out/room/results/f.jpg").read_bytes() == b"x" * 70000
    assert not (tmp_path / "out/b").exists()


@pytest.mark.parametrize("form", [tarfile.GNU_FORMAT, tarfile.PAX_FORMAT, tarfile.USTAR_FORMAT])
def test_a_tar_archive_cut_into_parts_is_read_as_one_in_every_form(tmp_path: Path, form: int) -> None:
    contents = {"./room/habitat/mesh.ply": bytes(range(256)) * 500, "room/empty": b"", "room/last": b"z" * 512}
    if form != tarfile.USTAR_FORMAT:
        contents[f"room/{LONG}"] = b"long"
    whole = tarred(tmp_path / "a.tar.gz", contents, form).read_bytes()
    parts = [tmp_path / f"part{i}" for i in range(3)]
    for i, part in enumerate(parts):
        part.write_bytes(whole[i * len(whole) // 3 : (i + 1) * len(whole) // 3])
    assert unpack_tar_gz(parts, tmp_path / "out", anywhere, silent) == len(contents)
    for name, content in contents.items():
        assert (tmp_path / "out" / name).read_bytes() == content


def test_what_was_unpacked_before_is_passed_over(tmp_path: Path) -> None:
    contents = {"room/a": b"a" * 600, "room/b": b"b" * 600}
    archives = zipped(tmp_path / "a.zip", contents), tarred(tmp_path / "a.tar.gz", contents)
    for archive, folder in zip(archives, ("z", "t"), strict=True):
        (tmp_path / folder / "room").mkdir(parents=True)
        (tmp_path / folder / "room/a").write_bytes(b"A" * 600)
        if folder == "z":
            unpack_zip(archive, tmp_path / folder, anywhere, silent)
        else:
            unpack_tar_gz([archive], tmp_path / folder, anywhere, silent)
        assert (tmp_path / folder / "room/a").read_bytes() == b"A" * 600
        assert (tmp_path / folder / "room/b").read_bytes() == b"b" * 600


@pytest.mark.parametrize("name", ["../out.txt", "/tmp/out.txt", "room/../../out.txt", "C:\\out.txt", "a\\..\\..\\out"])
def test_a_member_that_leads_out_of_the_folder_ends_it(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match="leads out of the folder; nothing of it was put in place"):
        unpack_zip(zipped(tmp_path / "a.zip", {name: b"x"}), tmp_path / "out", anywhere, silent)
    with pytest.raises(DataError, match="leads out of the folder; nothing of it was put in place"):
        unpack_tar_gz([tarred(tmp_path / "a.tar.gz", {name: b"x"})], tmp_path / "out", anywhere, silent)
    assert not (tmp_path / "out").exists() and not (tmp_path / "out.txt").exists()


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE])
def test_a_link_or_device_in_the_place_of_a_wanted_file_ends_it(tmp_path: Path, kind: bytes) -> None:
    archive = tarred(tmp_path / "a.tar.gz", {"room/habitat": b""}, kind=kind)
    with pytest.raises(DataError, match="'room/habitat' is no plain file"):
        unpack_tar_gz([archive], tmp_path / "out", anywhere, silent)
    linked = zipped(tmp_path / "a.zip", {"room/traj.txt": b"/etc/passwd"}, stat.S_IFLNK | 0o777)
    with pytest.raises(DataError, match=r"'room/traj.txt' is a link"):
        unpack_zip(linked, tmp_path / "out", anywhere, silent)


def test_a_name_that_comes_twice_ends_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds 'room/a' twice"):
        unpack_zip(zipped(tmp_path / "a.zip", {"room/a": b"1", "room//a": b"2"}), tmp_path / "out", anywhere, silent)
    archive = tarred(tmp_path / "a.tar.gz", {"room/a": b"1", "./room/a": b"2"})
    with pytest.raises(DataError, match="holds 'room/a' twice"):
        unpack_tar_gz([archive], tmp_path / "out", anywhere, silent)


def test_an_archive_that_swells_is_left_before_it_fills_the_disk(tmp_path: Path) -> None:
    info = tarfile.TarInfo("room/mesh.ply")
    info.size = 1 << 32
    (tmp_path / "a.tar.gz").write_bytes(gzip_of(info.tobuf(tarfile.GNU_FORMAT), 140))
    with pytest.raises(DataError, match="unpacks to more than 128 MiB"):
        unpack_tar_gz([tmp_path / "a.tar.gz"], tmp_path / "out", anywhere, silent)
    assert not list((tmp_path / "out").rglob("mesh.ply"))
    zeros = [Member(f"room/{i}", deflated(b"", 70), 70 * MIB) for i in range(2)]
    (tmp_path / "a.zip").write_bytes(zip_of(zeros))
    with pytest.raises(DataError, match="unpacks to more than 128 MiB"):
        unpack_zip(tmp_path / "a.zip", tmp_path / "out", anywhere, silent)
    assert not list((tmp_path / "out").rglob("room/*"))


def test_a_tar_archive_that_ends_early_or_is_none_is_one_line(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).bytes(50_000)
    whole = tarred(tmp_path / "a.tar.gz", {"room/a": noise}).read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no archive", whole[:-9] + b"\1" + whole[-8:], whole[:-8]):
        (tmp_path / "part").write_bytes(content)
        with pytest.raises(DataError, match="nothing of it was put in place: delete it and fetch anew"):
            unpack_tar_gz([tmp_path / "part"], tmp_path / "out", anywhere, silent)


def test_words_before_a_member_are_bounded(tmp_path: Path) -> None:
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 1 << 33
    with gzip.open(tmp_path / "a.tar.gz", "wb") as stream:
        stream.write(info.tobuf(tarfile.GNU_FORMAT))
    with pytest.raises(DataError, match="a member's name of 8,589,934,592 bytes"):
        unpack_tar_gz([tmp_path / "a.tar.gz"], tmp_path / "out", anywhere, silent)
