"""Command line: one module for commands that belong together.

Imports of the package stand inside the functions: PyMC takes seconds to load, and ``--help`` or a
mistyped path should not wait for it.
"""

from pbrl_ppl.cli.app import main as main
