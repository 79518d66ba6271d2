"""How OpenMP's threads wait."""

from __future__ import annotations

import os

import pytest

from outlap.threads import WAITING, wait_without_spinning


def test_idle_threads_sleep_unless_the_user_says_how_they_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_WAIT_POLICY", *WAITING):
        monkeypatch.delenv(name, raising=False)
    wait_without_spinning()
    assert {name: os.environ.get(name) for name in WAITING} == WAITING
    for name in WAITING:
        monkeypatch.delenv(name)
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    wait_without_spinning()
    assert not WAITING.keys() & os.environ.keys()
