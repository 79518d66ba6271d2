"""Unpack a .tar.xz from an untrusted source: nothing leaves the folder, and nothing grows without limit."""

from __future__ import annotations

import io
import lzma
import os
import tarfile
from pathlib import Path, PurePosixPath

from outlap.errors import OutlapError

DECODER_MEMORY = 256 << 20  # [bytes]; `xz -9` asks for 65 MiB, a hostile header for up to 4 GiB
MAX_UNPACKED = 256 << 20  # [bytes] of the tar; a track's stays far below it
MAX_MEMBERS = 100  # files and folders
MAX_DEPTH = 4  # folders and the file itself


def extract(archive: Path, folder: Path, max_bytes: int = MAX_UNPACKED, called: str | None = None) -> list[Path]:
    """Unpack the .tar.xz file `archive` into the existing, empty `folder`; hidden files are left out.

    Args:
        archive: the file.
        folder: where its regular files go, with the permissions of new files.
        max_bytes: the largest tar that is accepted.
        called: the archive's name in error messages, such as the URL; its path by default.

    Returns the files written.

    Raises:
        OutlapError: not a complete .tar.xz; a member that is not a plain file or folder, or whose name leaves
            the folder, or that comes twice; a limit is passed. The caller removes what is written by then.
    """
    called = called or str(archive)
    try:
        with tarfile.open(fileobj=io.BytesIO(_decompress(archive, max_bytes)), mode="r:") as tar:
            files = _plain_files(tar)
            tar.extractall(folder, files.values(), filter="data")
    except _RefusedError as reason:
        raise OutlapError(f"{called}: {reason}; not unpacked") from None
    except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:  # a file where another needs a folder
        raise OutlapError(f"{called}: two members want the same name; not unpacked") from error
    except (lzma.LZMAError, tarfile.TarError, EOFError, RecursionError, ValueError, OverflowError) as error:
        # the last three: what tarfile lets through from hostile headers
        raise OutlapError(f"{called}: not a complete .tar.xz archive ({error})") from error
    written = [folder.joinpath(*parts) for parts in files]
    for path in written:
        with path.open("rb") as file:
            os.fsync(file.fileno())
    return written


class _RefusedError(Exception):
    """Why the archive is not unpacked."""


def _plain_files(tar: tarfile.TarFile) -> dict[tuple[str, ...], tarfile.TarInfo]:
    """Return the visible files by the parts of their names; raise _RefusedError if any member is not acceptable."""
    files: dict[tuple[str, ...], tarfile.TarInfo] = {}
    for count, member in enumerate(tar, start=1):
        if count > MAX_MEMBERS:
            raise _RefusedError(f"holds more than {MAX_MEMBERS} files")
        parts = _safe_parts(member.name)
        if not (member.isdir() or (member.isreg() and not member.issparse())):
            raise _RefusedError(f"member {member.name!r} is not a plain file or folder")
        if member.isdir() or any(part.startswith(".") for part in parts):
            continue
        if parts in files:
            raise _RefusedError(f"member {member.name!r} comes twice")
        files[parts] = member.replace(mode=0o644, deep=False)
    return files


def _decompress(archive: Path, limit: int) -> bytes:
    decoder = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=DECODER_MEMORY)
    unpacked = decoder.decompress(archive.read_bytes(), max_length=limit + 1)
    if len(unpacked) > limit:
        raise _RefusedError(f"unpacks to more than {limit / 1e6:.0f} MB")
    if not decoder.eof:
        raise EOFError("it ends too early")
    return unpacked


def _safe_parts(name: str) -> tuple[str, ...]:
    """Return the path components of a member's name; () for the archive's own root."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise _RefusedError(f"member {name!r} leads out of the archive's folder")
    if any(symbol in '\\:*?"<>|' or not symbol.isprintable() for symbol in name):
        raise _RefusedError(f"member {name!r} has a character that file names should not have")
    if len(path.parts) > MAX_DEPTH or any(len(part.encode()) > 255 for part in path.parts):
        raise _RefusedError(f"member {name[:80]!r} is nested too deep or its name is too long")
    return path.parts
