"""A write that fails or is killed leaves the old file, and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from outlap.files import atomic_write


def test_writes_text_and_bytes_into_new_folders(tmp_path: Path) -> None:
    assert atomic_write(tmp_path / "a" / "b" / "text", "größe").read_bytes() == "größe".encode()
    assert atomic_write(str(tmp_path / "bytes"), b"\x00\xff").read_bytes() == b"\x00\xff"


def test_a_failed_rename_leaves_the_old_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = atomic_write(tmp_path / "file", "old")

    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        atomic_write(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_kill_leaves_one_whole_version(tmp_path: Path) -> None:
    path = tmp_path / "file"
    versions = ["a" * 2_000_000, "b" * 2_000_000]
    atomic_write(path, versions[0])
    program = (
        "import sys; from outlap.files import atomic_write\n"
        "print('ready', flush=True)\n"
        "while True:\n"
        "    for letter in 'ab': atomic_write(sys.argv[1], letter * 2_000_000)\n"
    )
    for _ in range(5):
        with subprocess.Popen([sys.executable, "-c", program, path], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            writer.send_signal(signal.SIGKILL)
        assert path.read_text() in versions
