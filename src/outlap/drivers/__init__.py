"""Drivers: observations to actions."""

from outlap.drivers.driver import Driver

__all__ = ["Driver"]
