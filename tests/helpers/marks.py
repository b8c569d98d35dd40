"""Marks for tests."""

import pytest

# PyMC 6 compiles to numba, which has no truncated normal draws and cannot compile a random
# function of our own: it says that it runs them in Python. Nothing is wrong.
OBJECT_MODE = pytest.mark.filterwarnings("ignore:Numba will use object mode:UserWarning")
