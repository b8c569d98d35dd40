"""The count of code lines: analysis/code_lines.py."""

import runpy

import pytest

from tests.helpers.places import ROOT

pytestmark = pytest.mark.one_stack

TEXT = '''"""Docstring of the module,
of two lines.
"""

import math  # a comment beside code


# a comment
def area(radius: float) -> float:
    """Docstring of the function."""

    def square(x: float) -> float:
        return x * x

    text = """A string that is a value
counts, with all its lines."""
    return (
        math.pi
        * square(radius)
    )
'''


@pytest.mark.parametrize(
    ("text", "lines"),
    [("", 0), ("# comment\n", 0), ('"""Docstring."""\n', 0), ("x = 1\n\ny = 2\n", 2), (TEXT, 10)],
)
def test_code_lines(text: str, lines: int) -> None:
    count = runpy.run_path(str(ROOT / "analysis" / "code_lines.py"))["code_lines"]
    assert count(text) == lines
