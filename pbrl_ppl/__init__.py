"""A physics engine as model prior, and a loop that closes on measured data.

The public names stand in ``__init__.pyi``; each is imported when it is first used, for PyMC takes
seconds to load.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
