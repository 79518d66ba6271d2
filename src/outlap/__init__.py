"""outlap: F1TENTH racing policies that adapt within an out-lap.

The names of `__init__.pyi` are imported when they are first used, so that `outlap --help` answers at once.
"""

from importlib.metadata import version

from outlap.threads import wait_without_spinning

__version__ = version("outlap")

wait_without_spinning()  # before Numba and PyTorch load OpenMP

try:
    import gymnasium
    import lazy_loader
except ModuleNotFoundError:  # on a car there are NumPy and onnxruntime, for `outlap.deploy`
    pass
else:
    __getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
    if "outlap/Race-v0" not in gymnasium.registry:
        gymnasium.register(
            "outlap/Race-v0",
            entry_point="outlap.envs.keywords:make_race",
            vector_entry_point="outlap.envs.keywords:make_race_vector",
        )
