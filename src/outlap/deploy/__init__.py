"""Onto the car: a trained policy as one ONNX file, and a driver that needs NumPy and onnxruntime alone."""

from outlap.deploy.car_driver import CarDriver, Command

__all__ = ["CarDriver", "Command"]
