"""The default sampler gives the posteriors that long runs gave.

``analysis/benchmarks/reference_posteriors.py FOLDER`` stored them, and stores them again where a
model or a prior was changed on purpose.
"""

from dataclasses import replace

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.model import problem_in

#: Least effective sample size: with fewer draws, differences would hide behind the tolerance.
LEAST = 250
CASES = (
    "cart-linear-drag transitions",
    "cart-null transitions",
    "cart-slope transitions",
    "cart-thrust-bias transitions",
    pytest.param("cart-null trajectories", marks=pytest.mark.slow),
)


@pytest.fixture
def reference(benchmarks):
    import reference_posteriors

    return reference_posteriors


@pytest.mark.parametrize("name", CASES)
def test_means_and_deviations_are_those_of_long_runs(name, reference, shared_data) -> None:
    """Of every parameter, within Monte Carlo error of both runs: false alarm 6e-5 a case.

    Bonferroni over means and standard deviations, each asymptotically normal.
    """
    case, kind = name.split()
    if not (shared_data / case).is_dir():
        pytest.skip(f"no recording {case} in {shared_data}")
    stored = reference.load_reference()[name]
    model, mode = reference.declared(shared_data, case, kind)
    if mode is not None:  # the likelihood is linearised there
        sd = np.array([stored["moments"][label].sd for label in problem_in(model).layout.labels])
        off = np.abs(mode.phi - stored["mode"]) / sd
        assert off.max() < 0.05, "not the sampler: the search finds another mode; see the docstring"
    idata = pp.fit(model, seed=5, start=mode, progress=False)
    found = reference.moments(model, idata)
    assert min(one.size for one in found.values()) > LEAST
    off = reference.differences(found, stored["moments"])
    bound = reference.bound(len(off))
    assert {name: z for name, z in off.items() if abs(z) > bound} == {}


def test_another_posterior_is_seen(reference) -> None:
    """A mean or a deviation that is off by a fifth or a sixth, at the least sample size."""
    stored = reference.load_reference()["cart-null transitions"]["moments"]
    same = {label: replace(one, mean_error=one.sd / np.sqrt(800)) for label, one in stored.items()}
    off = reference.differences(same, stored)
    bound = reference.bound(len(off))
    assert max(map(abs, off.values())) == 0.0
    assert 4.0 < bound < 5.0
    label = "mass[cart]"
    mass = same[label]
    for other in (
        replace(mass, mean=mass.mean + 0.2 * mass.sd),
        replace(mass, sd=1.17 * mass.sd, mean_error=1.17 * mass.mean_error),
    ):
        off = reference.differences(same | {label: other}, stored)
        assert [name for name, z in off.items() if abs(z) > bound] in (
            [f"mean of {label}"],
            [f"sd of {label}"],
        )
    with pytest.raises(ValueError, match="parameters are"):
        reference.differences({label: mass}, stored)
