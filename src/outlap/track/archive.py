"""Unpacking a .tar.xz that somebody else made: nothing leaves the folder, and nothing grows without limit.

Only the contents of regular files are taken from the archive, and they are written under names that were
checked. Links, devices, owners and permissions never reach the disk, so there is nothing of them to abuse.
"""

from __future__ import annotations

import io
import lzma
import os
import tarfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from outlap.errors import OutlapError

BLOCK = 1 << 16  # [bytes]
DECODER_MEMORY = 256 << 20  # [bytes]; `xz -9` asks for 65 MiB, a hostile header for up to 4 GiB
MAX_DEPTH = 4  # folders and the file itself


@dataclass(frozen=True)
class ArchiveLimits:
    """What an honest track archive stays far below."""

    packed: int = 64 << 20  # [bytes] the .tar.xz
    unpacked: int = 256 << 20  # [bytes] the tar stream, and the sum of its files
    members: int = 100  # files and folders


def extract(archive: Path, folder: Path, limits: ArchiveLimits | None = None, called: str | None = None) -> list[Path]:
    """Unpack the .tar.xz file `archive` into the existing, empty `folder`; hidden files are left out.

    Args:
        archive: the file.
        folder: where its regular files go.
        limits: sizes [bytes] and number of members; the defaults fit any F1TENTH track.
        called: the archive's name in error messages, such as the URL; its path by default.

    Returns the files written.

    Raises:
        OutlapError: not a complete .tar.xz; a member that is not a plain file or folder, or whose name leaves
            the folder, or that comes twice; a limit is passed. What is written by then, the caller removes.
    """
    limits = limits or ArchiveLimits()
    called = called or str(archive)
    written: list[Path] = []
    try:
        with (
            archive.open("rb") as packed,
            _LimitedXz(packed, limits.unpacked) as stream,
            tarfile.open(fileobj=stream, mode="r|", bufsize=BLOCK) as tar,
        ):
            members = 0
            for member in tar:
                members += 1
                if members > limits.members:
                    raise _Refused(f"holds more than {limits.members} files")
                parts = _safe_parts(member.name)
                if not (member.isdir() or (member.isreg() and not member.issparse())):
                    raise _Refused(f"member {member.name!r} is not a plain file or folder")
                if member.size > limits.unpacked:  # told early; the stream's own limit would stop it too
                    raise _Refused(f"unpacks to more than {limits.unpacked / 1e6:.0f} MB")
                if member.isdir() or any(part.startswith(".") for part in parts):
                    continue
                content = tar.extractfile(member)
                assert content is not None  # it is a regular file
                target = folder.joinpath(*parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    with target.open("xb") as file:
                        while block := content.read(BLOCK):
                            file.write(block)
                        file.flush()
                        os.fsync(file.fileno())
                except FileExistsError:
                    raise _Refused(f"member {member.name!r} comes twice") from None
                written.append(target)
            while stream.read(BLOCK):  # what follows the tar's end is checked and counted too
                pass
    except _Refused as reason:
        raise OutlapError(f"{called}: {reason}; not unpacked") from None
    except (lzma.LZMAError, tarfile.TarError, EOFError, RecursionError, ValueError, OverflowError) as error:
        # the last three: what tarfile lets through from hostile headers
        raise OutlapError(f"{called}: not a complete .tar.xz archive ({error})") from error
    except (FileExistsError, NotADirectoryError) as error:  # a file where another member needs a folder
        raise OutlapError(f"{called}: two members want the same name; not unpacked") from error
    return written


class _Refused(Exception):
    """Why the archive is not unpacked."""


def _safe_parts(name: str) -> tuple[str, ...]:
    """The path components of a member's name; () for the archive's own root."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise _Refused(f"member {name!r} leads out of the archive's folder")
    if any(symbol in '\\:*?"<>|' or not symbol.isprintable() for symbol in name):
        raise _Refused(f"member {name!r} has a character that file names should not have")
    if len(path.parts) > MAX_DEPTH or any(len(part.encode()) > 255 for part in path.parts):
        raise _Refused(f"member {name[:80]!r} is nested too deep or its name is too long")
    return path.parts


class _LimitedXz(io.RawIOBase):
    """The unpacked bytes of an xz stream, at most `limit` of them, and never more than a block in memory."""

    def __init__(self, packed: io.BufferedIOBase | io.BufferedReader, limit: int) -> None:
        self._packed = packed
        self._decoder = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=DECODER_MEMORY)
        self._limit = limit
        self._given = 0  # [bytes]

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        block = b""
        while not block and not self._decoder.eof:
            fresh = b""
            if self._decoder.needs_input:
                fresh = self._packed.read(BLOCK)
                if not fresh:
                    raise EOFError("it ends too early")
            block = self._decoder.decompress(fresh, max_length=len(buffer))
        self._given += len(block)
        if self._given > self._limit:
            raise _Refused(f"unpacks to more than {self._limit / 1e6:.0f} MB")
        buffer[: len(block)] = block
        return len(block)
