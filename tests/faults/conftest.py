"""What the tests of faults share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from commands import Commands


@pytest.fixture(scope="session")
def commands(shared_cache: None) -> Iterator[Commands]:
    """Processes that can be killed."""
    commands = Commands()
    yield commands
    commands.close()
