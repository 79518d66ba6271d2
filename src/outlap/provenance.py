"""Where results come from: the command, the versions of packages, the machine."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGES = ("outlap", "numpy", "numba", "torch", "stable-baselines3", "gymnasium")


def provenance() -> Mapping[str, Any]:
    """Return the command, the time in UTC, the versions of Python and of `PACKAGES`, and the machine."""
    return {
        "command": " ".join(["outlap", *sys.argv[1:]]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "machine": machine(),
    }


def machine() -> Mapping[str, Any]:
    """Return the operating system, the processor's model name and the number of cores."""
    return {"system": platform.platform(), "processor": _processor(), "cores": os.cpu_count()}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
