"""The same recording in other units, digits, frames, epochs or sizes gives the same answers."""

import json
from functools import cache

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.physics import Physics
from tests.helpers.examples import EXAMPLES
from tests.helpers.free_puck import Disc
from tests.helpers.similar import in_frame, similar, similar_history
from tests.helpers.variants import (
    VARIANTS,
    answer,
    changed_names,
    deviation,
    in_other_units,
    named,
    nudged,
)

#: Effects that act by the time.
LAWS = (*catalogue, *EXAMPLES.values())
TIMED = [one for one in LAWS if getattr(one.stage, "timed", False)]
#: Standard deviations by which posteriors may differ: a millionth but where digits are lost, or the
#: noise of x and y is another.
BOUNDS = {"far": 1e-3, "turned": 0.3}
DISC = Disc(trajectories=4, intervals=15, drag=1.0)


@cache
def history() -> History:
    """Return a disc's recording, with a drag that the scene lacks."""
    return History.from_dataframe(DISC.frame(np.random.default_rng(1)), DISC.scene)


@cache
def closed() -> pp.Loop:
    """Return the loop on it."""
    return pp.close_loop(DISC.scene, history(), method="laplace", seed=1)


def test_other_units_are_read_to_the_last_digits(tmp_path) -> None:
    """In mm, degrees and milliseconds since 1970, of which a float has a fifth of a microsecond."""
    _, read = in_other_units(history(), DISC.scene, tmp_path)
    for name in ("observed", "action", "start"):
        np.testing.assert_allclose(read.dataset[name], history().dataset[name], rtol=1e-14)
    np.testing.assert_allclose(read.elapsed, history().elapsed, atol=3e-7)


def test_a_history_from_before_laws_knew_where_it_began_is_read() -> None:
    older = History(history().dataset.drop_vars("began"))
    np.testing.assert_array_equal(older.elapsed, older.dataset["clock"])


@pytest.mark.parametrize("step", [1e-4, 1e-2, 1.0])
def test_stamps_since_1970_of_any_step_are_read(step, tmp_path) -> None:
    """Of a step of 0.1 ms a stamp of 1.7e9 s has 0.2 %; all commands and states are kept."""
    scales = (1.0, 1.0, step / DISC.scene.time_step)
    scene = similar(DISC.scene, *scales)
    there = similar_history(history(), DISC.scene, *scales)
    for own, read in (
        in_other_units(there, scene, tmp_path),
        in_frame(there, scene, later=1.7e9),
    ):
        assert read.dataset.sizes == there.dataset.sizes
        np.testing.assert_allclose(read.elapsed, there.elapsed, atol=3e-7)
        np.testing.assert_allclose(read.dataset["observed"], there.dataset["observed"], rtol=1e-14)
        assert own.time_step == scene.time_step


@pytest.mark.parametrize("other", ["units", "digits"])
def test_posterior_is_the_same_to_a_millionth(other, tmp_path) -> None:
    """Means and standard deviations of single transitions; measured: 1e-11."""
    scene = DISC.scene
    same = (
        in_other_units(history(), scene, tmp_path)[1]
        if other == "units"
        else nudged(history(), scene, 3)
    )
    here, there = (
        pp.fit(pp.physics_model(scene, one), method="laplace", seed=1, progress=False)
        for one in (history(), same)
    )
    for name, draws in here.posterior.data_vars.items():
        sd = draws.std(("chain", "draw")).to_numpy()
        for of in ("mean", "std"):
            first, second = (
                getattr(one[name], of)(("chain", "draw")).to_numpy()
                for one in (draws.to_dataset(name=name), there.posterior)
            )
            np.testing.assert_allclose((second - first) / np.where(sd > 0, sd, first), 0, atol=1e-6)
    modes = [json.loads(one.attrs["mode"]) for one in (here, there)]
    assert modes[1]["parameters"] == pytest.approx(modes[0]["parameters"], rel=1e-6)
    assert modes[1]["noise"] == pytest.approx(modes[0]["noise"], rel=1e-6)


@pytest.mark.parametrize("began", [500.0, 1.7e9])
@pytest.mark.parametrize("effect", TIMED, ids=lambda effect: effect.name)
def test_laws_know_the_time_since_a_trajectory_began_alone(effect, began) -> None:
    """Batteries, drifts and shaken tables do not depend on the year, nor what is scanned of them.

    At 1.7e9 s a float has 2.4e-7 s.
    """
    scene = with_units(DISC.scene, history())
    _, later = in_frame(history(), scene, later=began)
    effects = attach(scene, [effect.on("puck")])
    rng, predicted = np.random.default_rng(0), []
    for data in (history(), later):
        problem = Problem.of(Physics(scene, effects), data)
        if not predicted:
            phi = np.array([prior.sample(rng, 1)[0] for prior in problem.layout.priors])
        predicted.append(problem.predict(phi[None]))
    np.testing.assert_allclose(predicted[1], predicted[0], atol=1e-5)
    if effect.scan is not None:
        grids = [effect.scan(scene, one, scene.body("puck")) for one in (history(), later)]
        np.testing.assert_allclose(grids[1], grids[0], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_loop_gives_the_same_answer(name, tmp_path) -> None:
    """The verdict, the names, what is confounded, sizes and errors."""
    variant = VARIANTS[name]
    scene, same = variant.change(history(), DISC.scene, tmp_path)
    here, there = closed(), pp.close_loop(scene, same, method="laplace", seed=1)
    assert there.verdict == here.verdict == "effects-added"
    first, second = answer(here), answer(there)
    assert changed_names(first, second) == []
    assert [*named(first)] == [*named(second)] == [("linear_drag", "puck")]
    assert deviation(first, second, variant) < BOUNDS.get(name, 1e-6)
    assert there.after.normalised_rmse == pytest.approx(here.after.normalised_rmse, rel=1e-2)
