"""Environments: Gymnasium, Gymnasium's vector interface, Stable-Baselines3.

The names of `__init__.pyi` are imported when they are first used: Stable-Baselines3 brings PyTorch.
"""

import lazy_loader  # pyright: ignore[reportMissingTypeStubs]

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # pyright: ignore[reportUnknownVariableType]
