"""Onto the car: a trained policy as one ONNX file, and a driver that needs NumPy and onnxruntime alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from outlap.deploy.car_driver import CarDriver, Command

__all__ = ["CarDriver", "Command"]


def __getattr__(name: str) -> Any:  # imported when asked for: exporting needs no onnxruntime
    if name in __all__:
        from outlap.deploy import car_driver

        return getattr(car_driver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
