"""The comparison of samplers gives each the same wall-clock seconds."""

import pytest


@pytest.mark.parametrize("method", ["smc", "metropolis"])
def test_each_method_is_given_the_same_seconds(benchmarks, monkeypatch, method) -> None:
    """A clock of our own: draws of one method cost a hundred times those of the other."""
    import inference

    cost = {"smc": 0.01, "metropolis": 1.0}
    asked = []

    def fit(model, *, method, draws, tune, **options):
        asked.append((method, draws, tune, options["chains"]))
        return draws

    monkeypatch.setattr(inference.pp, "fit", fit)
    monkeypatch.setattr(inference, "find_mode", lambda problem, seed: None)
    monkeypatch.setattr(
        inference, "seconds", lambda run: (d := run(), (3 + cost[method] * d, d))[1]
    )
    monkeypatch.setattr(inference, "judged", lambda took, draws: (took, 1.0, float(draws)))
    monkeypatch.setattr(inference, "PILOT", {method: inference.PILOT[method]})
    ((key, what, _, rate),) = inference.measure_methods()
    assert key == f"ess_per_second_{method}"
    took = 3 + cost[method] * asked[-1][1]
    assert took == pytest.approx(inference.EFFORT, rel=0.02)
    assert rate == pytest.approx(asked[-1][1] / took)
    assert f"{took:.0f} s" in what
    assert {each[3] for each in asked} == {4}
    default = inference.METHODS[method]
    assert asked[-1][2] == pytest.approx(asked[-1][1] * default.tune / default.draws, abs=1)
