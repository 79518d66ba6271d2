"""Where the small trainings of these tests run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from outlap.track.map_io import write_track
from synthetic_tracks import ring


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A current folder of its own, from which the ring has a name; one torch thread."""
    write_track(ring(radius=5.0), tmp_path / "maps" / "ring5")
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path / "maps"))
    monkeypatch.chdir(tmp_path)
    torch.set_num_threads(1)
