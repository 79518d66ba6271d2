"""Unpack a .tar.xz from an untrusted source: nothing leaves the folder, and nothing grows without limit."""

from __future__ import annotations

import io
import lzma
import os
import tarfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from outlap.errors import OutlapError

DECODER_MEMORY = 256 << 20  # [bytes]; `xz -9` asks for 65 MiB, a hostile header for up to 4 GiB
MAX_DEPTH = 4  # folders and the file itself


@dataclass(frozen=True)
class ArchiveLimits:
    """What a track's archive stays far below."""

    packed: int = 64 << 20  # [bytes] the .tar.xz
    unpacked: int = 256 << 20  # [bytes] the tar
    members: int = 100  # files and folders


def extract(archive: Path, folder: Path, limits: ArchiveLimits | None = None, called: str | None = None) -> list[Path]:
    """Unpack the .tar.xz file `archive` into the existing, empty `folder`; hidden files are left out.

    Args:
        archive: the file.
        folder: where its regular files go, with the permissions of new files.
        limits: sizes [bytes] and number of members; the defaults fit any F1TENTH track.
        called: the archive's name in error messages, such as the URL; its path by default.

    Returns the files written.

    Raises:
        OutlapError: not a complete .tar.xz; a member that is not a plain file or folder, or whose name leaves
            the folder, or that comes twice; a limit is passed. The caller removes what is written by then.
    """
    called = called or str(archive)
    limits = limits or ArchiveLimits()
    members = _Members(limits)
    try:
        with tarfile.open(fileobj=io.BytesIO(_decompress(archive, limits.unpacked)), mode="r:") as tar:
            tar.extractall(folder, filter=members.check)
    except _RefusedError as reason:
        raise OutlapError(f"{called}: {reason}; not unpacked") from None
    except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:  # a file where another needs a folder
        raise OutlapError(f"{called}: two members want the same name; not unpacked") from error
    except (lzma.LZMAError, tarfile.TarError, EOFError, RecursionError, ValueError, OverflowError) as error:
        # the last three: what tarfile lets through from hostile headers
        raise OutlapError(f"{called}: not a complete .tar.xz archive ({error})") from error
    written = [folder.joinpath(*parts) for parts in members.files]
    for path in written:
        with path.open("rb") as file:
            os.fsync(file.fileno())
    return written


class _RefusedError(Exception):
    """Why the archive is not unpacked."""


class _Members:
    """A filter for `TarFile.extractall` that is stricter than tarfile's own."""

    def __init__(self, limits: ArchiveLimits) -> None:
        self.files: dict[tuple[str, ...], None] = {}  # that are unpacked, in order
        self._limits, self._count = limits, 0

    def check(self, member: tarfile.TarInfo, folder: str) -> tarfile.TarInfo | None:
        """Return what of a member is unpacked, None for a hidden file; raise _RefusedError."""
        self._count += 1
        if self._count > self._limits.members:
            raise _RefusedError(f"holds more than {self._limits.members} files")
        parts = _safe_parts(member.name)
        if not (member.isdir() or (member.isreg() and not member.issparse())):
            raise _RefusedError(f"member {member.name!r} is not a plain file or folder")
        if member.isdir() or any(part.startswith(".") for part in parts):
            return None
        if parts in self.files:
            raise _RefusedError(f"member {member.name!r} comes twice")
        self.files[parts] = None
        return tarfile.data_filter(member, folder).replace(mode=0o644, deep=False)


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
