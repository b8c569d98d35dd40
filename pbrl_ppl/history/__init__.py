"""Measured files to a validated `xarray.Dataset`; trajectories and segments."""

import lazy_loader

# readers of raw logs are loaded by those who read one
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
