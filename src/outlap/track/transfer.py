"""Fetch one file over https, with limits of size and time, and retries."""

from __future__ import annotations

import hashlib
import http.client
import ipaddress
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPMessage
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from outlap.errors import OutlapError

BLOCK = 1 << 16  # [bytes]

Progress = Callable[[int, int | None], None]  # (bytes so far, bytes in all if the server says)


@dataclass(frozen=True)
class Patience:
    """How long to wait, and how often to try."""

    timeout: float = 20.0  # [s] for a connection, and between two pieces of data
    deadline: float = 300.0  # [s] for all tries together
    tries: int = 4
    backoff: float = 1.0  # [s] before the second try, doubled before each further one


class UnreachableError(OutlapError):
    """The server gave no answer at all: further files from it are not worth a try."""


def fetch(url: str, target: Path, max_bytes: int, patience: Patience, progress: Progress) -> tuple[str, int]:
    """Download `url` to the file `target`; a broken transfer starts again from its first byte.

    Args:
        url: https; http only at a loopback address. A redirect must keep to the same.
        target: written; after an error its content is of no use.
        max_bytes: the largest file that is accepted.
        patience: time limits and tries.
        progress: called after every piece.

    Returns the SHA-256 as hex digits, and the size [bytes].

    Raises:
        UnreachableError: no connection.
        OutlapError: the URL is not allowed, the server refuses, too large, or no try was complete in time.
    """
    _require_allowed(url)
    give_up = time.monotonic() + patience.deadline
    tries = 0
    while True:
        tries += 1
        try:
            return _try_once(url, target, max_bytes, patience, give_up, progress)
        except urllib.error.HTTPError as error:
            error.close()
            reason = f"the server answers {error.code} {http.client.responses.get(error.code, '')}".rstrip()
            unreachable, hopeless = False, error.code < 500 and error.code not in (408, 429)
            if hopeless:
                raise OutlapError(f"{url}: {reason}") from error
        except (OSError, http.client.HTTPException) as error:
            cause = getattr(error, "reason", error)
            reason, unreachable = _describe(cause, patience), isinstance(error, urllib.error.URLError)
            hopeless = isinstance(cause, ssl.SSLCertVerificationError)
        pause = patience.backoff * 2 ** (tries - 1)
        if hopeless or tries == patience.tries or time.monotonic() + pause > give_up:
            break
        time.sleep(pause)
    if unreachable:
        raise UnreachableError(
            f"{url}: cannot reach {urlsplit(url).netloc} ({reason}); check the network and the proxy"
        )
    raise OutlapError(f"{url}: gave up after {tries} tries ({reason}); try again later")


def _try_once(
    url: str, target: Path, max_bytes: int, patience: Patience, give_up: float, progress: Progress
) -> tuple[str, int]:
    handlers = [_CheckedRedirects(), *([urllib.request.ProxyHandler({})] if _is_loopback(url) else [])]
    request = urllib.request.Request(url, headers={"User-Agent": "outlap", "Accept-Encoding": "identity"})
    with urllib.request.build_opener(*handlers).open(request, timeout=patience.timeout) as response:
        announced = response.headers.get("Content-Length", "")
        total = int(announced) if announced.isdecimal() else None
        digest, size = hashlib.sha256(), 0
        with target.open("wb") as file:
            while block := response.read1(BLOCK):  # what has arrived, so that a slow server meets the deadline too
                size += len(block)
                if max(size, total or 0) > max_bytes:
                    raise OutlapError(f"{url}: is larger than {max_bytes / 1e6:.0f} MB, the most that is accepted")
                if time.monotonic() > give_up:
                    raise OutlapError(f"{url}: not complete after {patience.deadline:g} s; try again later")
                digest.update(block)
                file.write(block)
                progress(size, total)
    if total is not None and size != total:
        raise http.client.IncompleteRead(b"", total - size)
    return digest.hexdigest(), size


class _CheckedRedirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> urllib.request.Request | None:
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


def _describe(cause: object, patience: Patience) -> str:
    """Return what broke a transfer, in a few words."""
    match cause:
        case http.client.IncompleteRead():
            return "the connection ended too early"
        case TimeoutError():
            return f"no data for {patience.timeout:g} s"
        case ssl.SSLCertVerificationError():
            return f"its certificate is not trusted: {cause.verify_message}"
        case OSError() if cause.strerror:
            return cause.strerror.lower()
    return str(cause) or type(cause).__name__
