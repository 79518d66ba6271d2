"""A download killed again and again: in the end the track is the same, and until then there is none."""

from __future__ import annotations

import random
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from commands import Commands
from outlap.cli.main import main
from outlap.errors import OutlapError
from outlap.track import load_track
from outlap.track.download import LOCK_FILE, read_lock
from outlap.track.map_io import write_track
from track_archives import ArchiveServer, Request, circle_track, tar_xz, track_members

pytestmark = pytest.mark.slow


@pytest.fixture
def server() -> Iterator[ArchiveServer]:
    server = ArchiveServer()
    yield server
    server.close()


def test_a_download_that_is_killed_again_and_again(
    commands: Commands, server: ArchiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OUTLAP_CACHE", str(tmp_path / "user"))
    monkeypatch.delenv("OUTLAP_TRACKS", raising=False)
    cache = tmp_path / "user" / "tracks"
    archive = tar_xz(track_members(tmp_path / "made"))
    moments = random.Random(0)

    def slowly(request: Request) -> None:
        request.send_response(200)
        request.send_header("Content-Length", str(len(archive)))
        request.end_headers()
        for position in range(0, len(archive), 100):
            request.wfile.write(archive[position : position + 100])
            if server.closing.wait(0.02):
                return

    server.answers["/Circle.tar.xz"] = slowly
    words = ["tracks", "download", "Circle", "--url", server.url_template]
    for _ in range(3):
        sent, size = len(server.requested), moments.randrange(1, len(archive) - 500)

        def has_come(sent: int = sent, size: int = size) -> bool:
            files = list(cache.glob(".staging-*/archive.tar.xz"))
            return len(server.requested) > sent and any(file.stat().st_size >= size for file in files)

        code = commands.ended_by(signal.SIGKILL, words, tmp_path, has_come).code
        assert code == -signal.SIGKILL
        with pytest.raises(OutlapError, match="no track is called 'Circle'"):
            load_track("Circle")
    server.answers["/Circle.tar.xz"] = archive
    assert main(words) == 0
    assert (
        load_track("Circle").fingerprint == load_track(write_track(circle_track(), tmp_path / "as it was")).fingerprint
    )
    assert sorted(path.name for path in cache.iterdir()) == [".lock", "Circle", LOCK_FILE]
    assert list(read_lock(cache)) == ["Circle"]
