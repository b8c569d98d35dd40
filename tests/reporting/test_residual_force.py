"""Which law is wanted, and the motions that a report plays."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pbrl_ppl.criticism.innovations import FEATURES, PRODUCTS
from pbrl_ppl.criticism.results import Unexplained, diverged_after
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model
from pbrl_ppl.modes import trajectory_mode
from pbrl_ppl.posterior import Fit
from pbrl_ppl.reporting.loop_plots import plot_laws
from pbrl_ppl.reporting.motion import animation, distance, divergence_in_words, held_out_motions
from pbrl_ppl.reporting.residual_force import bin_means, find_laws
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.free_puck import DISC, Disc
from tests.helpers.made_up import changed, made_up
from tests.helpers.revised import DRAG, diverging, recordings, revised, unexplained

pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")


def test_no_law_where_nothing_is_unexplained_or_recorded() -> None:
    assert find_laws(revised()) == []
    assert find_laws(made_up("unexplained")) == []


def test_the_law_that_is_wanted_is_the_drag() -> None:
    laws = find_laws(unexplained())
    first = laws[0]
    assert (first.quantity, first.residual.dimension, first.residual.unit) == (
        "velocity x",
        "vx",
        "N",
    )
    assert first.curve.share > 0.8
    slope = np.polyfit(first.x, first.residual.values, 1)[0]
    assert slope == pytest.approx(-DRAG, rel=0.25)
    assert "q" in first.curve.form
    assert len(plot_laws(laws).axes) == len(laws)
    # where the test of dependence passed, or names another quantity, nothing speaks against it
    left = Unexplained("puck", "y", "nothing that was recorded", 0.5, 0.001, "y is off")
    for other in (left, replace(left, body=""), replace(left, depends_on="colour")):
        assert find_laws(changed(unexplained(), unexplained=other)) == []
    named = replace(left, depends_on="velocity y")
    others = find_laws(changed(unexplained(), unexplained=named))
    assert (others[0].quantity, others[0].residual.dimension) == ("velocity y", "vy")


def test_a_law_may_follow_whatever_an_error_may_depend_on() -> None:
    left = replace(unexplained().unexplained, depends_on="position x × velocity x")
    laws = find_laws(changed(unexplained(), unexplained=left), most=100)
    named = {law.quantity: law for law in laws}
    assert set(named) <= {*FEATURES, *PRODUCTS}
    x, v = (named[name].x for name in ("position x", "velocity x"))
    np.testing.assert_allclose(named[left.depends_on].x, x * v)


def test_bins_hold_about_as_many_and_equal_values_share_one() -> None:
    even = bin_means(np.arange(100.0), np.arange(100.0))
    assert even.centre.tolist() == even["mean"].tolist() == [10 * i + 4.5 for i in range(10)]
    two = bin_means(np.repeat([0.0, 1.0], 50), np.ones(100))
    assert two.centre.tolist() == [0.0, 1.0]


def test_motions_are_those_of_the_recording_worst_first() -> None:
    findings, (_, test) = revised(), recordings()
    motions = held_out_motions(findings)
    before = [distance(findings.scene, motion, motion.before) for motion in motions]
    after = [distance(findings.scene, motion, motion.after) for motion in motions]
    assert len(motions) == 6 and before == sorted(before, reverse=True)
    assert before[0] > 0.2 and max(after) < 0.3 * before[0]
    places = {str(label): i for i, label in enumerate(test.dataset["trajectory"].values)}
    for motion in motions:
        measured = test.dataset["observed"].values[places[motion.name], :, :, :3]
        np.testing.assert_array_equal(motion.measured, measured)
        np.testing.assert_allclose(motion.before[0], measured[0], rtol=1e-12)
        np.testing.assert_allclose(motion.after[0], measured[0], rtol=1e-12)
    data = animation(findings, motions)
    assert data["models"] == ["before", "after"]
    assert data["bodies"] == [{"name": "puck", "outline": None, "radius": 0.2}]
    for drawn, motion in zip(data["motions"], motions, strict=True):
        np.testing.assert_allclose(drawn["after"], motion.after, atol=1e-5)
        low, high = np.array(drawn["box"])
        assert (low < motion.measured[..., :2].min(axis=(0, 1))).all()
        assert (high > motion.measured[..., :2].max(axis=(0, 1))).all()
    # y that was not measured is left out of the picture
    measured = motions[0].measured.copy()
    measured[10, 0, 1] = np.nan
    gap = animation(findings, [replace(motions[0], measured=measured)])["motions"][0]
    assert gap["measured"][10][0][1] is None and gap["before"][10][0][1] is not None


def test_motions_are_drawn_up_to_where_they_diverge() -> None:
    findings = diverging()
    motions = held_out_motions(findings)
    for motion in motions:
        end = diverged_after(motion.time, motion.after)
        rows = int((motion.time <= end).sum())
        assert 2 <= rows < len(motion.time)
        assert np.isfinite(motion.after[:rows]).all() and np.isnan(motion.after[rows:]).all()
        assert np.isfinite(motion.before).all()
        assert distance(findings.scene, motion, motion.after) == np.inf
    ends = [diverged_after(motion.time, motion.after) for motion in motions]
    assert divergence_in_words(motions) == (
        "The revised model's prediction of 6 of the 6 held-out recordings below diverges, at the"
        f" earliest after {min(ends):.3f} s."
    )
    data = animation(findings, motions)
    for drawn, end in zip(data["motions"], ends, strict=True):
        assert drawn["diverged"] == [None, end]
        assert drawn["distance"][0] > 0 and drawn["distance"][1] is None
        assert np.isfinite(np.array(drawn["box"])).all()
    assert divergence_in_words(held_out_motions(revised())) == ""


def test_a_motion_of_which_nothing_was_measured_is_not_off_by_nothing() -> None:
    motion = held_out_motions(revised())[0]
    blind = replace(motion, measured=np.full_like(motion.measured, np.nan))
    assert np.isnan(distance(revised().scene, blind, blind.before))


def test_motions_start_from_velocities_fitted_to_the_first_rows() -> None:
    """Where only poses were measured; two rows of them give a velocity that is far off."""
    disc = Disc(trajectories=6, intervals=12)
    rng = np.random.default_rng(1)
    states = disc.frame(rng)
    coarse = states.assign(x=states["x"] + rng.normal(0.0, 0.02, len(states)))
    history = History.from_dataframe(coarse.drop(columns=["vx", "vy", "omega"]), DISC)
    model = physics_model(DISC, history, (), likelihood="trajectories")
    fitted = fit(model, method="laplace", seed=1, draws=20, progress=False)
    found = Fit.of(fitted)
    mode = trajectory_mode(found.problem, *found.best)
    findings = unexplained()
    models = {
        name: replace(getattr(findings, name), innovations=mode) for name in ("declared", "revised")
    }
    findings = changed(findings, held_out=history, **models)
    truth = states.groupby("trajectory")["x"].last().to_numpy()
    off = [
        float(motion.before[-1, 0, 0] - truth[int(motion.name)])
        for motion in held_out_motions(findings)
    ]
    # an error of 0.02 m of both rows is one of 0.28 m/s, and of 0.34 m at the end
    assert np.sqrt(np.mean(np.square(off))) < 0.12


def test_without_held_out_trajectories_nothing_is_played() -> None:
    assert held_out_motions(made_up()) == []
    assert animation(made_up(), []) is None


def test_a_motion_of_millimetres_and_milliseconds_is_not_rounded_away() -> None:
    """The same as that of metres, to 1e-5 of the view."""
    here, seen = [], held_out_motions(revised())[0]
    for size, pace in ((1.0, 1.0), (1e-3, 1e-2)):
        puck = Body("puck", Shape.circle(0.2 * size))
        loop = SimpleNamespace(scene=Scene(time_step=0.1 * pace, bodies=(puck,)), added=())
        unit = np.array([size, size, 1.0])
        poses = {name: unit * getattr(seen, name) for name in ("measured", "before", "after")}
        (drawn,) = animation(loop, [replace(seen, time=pace * seen.time, **poses)])["motions"]
        here.append(
            [np.array(drawn["after"]) / unit, np.array(drawn["time"]) / pace]
            + [np.array(drawn[name]) / size for name in ("box", "distance")]
        )
    for one, other in zip(*here, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-4)
