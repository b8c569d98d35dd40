"""Command line: one module for commands that belong together.

Imports of the package stand inside the functions: PyMC takes seconds to load, and ``--help`` or a
mistyped path should not wait for it.
"""

import importlib
import pkgutil

from pbrl_ppl.cli.app import main as main

for _module in pkgutil.iter_modules(__path__):  # their commands are declared then
    importlib.import_module(f"{__name__}.{_module.name}")
