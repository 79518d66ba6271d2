"""A plain Python function as a driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from outlap.drivers.driver import Driver

PAPER_TERMS = ("scan", "pose", "vel", "heading")


@dataclass(frozen=True)
class FunctionDriver(Driver):
    """Asks a function for the actions of all cars at once: observation terms (n, size) in, actions (n, 2) out."""

    function: Callable[[dict[str, np.ndarray]], Any]
    name: str
    observation_terms: tuple[str, ...] = PAPER_TERMS

    @classmethod
    def of(cls, function: Callable[[dict[str, np.ndarray]], Any]) -> FunctionDriver:
        """A function as it is: of the paper's terms, or of those that its attribute `observation_terms` names."""
        terms = getattr(function, "observation_terms", PAPER_TERMS)
        terms = (terms,) if isinstance(terms, str) else tuple(terms)
        return cls(function, getattr(function, "__name__", type(function).__name__), terms)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        return self.function(observation)
