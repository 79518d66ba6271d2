"""A small track, archives of it, and a local server that hands them out well or badly."""

from __future__ import annotations

import io
import math
import tarfile
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from outlap.track import Centerline, Track
from outlap.track.map_io import write_track
from outlap.track.walls import draw_walls

RADIUS = 4.0  # [m]
LENGTH = 2 * math.pi * RADIUS  # [m]


def circle_track(name: str = "Circle", radius: float = RADIUS) -> Track:
    """A circle, 1.5 m wide, driven anticlockwise."""
    angle = np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    half_width = np.full(60, 0.75)
    points = radius * np.column_stack((np.cos(angle), np.sin(angle)))
    line = Centerline.from_points(points, half_width, half_width)
    occupancy, origin = draw_walls(line, 0.1, 0.5)
    return Track(name, occupancy, 0.1, origin, line)


def track_members(folder: Path, name: str = "Circle", radius: float = RADIUS) -> dict[str, bytes]:
    """The files of a circle's map folder by their names in an archive; `folder` is used to make them."""
    write_track(circle_track(name, radius), folder / name)
    return {f"{name}/{path.name}": path.read_bytes() for path in sorted((folder / name).iterdir())}


def tar_xz(members: dict[str, bytes], *special: tarfile.TarInfo) -> bytes:
    """A .tar.xz of these files, and of `special` members without content."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:xz") as tar:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
        for info in special:
            tar.addfile(info)
    return stream.getvalue()


class Request(BaseHTTPRequestHandler):
    """One request, with a short way to answer it."""

    def do_GET(self) -> None:
        server = self.server
        assert isinstance(server, ArchiveServer)
        server.requested.append(self.path)
        answer = server.answers.get(self.path)
        try:
            if answer is None:
                self.answer(b"nothing here", status=404)
            elif isinstance(answer, bytes):
                self.answer(answer)
            else:
                answer(self)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the client left

    def answer(self, body: bytes, status: int = 200, length: int | None = None, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


class ArchiveServer(ThreadingHTTPServer):
    """A server at a loopback address: `answers` maps "/NAME.tar.xz" to the body, or to what sends it."""

    daemon_threads = True
    block_on_close = False

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Request)
        self.answers: dict[str, bytes | Callable[[Request], None]] = {}
        self.requested: list[str] = []
        self.closing = threading.Event()  # for answers that wait
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()

    @property
    def url_template(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/{{name}}.tar.xz"

    def close(self) -> None:
        self.closing.set()
        self.shutdown()
        self.server_close()
