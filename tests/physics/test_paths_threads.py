"""One Simulator that several threads of Python use at once."""

import subprocess
import sys

import pytest

from pbrl_ppl.physics import calls
from tests.helpers.places import ROOT

pytestmark = pytest.mark.one_stack

CODE = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from tests.helpers.engines import cart, proposals

sim, start, actions = cart(walls=True)
phi = proposals(sim.physics.layout, 20)
expected = sim(phi, start, actions)
with ThreadPoolExecutor(3) as pool:
    results = list(pool.map(lambda _: sim(phi, start, actions), range(9)))
same = [np.array_equal(result, expected, equal_nan=True) for result in results]
raise SystemExit(not all(same))
"""


@pytest.mark.skipif(not calls.AVAILABLE, reason="the plain path builds its worlds in each call")
def test_calls_at_the_same_time_do_not_disturb_each_other() -> None:
    """Chains in threads share the Op; the engine would abort the whole process, hence a child."""
    done = subprocess.run(
        [sys.executable, "-c", CODE], cwd=ROOT, timeout=60, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
