"""The batched simulator."""

from outlap.simulator.kernel_cache import discard_stale_kernels

discard_stale_kernels()  # before any kernel of this package can be called
