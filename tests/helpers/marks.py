"""Marks for tests."""

import pytest

# PyMC 6 compiles to numba, which has no truncated normal draws and cannot compile custom random
# functions. It warns that it runs them in Python, which is correct.
OBJECT_MODE = pytest.mark.filterwarnings("ignore:Numba will use object mode:UserWarning")
