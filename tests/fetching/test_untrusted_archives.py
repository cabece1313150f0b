"""Archives as packed by publishers, and hostile ones that try to write outside the folder."""

from __future__ import annotations

import gzip
import io
import stat
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

import pytest
from decompression_bombs import MIB, Member, deflated, gzip_of, zip_of

from su3d_bench.core.errors import DataError
from su3d_bench.fetching.archives import unpack_tar_gz, unpack_zip

LONG = "a" * 150 + "/" + "b" * 150


def of_room(path: PurePosixPath) -> PurePosixPath | None:
    return path if path.parts[0] == "room" else None


def packed(folder: Path, form: str, contents: list[tuple[str, bytes]], kind: bytes = b"0") -> Path:
    """An archive of the files, or of links to /etc/passwd if ``kind`` is not a file."""
    if form == "zip":
        with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in contents:
                info = zipfile.ZipInfo(name)
                info.external_attr = 0 if kind == b"0" else (stat.S_IFLNK | 0o777) << 16
                archive.writestr(info, content)
        return folder / "a.zip"
    with tarfile.open(folder / "a.tar.gz", "w:gz", format=tarfile.PAX_FORMAT if form == "pax" else None) as tar:
        for name, content in contents:
            member = tarfile.TarInfo(name)
            member.size, member.type, member.linkname = (len(content) if kind == b"0" else 0), kind, "/etc/passwd"
            tar.addfile(member, io.BytesIO(content))
    return folder / "a.tar.gz"


def unpacked(archive: Path, folder: Path) -> int:
    if archive.suffix == ".zip":
        return unpack_zip(archive, folder, of_room, lambda *words: None)
    whole = archive.read_bytes()
    parts = [archive.with_suffix(f".part{i}") for i in range(3)]
    for i, part in enumerate(parts):
        part.write_bytes(whole[i * len(whole) // 3 : (i + 1) * len(whole) // 3])
    return unpack_tar_gz(parts, folder, of_room, lambda *words: None)


@pytest.mark.parametrize("form", ["zip", "gnu", "pax"])
def test_only_wanted_members_are_unpacked(tmp_path: Path, form: str) -> None:
    contents = [("room/mesh.ply", bytes(range(256)) * 500), ("room/empty", b""), (f"room/{LONG}", b"z" * 512)]
    archive = packed(tmp_path, form, [*contents, ("b/c", b"no")])
    (tmp_path / "out/room").mkdir(parents=True)
    (tmp_path / "out/room/mesh.ply").write_bytes(b"A" * 128_000)  # from an earlier call
    assert unpacked(archive, tmp_path / "out") == 3
    assert (tmp_path / "out/room/mesh.ply").read_bytes() == b"A" * 128_000
    assert (tmp_path / f"out/room/{LONG}").read_bytes() == b"z" * 512
    assert not (tmp_path / "out/b").exists()


@pytest.mark.parametrize("form", ["zip", "gnu"])
@pytest.mark.parametrize(
    ("names", "printed"),
    [
        (["../out.txt"], "leads out of the folder"),
        (["/tmp/out.txt"], "leads out of the folder"),
        (["room/../../out.txt"], "leads out of the folder"),
        (["C:\\out.txt"], "leads out of the folder"),
        (["a\\..\\..\\out"], "leads out of the folder"),
        (["room/a", "room//a"], "twice"),
        (["."], "a file without a name"),
    ],
)
def test_member_outside_the_folder_is_an_error(tmp_path: Path, form: str, names: list[str], printed: str) -> None:
    with pytest.raises(DataError, match=printed):
        unpacked(packed(tmp_path, form, [(name, b"x") for name in names]), tmp_path / "out")
    assert not (tmp_path / "out.txt").exists()


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE])
def test_link_or_device_in_place_of_a_wanted_file_is_an_error(tmp_path: Path, kind: bytes) -> None:
    for form in ("zip", "gnu"):
        with pytest.raises(DataError, match="'room/habitat' is not a regular file"):
            unpacked(packed(tmp_path, form, [("room/habitat", b"/etc/passwd")], kind), tmp_path / "out")


def test_archive_bomb_is_rejected_before_it_fills_the_disk(tmp_path: Path) -> None:
    info = tarfile.TarInfo("room/mesh.ply")
    info.size = 1 << 32
    (tmp_path / "a.tar.gz").write_bytes(gzip_of(info.tobuf(tarfile.GNU_FORMAT), 140))
    (tmp_path / "a.zip").write_bytes(zip_of([Member(f"room/{i}", deflated(b"", 70), 70 * MIB) for i in range(2)]))
    for name in ("a.tar.gz", "a.zip"):
        with pytest.raises(DataError, match="unpacks to more than 128 MiB"):
            unpacked(tmp_path / name, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("room/*") if path.is_file()]


def test_damaged_archive_is_a_one_line_error(tmp_path: Path) -> None:
    archive = packed(tmp_path, "gnu", [("room/a", bytes(range(256)) * 200)])
    whole = archive.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no archive", whole[:-9] + b"\1" + whole[-8:], whole[:-8]):
        archive.write_bytes(content)
        with pytest.raises(DataError, match="delete it and fetch it again"):
            unpacked(archive, tmp_path / "out")


def test_size_of_a_tar_header_is_limited(tmp_path: Path) -> None:
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 1 << 33
    with gzip.open(tmp_path / "a.tar.gz", "wb") as stream:
        stream.write(info.tobuf(tarfile.GNU_FORMAT))
    with pytest.raises(DataError, match="a member's name of 8,589,934,592 bytes"):
        unpacked(tmp_path / "a.tar.gz", tmp_path / "out")
