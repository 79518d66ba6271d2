"""What commands do after Ctrl-C: they end with exit code 130, and say what was kept."""

from __future__ import annotations

INTERRUPTED = 130  # exit code
NOTHING_KEPT = "nothing is kept; begin again with the same command"
