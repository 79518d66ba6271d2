"""Unpacking: what is right comes out whole, what is hostile is refused, and nothing is written elsewhere."""

from __future__ import annotations

import lzma
import tarfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import outlap.track.archive as archive_module
from outlap.errors import OutlapError
from outlap.track.archive import MAX_UNPACKED, extract
from track_archives import tar_xz


@pytest.fixture(scope="module")
def members() -> dict[str, bytes]:
    noise = np.random.default_rng(0).bytes(5000)
    return {"Circle/Circle_map.yaml": b"image: a.png\n", "Circle/a.png": noise, "Circle/empty.csv": b""}


@pytest.fixture(scope="module")
def archive(members: dict[str, bytes]) -> bytes:
    return tar_xz(members)


def refused(place: Path, body: bytes, match: str, max_bytes: int = MAX_UNPACKED) -> None:
    """The archive is refused, and nothing around the folder has changed."""
    (place / "around" / "inside").mkdir(parents=True, exist_ok=True)
    (place / "a.tar.xz").write_bytes(body)
    with pytest.raises(OutlapError, match=match) as caught:
        extract(place / "a.tar.xz", place / "around" / "inside", max_bytes)
    assert str(caught.value).startswith(f"{place / 'a.tar.xz'}: ")
    assert "\n" not in str(caught.value)
    assert [path.name for path in place.iterdir()] in (["a.tar.xz", "around"], ["around", "a.tar.xz"])
    assert [path.name for path in (place / "around").iterdir()] == ["inside"]
    assert not any(path.is_symlink() for path in (place / "around").rglob("*"))


def test_all_files_come_out_whole_and_hidden_ones_do_not(tmp_path, members):
    (tmp_path / "a.tar.xz").write_bytes(tar_xz(members | {"Circle/._a.png": b"x", "./.git/config": b"x"}))
    (tmp_path / "inside").mkdir()
    written = extract(tmp_path / "a.tar.xz", tmp_path / "inside")
    assert {str(path.relative_to(tmp_path / "inside")): path.read_bytes() for path in written} == members
    assert {path for path in (tmp_path / "inside").rglob("*") if path.is_file()} == set(written)


def test_permissions_are_not_taken_over(tmp_path):
    program = tarfile.TarInfo("program")
    program.mode = 0o6777
    (tmp_path / "a.tar.xz").write_bytes(tar_xz({}, program))
    (path,) = extract(tmp_path / "a.tar.xz", tmp_path)
    assert path.stat().st_mode & 0o6111 == 0


@pytest.mark.parametrize(
    "name",
    [
        "../evil",
        "../../evil",
        "Circle/../../evil",
        "/evil",
        "//evil",
        "..\\evil",
        "C:evil",
        "a\nb",
        "a/b/c/d/e",
        "x" * 300,
    ],
)
def test_names_that_lead_out_of_the_folder(tmp_path, members, name):
    refused(tmp_path, tar_xz(members | {name: b"evil"}), "leads out|character|too deep")


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE])
def test_only_plain_files(tmp_path, members, kind):
    special = tarfile.TarInfo("Circle/extra")
    special.type, special.linkname = kind, "../../../../etc/passwd"
    refused(tmp_path, tar_xz(members, special), "'Circle/extra' is not a plain file")


def test_writing_through_a_link(tmp_path, members):
    link = tarfile.TarInfo("Circle/out")
    link.type, link.linkname = tarfile.SYMTYPE, str(tmp_path)
    inside = tarfile.TarInfo("Circle/out/evil")
    refused(tmp_path, tar_xz(members, link, inside), "not a plain file")


def test_a_member_that_comes_twice(tmp_path, members):
    twice = tarfile.TarInfo("Circle/Circle_map.yaml")
    refused(tmp_path, tar_xz(members, twice), "comes twice")


def test_a_member_inside_a_file(tmp_path, members):
    inside = tarfile.TarInfo("Circle/Circle_map.yaml/more")
    refused(tmp_path, tar_xz(members, inside), "want the same name")


def test_a_bomb_is_stopped_while_it_unpacks(tmp_path, members):
    bomb = tar_xz(members | {"Circle/zeros": bytes(8_000_000)})
    assert len(bomb) < 20_000
    refused(tmp_path, bomb, "more than 1 MB", 1_000_000)


def test_a_bomb_behind_the_end_of_the_tar(tmp_path, members):
    tar = lzma.decompress(tar_xz(members)) + bytes(8_000_000)
    refused(tmp_path, lzma.compress(tar), "more than 1 MB", 1_000_000)


def test_a_bomb_of_many_small_files(tmp_path, members):
    many = members | {f"Circle/{number}": b"" for number in range(100)}
    refused(tmp_path, tar_xz(many), "more than 100 files")


def test_a_sparse_file(tmp_path):
    # GNU's old sparse format: 1 TB in a header of 512 bytes.
    info = tarfile.TarInfo("Circle/sparse")
    info.type = tarfile.GNUTYPE_SPARSE
    header = bytearray(info.tobuf(tarfile.GNU_FORMAT))
    header[483:495] = b"%011o\0" % 8_000_000_000
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    refused(tmp_path, lzma.compress(bytes(header) + bytes(1024)), "not a plain file")


def test_what_needs_too_much_memory_to_unpack(tmp_path, archive, monkeypatch):
    monkeypatch.setattr(archive_module, "DECODER_MEMORY", 1 << 20)  # the archive's dictionary has 8 MiB
    refused(tmp_path, archive, "Memory usage limit")


@pytest.mark.parametrize(
    "body",
    [b"", b"<html>maintenance</html>", lzma.compress(b"not a tar" * 1000), lzma.compress(b"")],
    ids=["empty", "html", "xz of text", "xz of nothing"],
)
def test_what_is_no_archive(tmp_path, body):
    refused(tmp_path, body, r"not a complete \.tar\.xz archive")


def test_an_archive_that_is_cut_off(tmp_path, archive):
    refused(tmp_path / "1", archive[: len(archive) * 2 // 3], r"not a complete \.tar\.xz archive")
    refused(tmp_path / "2", archive[:-4], r"not a complete \.tar\.xz archive")


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_any_damage_to_the_tar_is_one_clear_error_or_none(data, members, tmp_path_factory):
    tar = bytearray(lzma.decompress(tar_xz(members)))
    headers = [start for start in range(0, len(tar), 512) if tar[start + 257 : start + 262] == b"ustar"]
    start = data.draw(st.sampled_from(headers))
    for _ in range(data.draw(st.integers(1, 6))):
        tar[start + data.draw(st.integers(0, 511))] = data.draw(st.integers(0, 255))
    tar[start + 148 : start + 156] = b" " * 8
    tar[start + 148 : start + 156] = b"%06o\0 " % sum(tar[start : start + 512])
    around = tmp_path_factory.mktemp("fuzz")
    (around / "inside").mkdir()
    (around / "a.tar.xz").write_bytes(lzma.compress(bytes(tar), preset=0))
    try:
        written = extract(around / "a.tar.xz", around / "inside", 10_000_000)
    except OutlapError:
        written = []
    assert all(path.resolve().is_relative_to(around / "inside") for path in written)
    assert sorted(path.name for path in around.iterdir()) == ["a.tar.xz", "inside"]
