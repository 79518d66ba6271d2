"""IPOPT, by way of CasADi: how it is called, and how it ended."""

from __future__ import annotations

from typing import Any

import casadi

QUIET = {"print_level": 0, "sb": "yes"}  # without its banner
INTERRUPTED = ("NonIpopt_Exception_Thrown", "User_Requested_Stop")  # what becomes of Ctrl-C in CasADi


def ended(solver: casadi.Function) -> str | None:
    """How a solver failed, in its own words; None where it found what it was to find.

    Raises KeyboardInterrupt where that was Ctrl-C.
    """
    stats: dict[str, Any] = solver.stats()
    if stats["return_status"] in INTERRUPTED:
        raise KeyboardInterrupt
    return None if stats["success"] else stats["return_status"]
