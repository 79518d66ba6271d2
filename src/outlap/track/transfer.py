"""Fetch one file over https, with limits of size and time, and retries."""

from __future__ import annotations

import hashlib
import http.client
import ipaddress
import ssl
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPMessage
from pathlib import Path
from typing import IO
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, ProxyHandler, Request, build_opener

from outlap.errors import OutlapError
from outlap.track.archive import MAX_UNPACKED

BLOCK = 1 << 16  # [bytes]

Progress = Callable[[int, int | None], None]  # (bytes so far, bytes in all if the server says)


@dataclass(frozen=True)
class DownloadLimits:
    """Limits of size and time for one download; a track's archive stays far below them."""

    timeout: float = 20.0  # [s] for a connection, and between two pieces of data
    deadline: float = 300.0  # [s] for all tries together
    tries: int = 4
    backoff: float = 1.0  # [s] before the second try, doubled before each further one
    packed: int = 64 << 20  # [bytes] of the downloaded file
    unpacked: int = MAX_UNPACKED  # [bytes] of its content


class UnreachableError(OutlapError):
    """The server gave no answer at all: further files from it are not worth a try."""


def fetch(url: str, target: Path, limits: DownloadLimits, progress: Progress) -> tuple[str, int]:
    """Download `url` to the file `target`; a broken transfer starts again from its first byte.

    Args:
        url: https; http only at a loopback address. A redirect must keep to the same.
        target: written; after an error its content is of no use.
        limits: time limits, tries and the largest file that is accepted.
        progress: called after every piece.

    Returns the SHA-256 as hex digits, and the size [bytes].

    Raises:
        UnreachableError: no connection.
        OutlapError: the URL is not allowed, the server refuses, too large, or no try was complete in time.
    """
    _require_allowed(url)
    give_up = time.monotonic() + limits.deadline
    tries = 0
    while True:
        tries += 1
        try:
            return _fetch_once(url, target, limits, give_up, progress)
        except HTTPError as error:
            error.close()
            reason = f"the server answers {error.code} {http.client.responses.get(error.code, '')}".rstrip()
            if error.code < 500 and error.code not in (408, 429):
                raise OutlapError(f"{url}: {reason}") from error
            unreachable = untrusted = False
        except (OSError, http.client.HTTPException) as error:
            cause = error.reason if isinstance(error, URLError) else error
            reason, unreachable = _describe(cause, limits.timeout), isinstance(error, URLError)
            untrusted = isinstance(cause, ssl.SSLCertVerificationError)
        pause = limits.backoff * 2 ** (tries - 1)
        if untrusted or tries == limits.tries or time.monotonic() + pause > give_up:
            break
        time.sleep(pause)
    if unreachable:
        raise UnreachableError(
            f"{url}: cannot reach {urlsplit(url).netloc} ({reason}); check the network and the proxy"
        )
    raise OutlapError(f"{url}: gave up after {tries} tries ({reason}); try again later")


def _fetch_once(url: str, target: Path, limits: DownloadLimits, give_up: float, progress: Progress) -> tuple[str, int]:
    handlers = [_CheckedRedirects(), *([ProxyHandler({})] if _is_loopback(url) else [])]
    request = Request(url, headers={"User-Agent": "outlap", "Accept-Encoding": "identity"})
    with build_opener(*handlers).open(request, timeout=limits.timeout) as response, target.open("wb") as file:
        announced = response.headers.get("Content-Length", "")
        total = int(announced) if announced.isdecimal() else None
        digest, size = hashlib.sha256(), 0
        while block := response.read1(BLOCK):  # what has arrived, so that a slow server meets the deadline too
            size += len(block)
            if max(size, total or 0) > limits.packed:
                raise OutlapError(f"{url}: is larger than {limits.packed / 1e6:.0f} MB, the most that is accepted")
            if time.monotonic() > give_up:
                raise OutlapError(f"{url}: not complete after {limits.deadline:g} s; try again later")
            digest.update(block)
            file.write(block)
            progress(size, total)
    if total is not None and size != total:
        raise http.client.IncompleteRead(b"", total - size)
    return digest.hexdigest(), size


class _CheckedRedirects(HTTPRedirectHandler):
    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> Request | None:
        _require_allowed(newurl, loopback=_is_loopback(req.full_url))
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _require_allowed(url: str, loopback: bool = True) -> None:
    """Allow https to anywhere, but plain http only to this machine, and never from elsewhere to this machine."""
    try:
        allowed = urlsplit(url).scheme in (("http", "https") if loopback and _is_loopback(url) else ("https",))
    except ValueError as error:
        raise OutlapError(f"{url}: is not a URL ({error})") from None
    if not allowed:
        raise OutlapError(f"{url}: only https is allowed (http only at a loopback address)")


def _is_loopback(url: str) -> bool:
    host = urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _describe(cause: BaseException | str, timeout: float) -> str:
    """Return what broke a transfer, in a few words."""
    match cause:
        case http.client.IncompleteRead():
            return "the connection ended too early"
        case TimeoutError():
            return f"no data for {timeout:g} s"
        case ssl.SSLCertVerificationError():
            return f"its certificate is not trusted: {cause.verify_message}"
        case OSError() if cause.strerror:
            return cause.strerror.lower()
        case _:
            return str(cause) or type(cause).__name__
