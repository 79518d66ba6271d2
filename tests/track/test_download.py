"""Downloading against a local server, with all that can be wrong with a server, an archive and a process."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

import outlap.track.download as download_module
from outlap.errors import OutlapError
from outlap.track import load_track
from outlap.track.download import LOCK_FILE, DownloadedTrack, download_tracks
from outlap.track.transfer import DownloadLimits, UnreachableError
from track_archives import LENGTH, ArchiveServer, Request, tar_xz, track_members

QUICK = DownloadLimits(timeout=0.4, deadline=10.0, tries=3, backoff=0.01)


@pytest.fixture
def server() -> Iterator[ArchiveServer]:
    server = ArchiveServer()
    yield server
    server.close()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("OUTLAP_CACHE", str(tmp_path / "user"))
    monkeypatch.delenv("OUTLAP_TRACKS", raising=False)
    return tmp_path / "user" / "tracks"


@pytest.fixture(scope="module")
def members(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return track_members(tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def archive(members: dict[str, bytes]) -> bytes:
    return tar_xz(members)


def get(server: ArchiveServer, *names: str, limits: DownloadLimits = QUICK, **options) -> list[DownloadedTrack]:
    return download_tracks(names, url_template=server.url_template, limits=limits, **options)


def visible(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.iterdir() if not path.name.startswith("."))


def leftovers(cache: Path) -> list[str]:
    return [path.name for path in cache.iterdir() if path.name.startswith(".staging")]


# --- what is right ------------------------------------------------------------------------------------------


def test_a_good_archive_is_found_by_its_name_and_its_digest_is_recorded(server, cache, archive):
    server.answers["/Circle.tar.xz"] = archive
    (got,) = get(server, "Circle")
    assert (got.name, got.status, got.path) == ("Circle", "downloaded", cache / "Circle")
    assert load_track("Circle").centerline.length == pytest.approx(LENGTH, rel=1e-5)
    lock = json.loads((cache / LOCK_FILE).read_text())
    assert set(lock["Circle"]) == {"url", "sha256", "size_bytes", "date"}
    assert lock["Circle"]["sha256"] == hashlib.sha256(archive).hexdigest()
    assert lock["Circle"]["size_bytes"] == len(archive)
    assert leftovers(cache) == []


def test_a_track_that_is_there_is_not_fetched_again(server, cache, archive):
    server.answers["/Circle.tar.xz"] = archive
    get(server, "Circle")
    (again,) = get(server, "Circle")
    assert again.status == "present"
    assert len(server.requested) == 1


def test_official_names_in_any_spelling(server, cache, tmp_path):
    # As in the archive: the folder has a space, its files do not.
    content = track_members(tmp_path / "made", "MexicoCity")
    server.answers["/MexicoCity.tar.xz"] = tar_xz(
        {name.replace("MexicoCity/", "Mexico City/"): body for name, body in content.items()}
    )
    (got,) = get(server, "mexico city", "Mexico City")
    assert got.name == "MexicoCity"
    assert load_track("México City").name == "MexicoCity"


def test_an_archive_without_a_folder_and_with_hidden_files(server, cache, members):
    flat = {f"./{name.partition('/')[2]}": body for name, body in members.items()}
    server.answers["/Circle.tar.xz"] = tar_xz(flat | {"./._Circle_map.yaml": b"\x00\x05"})
    get(server, "Circle")
    assert not list((cache / "Circle").glob(".*"))
    assert load_track("Circle").name == "Circle"


def test_redirects_are_followed(server, cache, archive):
    server.answers["/Circle.tar.xz"] = lambda request: request.answer(b"", 302, Location="/elsewhere")
    server.answers["/elsewhere"] = archive
    assert get(server, "Circle")[0].status == "downloaded"


def test_downloads_at_once_fetch_once(server, cache, archive):
    def slowly(request: Request) -> None:
        time.sleep(0.3)
        request.answer(archive)

    server.answers["/Circle.tar.xz"] = slowly
    limits = DownloadLimits(timeout=5.0)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: get(server, "Circle", limits=limits)[0].status, range(4)))
    assert sorted(results) == ["downloaded", "present", "present", "present"]
    assert len(server.requested) == 1
    assert visible(cache) == ["Circle", LOCK_FILE]


# --- the server ---------------------------------------------------------------------------------------------


def test_an_unknown_name_is_asked_for_once(server, cache):
    with pytest.raises(OutlapError, match=r"Spelberg\.tar\.xz: .* 404 Not Found; .* are .*Spielberg"):
        get(server, "Spelberg")
    assert len(server.requested) == 1
    assert visible(cache) == []


def test_a_server_error_is_tried_again(server, cache, archive):
    def first_fails(request: Request) -> None:
        request.answer(archive, 500 if len(server.requested) == 1 else 200)

    server.answers["/Circle.tar.xz"] = first_fails
    assert get(server, "Circle")[0].status == "downloaded"
    assert len(server.requested) == 2


def test_a_server_that_stays_broken(server, cache):
    server.answers["/Circle.tar.xz"] = lambda request: request.answer(b"", 503)
    with pytest.raises(OutlapError, match=r"gave up after 3 tries .*503 Service Unavailable"):
        get(server, "Circle")
    assert len(server.requested) == 3


def test_a_silent_server(server, cache):
    server.answers["/Circle.tar.xz"] = lambda request: server.closing.wait(10)
    started = time.monotonic()
    with pytest.raises(OutlapError, match=r"gave up after 3 tries \(no data for 0.4 s\)"):
        get(server, "Circle")
    assert time.monotonic() - started < 5


def trickle(request: Request, body: bytes, server: ArchiveServer) -> None:
    request.send_response(200)
    request.send_header("Content-Length", str(len(body)))
    request.end_headers()
    for position in range(len(body)):
        request.wfile.write(body[position : position + 1])
        if server.closing.wait(0.05):
            return


def test_a_server_that_trickles_meets_the_deadline(server, cache, archive):
    server.answers["/Circle.tar.xz"] = lambda request: trickle(request, archive, server)
    started = time.monotonic()
    with pytest.raises(OutlapError, match=r"not complete after 0\.5 s"):
        get(server, "Circle", limits=DownloadLimits(timeout=5.0, deadline=0.5))
    assert time.monotonic() - started < 3
    assert visible(cache) == []


def test_a_truncated_body_is_fetched_anew(server, cache, archive):
    def first_breaks(request: Request) -> None:
        whole = len(server.requested) > 1
        request.answer(archive if whole else archive[: len(archive) // 2], length=len(archive))

    server.answers["/Circle.tar.xz"] = first_breaks
    assert get(server, "Circle")[0].archive.sha256 == hashlib.sha256(archive).hexdigest()


def test_a_body_that_stays_truncated(server, cache, archive):
    server.answers["/Circle.tar.xz"] = lambda request: request.answer(archive[:-100], length=len(archive))
    with pytest.raises(OutlapError, match=r"gave up after 3 tries \(the connection ended too early\)"):
        get(server, "Circle")
    assert visible(cache) == []


def test_offline(cache):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(UnreachableError, match=r"Monza.*: cannot reach 127.0.0.1:\d+ \(connection refused\)") as caught:
        download_tracks(["Monza", "Spa"], url_template=f"http://127.0.0.1:{port}/{{name}}.tar.xz", limits=QUICK)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("url", ["http://api.f1tenth.org/{name}.tar.xz", "ftp://127.0.0.1/{name}", "file:///{name}"])
def test_only_https_is_allowed(url, cache, monkeypatch):
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: pytest.fail("it connected"))
    with pytest.raises(OutlapError, match="only https is allowed"):
        download_tracks(["Monza"], url_template=url, limits=QUICK)


def test_a_redirect_may_not_leave_https(server, cache):
    server.answers["/Circle.tar.xz"] = lambda request: request.answer(
        b"", 302, Location="http://example.org/Circle.tar.xz"
    )
    with pytest.raises(OutlapError, match=r"http://example\.org/.*: only https is allowed"):
        get(server, "Circle")


@pytest.mark.parametrize("announced", [True, False])
def test_a_download_that_is_too_large(server, cache, announced):
    def large(request: Request) -> None:
        request.send_response(200)
        if announced:
            request.send_header("Content-Length", "300000")
        request.end_headers()
        request.wfile.write(bytes(300_000))

    server.answers["/Circle.tar.xz"] = large
    with pytest.raises(OutlapError, match=r"(at most|larger than) 0 MB"):
        get(server, "Circle", limits=replace(QUICK, packed=200_000))
    assert visible(cache) == []


# --- the lock file ------------------------------------------------------------------------------------------


def test_a_changed_archive_needs_update_lock(server, cache, archive, tmp_path):
    server.answers["/Circle.tar.xz"] = archive
    (first,) = get(server, "Circle")
    server.answers["/Circle.tar.xz"] = changed = tar_xz(track_members(tmp_path / "other", radius=5.0))
    for path in first.path.iterdir():
        path.unlink()
    first.path.rmdir()
    with pytest.raises(OutlapError, match=f"sha256 is .* has {first.archive.sha256} .*--update-lock"):
        get(server, "Circle")
    assert visible(cache) == [LOCK_FILE]

    (second,) = get(server, "Circle", update_lock=True)
    assert second.archive.sha256 == hashlib.sha256(changed).hexdigest()
    assert load_track("Circle").centerline.length == pytest.approx(LENGTH * 5 / 4, rel=1e-4)

    server.answers["/Circle.tar.xz"] = archive  # and back, over a track that is there
    assert get(server, "Circle", update_lock=True)[0].archive.sha256 == first.archive.sha256
    assert load_track("Circle").centerline.length == pytest.approx(LENGTH, rel=1e-4)
    assert leftovers(cache) == []


def test_the_same_bytes_keep_the_first_date(server, cache, archive):
    server.answers["/Circle.tar.xz"] = archive
    get(server, "Circle")
    lock = json.loads((cache / LOCK_FILE).read_text())
    lock["Circle"]["date"] = "2020-01-01T00:00:00+00:00"
    (cache / LOCK_FILE).write_text(json.dumps(lock))
    assert get(server, "Circle", update_lock=True)[0].archive.date == "2020-01-01T00:00:00+00:00"


@pytest.mark.parametrize("text", ["{", "[]", '{"Circle": {}}', '{"Circle": 3}', "\udcff"])
def test_a_broken_lock_file_is_named(server, cache, archive, text):
    cache.mkdir(parents=True)
    (cache / LOCK_FILE).write_bytes(text.encode(errors="surrogateescape"))
    server.answers["/Circle.tar.xz"] = archive
    with pytest.raises(OutlapError, match=rf"{LOCK_FILE}: not a lock file"):
        get(server, "Circle")
    assert server.requested == []


def test_an_imported_track_is_not_replaced(server, cache, archive):
    (cache / "Circle").mkdir(parents=True)
    server.answers["/Circle.tar.xz"] = archive
    with pytest.raises(OutlapError, match="was not downloaded"):
        get(server, "Circle", update_lock=True)


def test_one_of_several_that_fails_is_named_and_the_others_are_kept(server, cache, archive):
    server.answers["/Circle.tar.xz"] = archive
    with pytest.raises(OutlapError, match=r"Monza\.tar\.xz.*404"):
        get(server, "Monza", "Circle")
    assert visible(cache) == ["Circle", LOCK_FILE]
    with pytest.raises(OutlapError, match=r"2 of 3 tracks failed: .*Monza.* \| .*Spa"):
        get(server, "Monza", "Spa", "Circle")


@pytest.mark.parametrize("name", ["", "..", "../Circle", "a/b", "a b", "a%2fb", "é", "x" * 65])
def test_what_cannot_be_a_name_is_never_asked_for(server, cache, name):
    with pytest.raises(OutlapError, match="cannot be the name"):
        get(server, name)
    assert server.requested == []


def test_a_cache_that_cannot_be_written(server, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutlapError, match="set OUTLAP_CACHE to a folder"):
        get(server, "Circle", cache=tmp_path / "file" / "tracks")


# --- the archive --------------------------------------------------------------------------------------------


def refused(server: ArchiveServer, cache: Path, body: bytes, match: str, limits: DownloadLimits = QUICK) -> None:
    """The archive is refused, and neither the cache nor anything around it has got a file."""
    server.answers["/Circle.tar.xz"] = body
    with pytest.raises(OutlapError, match=match) as caught:
        get(server, "Circle", limits=limits)
    assert str(caught.value).startswith(server.url_template.replace("{name}", "Circle"))
    assert ".staging" not in str(caught.value)
    left = [path for path in cache.parent.parent.rglob("*") if path.is_file() or path.is_symlink()]
    assert left == [cache / ".lock"]


@pytest.mark.parametrize(
    ("extra", "match"),
    [
        ({"../../evil": b"evil"}, "leads out"),
        ({"Circle/zeros": bytes(8_000_000)}, "more than 1 MB"),
        ({f"Circle/{number}": b"" for number in range(100)}, "more than 100 files"),
    ],
    ids=["path", "bomb", "files"],
)
def test_a_hostile_archive(server, cache, members, extra, match):
    refused(server, cache, tar_xz(members | extra), match, replace(QUICK, unpacked=1_000_000))


def test_an_archive_must_hold_one_map(server, cache, members):
    without = {name: body for name, body in members.items() if not name.endswith(".yaml")}
    refused(server, cache, tar_xz(without), "holds 0 folders with a map")
    other = {name.replace("Circle/", "Other/"): body for name, body in members.items()}
    refused(server, cache, tar_xz(members | other), "holds 2 folders with a map")


def test_a_map_that_is_not_valid(server, cache, members):
    broken = members | {"Circle/Circle_centerline.csv": b"0, 0, nan, 1\n" * 20}
    refused(server, cache, tar_xz(broken), r"Circle/Circle_centerline\.csv: .*nan")


# --- a kill -------------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_kill_in_the_middle_leaves_nothing_behind(server, cache, archive):
    server.answers["/Circle.tar.xz"] = lambda request: trickle(request, archive, server)
    code = (
        "import sys; from outlap.track.download import download_tracks; "
        "download_tracks(['Circle'], url_template=sys.argv[1])"
    )
    process = subprocess.Popen([sys.executable, "-c", code, server.url_template], env=os.environ)
    try:
        waited = time.monotonic()
        while not list(cache.glob(".staging-*/archive.tar.xz")):
            assert process.poll() is None
            assert time.monotonic() - waited < 30
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert visible(cache) == []
    with pytest.raises(OutlapError, match="no track is called 'Circle'"):
        load_track("Circle")

    server.answers["/Circle.tar.xz"] = archive
    assert get(server, "Circle")[0].status == "downloaded"
    assert leftovers(cache) == []
    assert load_track("Circle").name == "Circle"


@pytest.mark.parametrize("moment", ["extract", "read_track", "_write_lock", "install"])
def test_an_interruption_at_any_moment_leaves_all_or_nothing(server, cache, archive, monkeypatch, moment):
    server.answers["/Circle.tar.xz"] = archive

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(download_module, moment, interrupted)
        with pytest.raises(KeyboardInterrupt):
            get(server, "Circle")
    assert not (cache / "Circle").exists()
    assert leftovers(cache) == []
    assert get(server, "Circle")[0].status == "downloaded"
