"""Fetching one file over https into a file, with a size limit, time limits and new tries."""

from __future__ import annotations

import hashlib
import http.client
import ipaddress
import ssl
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

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


def fetch(
    url: str,
    target: Path,
    max_bytes: int,
    patience: Patience | None = None,
    progress: Progress | None = None,
) -> tuple[str, int]:
    """Download `url` to the file `target`; a broken transfer is begun anew, never continued.

    Args:
        url: https; http only at a loopback address. A redirect must keep to the same.
        target: written; on an error its content is of no use.
        max_bytes: more than this is refused.
        patience: time limits and tries.
        progress: called after every piece.

    Returns the SHA-256 as hex digits, and the size [bytes].

    Raises:
        UnreachableError: no connection.
        OutlapError: the URL is not allowed, the server refuses, too large, or no try came to an end.
    """
    patience = patience or Patience()
    _require_allowed(url)
    give_up = time.monotonic() + patience.deadline
    attempt, reason = 0, ""
    unreachable = False
    for attempt in range(patience.tries):
        if attempt:
            pause = patience.backoff * 2 ** (attempt - 1)
            if time.monotonic() + pause > give_up:
                break
            time.sleep(pause)
        try:
            return _try_once(url, target, max_bytes, patience, give_up, progress or _silent)
        except _TooSlow:
            raise OutlapError(f"{url}: not complete after {patience.deadline:g} s; try again later") from None
        except urllib.error.HTTPError as error:
            error.close()
            reason, unreachable = f"the server answers {_status(error.code)}", False
            if error.code < 500 and error.code not in (408, 429):
                raise OutlapError(f"{url}: {reason}") from error
        except (OSError, http.client.HTTPException) as error:
            reason, unreachable = _reason(error, patience), isinstance(error, urllib.error.URLError)
            if isinstance(getattr(error, "reason", None), ssl.SSLCertVerificationError):
                break  # another try will not mend it
    host = urllib.parse.urlsplit(url).netloc
    if unreachable:
        raise UnreachableError(f"{url}: cannot reach {host} ({reason}); check the network and the proxy")
    raise OutlapError(f"{url}: gave up after {attempt + 1} tries ({reason}); try again later")


class _TooSlow(Exception):
    pass


def _try_once(
    url: str, target: Path, max_bytes: int, patience: Patience, give_up: float, progress: Progress
) -> tuple[str, int]:
    handlers: list[urllib.request.BaseHandler] = [_CheckedRedirects()]
    if _is_loopback(url):
        handlers.append(urllib.request.ProxyHandler({}))
    request = urllib.request.Request(url, headers={"User-Agent": "outlap", "Accept-Encoding": "identity"})
    with urllib.request.build_opener(*handlers).open(request, timeout=patience.timeout) as response:
        announced = response.headers.get("Content-Length", "")
        total = int(announced) if announced.isdecimal() else None
        if total is not None and total > max_bytes:
            raise OutlapError(f"{url}: is {total / 1e6:.0f} MB; at most {max_bytes / 1e6:.0f} MB is accepted")
        digest = hashlib.sha256()
        size = 0
        with target.open("wb") as file:
            while block := response.read1(BLOCK):  # read1: one piece, so that the deadline is looked at
                size += len(block)
                if size > max_bytes:
                    raise OutlapError(f"{url}: is larger than {max_bytes / 1e6:.0f} MB, the most that is accepted")
                if time.monotonic() > give_up:
                    raise _TooSlow
                digest.update(block)
                file.write(block)
                progress(size, total)
    if total is not None and size != total:
        raise http.client.IncompleteRead(b"", total - size)
    return digest.hexdigest(), size


class _CheckedRedirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        _require_allowed(newurl, loopback=_is_loopback(req.full_url))
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _require_allowed(url: str, loopback: bool = True) -> None:
    """https to anywhere; plain http only to this machine, and never from elsewhere to this machine."""
    try:
        scheme = urllib.parse.urlsplit(url).scheme
    except ValueError as error:
        raise OutlapError(f"{url}: is not a URL ({error})") from None
    allowed = scheme in ("http", "https") if _is_loopback(url) and loopback else scheme == "https"
    if not allowed:
        raise OutlapError(f"{url}: only https is allowed (http only at a loopback address)")


def _is_loopback(url: str) -> bool:
    host = urllib.parse.urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _reason(error: BaseException, patience: Patience) -> str:
    """The cause in a few words."""
    cause = getattr(error, "reason", error)
    if isinstance(cause, http.client.IncompleteRead):
        return "the connection ended too early"
    if isinstance(cause, TimeoutError):
        return f"no data for {patience.timeout:g} s"
    if isinstance(cause, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted: {cause.verify_message}"
    if isinstance(cause, OSError) and cause.strerror:
        return cause.strerror.lower()
    return str(cause) or type(cause).__name__


def _status(code: int) -> str:
    """The code with its standard name: the server's own words could be anything."""
    try:
        return f"{code} {http.HTTPStatus(code).phrase}"
    except ValueError:
        return str(code)


def _silent(size: int, total: int | None) -> None:
    pass
