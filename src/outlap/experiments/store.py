"""Folders of units in an object store, or on any file system that fsspec knows: s3://, gs://, sftp://, file://.

A unit is one archive there, written under another name first, so that there is a whole one or none.
"""

from __future__ import annotations

import re
import shutil
import tarfile
import tempfile
import uuid
from contextlib import suppress
from pathlib import Path

from outlap.errors import OutlapError
from outlap.experiments.unit import Unit


class Store:
    """Units that machines without a common folder hand to each other.

    Args:
        url: where, such as s3://bucket/folder.

    Raises OutlapError for a URL that cannot be used here.
    """

    def __init__(self, url: str) -> None:
        from fsspec.core import url_to_fs

        try:
            # What it remembers of a folder it would not ask for again, and others write there.
            self.files, root = url_to_fs(url, use_listings_cache=False)
        except (ImportError, ValueError) as error:  # a protocol without its package, or no protocol at all
            raise OutlapError(f"--store {url}: cannot be used: {error}") from None
        self.url, self.root = url, root.rstrip("/")

    def check(self) -> None:
        """Raises OutlapError where nothing can be written."""
        probe = f"{self.root}/.{uuid.uuid4().hex}"
        try:
            self.files.makedirs(self.root, exist_ok=True)
            self.files.pipe_file(probe, b"outlap")
            self.files.rm_file(probe)
        except Exception as error:  # whatever a file system raises: each has errors of its own
            raise OutlapError(f"--store {self.url}: cannot be written: {error}; give another --store") from None

    def done(self) -> set[str]:
        """Keys of the units that are there."""
        return self._keys(".tar")

    def begun(self) -> set[str]:
        """Keys of the units that a part is there of."""
        return self._keys(".part.tar")

    def put(self, unit: Unit, work: Path) -> None:
        """Keep a unit that is done."""
        self._put(unit, work, ".tar")
        part = self._path(unit, ".part.tar")
        if self.files.exists(part):
            self.files.rm_file(part)

    def put_part(self, unit: Unit, work: Path) -> None:
        """Keep what there is of a unit that is not done yet."""
        self._put(unit, work, ".part.tar")

    def get(self, unit: Unit, work: Path) -> None:
        """Bring a unit that is done. Raises OutlapError where it is gone."""
        if not self._get(unit, work, ".tar"):
            raise OutlapError(f"{self.url}: has lost {unit.name}; run it all again")

    def get_part(self, unit: Unit, work: Path) -> None:
        """Bring what there is of a unit, if anything."""
        if not self._get(unit, work, ".tar"):
            self._get(unit, work, ".part.tar")

    def _keys(self, suffix: str) -> set[str]:
        ending = re.compile(rf"-([0-9a-f]{{12}}){re.escape(suffix)}$")
        return {found[1] for path in self.files.find(self.root) if (found := ending.search(path))}

    def _path(self, unit: Unit, suffix: str) -> str:
        return f"{self.root}/{unit.kind}/{unit.name}-{unit.key}{suffix}"

    def _put(self, unit: Unit, work: Path, suffix: str) -> None:
        path = self._path(unit, suffix)
        beside = f"{path}.{uuid.uuid4().hex}"
        with tempfile.NamedTemporaryFile(suffix=suffix) as local:
            with tarfile.open(fileobj=local, mode="w") as archive:
                archive.add(unit.folder(work), ".", filter=_not_hidden)
            local.flush()
            self.files.makedirs(path.rpartition("/")[0], exist_ok=True)
            try:
                self.files.put_file(local.name, beside)
                self.files.mv(beside, path)
            except BaseException:  # Ctrl-C, too
                with suppress(Exception):  # there may be nothing, or no way to it
                    self.files.rm_file(beside)
                raise

    def _get(self, unit: Unit, work: Path, suffix: str) -> bool:
        path, folder = self._path(unit, suffix), unit.folder(work)
        if not self.files.exists(path):
            return False
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".fetching-") as beside:
            with self.files.open(path, "rb") as file, tarfile.open(fileobj=file, mode="r|") as archive:
                archive.extractall(f"{beside}/unit", filter="data")
            shutil.rmtree(folder, ignore_errors=True)  # of an earlier session, and behind what was kept since
            shutil.move(f"{beside}/unit", folder)
        return True


def _not_hidden(member: tarfile.TarInfo) -> tarfile.TarInfo | None:
    """Locks and half-written files are left out."""
    return None if Path(member.name).name.startswith(".") and member.name != "." else member
