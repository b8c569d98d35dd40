"""Logs as sensors make them: coarse encoders, angles alone, lost rows, coordinates that never move.

Each is looked at clean and with a drag: through the mode and the ranking, without the loop.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.effects import candidates, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE
from tests.helpers.free_puck import DISC, Disc, fitted
from tests.helpers.places import MODELS

pytestmark = pytest.mark.one_stack

#: What is differentiated: scans are tested on their own.
EFFECTS = tuple(effect for effect in catalogue if effect.scan is None)
#: Engine steps that leave nothing of an engine's error.
FINE = DISC.replace(substeps=40)
DRAG = 0.5  # kg/s
DAMPING = 0.02  # N m s


def found(scene: Scene, frame: pd.DataFrame, name: str):
    """The ranking at the mode, and mean and sd of an effect once it is declared."""
    history = History.from_dataframe(frame, scene, estimate_velocities=True)
    mode = fitted(scene, history)
    ranked = rank_candidates(mode, candidates(scene, mode.problem.physics.effects, EFFECTS))
    (effect,) = (effect for effect in EFFECTS if effect.name == name)
    mode = fitted(scene, history, (effect,))
    (place,) = (i for i, each in enumerate(mode.problem.layout.labels) if each.startswith(name))
    return ranked, mode.phi[place], np.sqrt(mode.covariance[place, place])


def significant(ranked) -> list[str]:
    """A false alarm in one clean log of a hundred: p-values are corrected."""
    return [one.candidate.effect for one in ranked if one.candidate.p_value < 0.01]


def encoder(frame: pd.DataFrame) -> pd.DataFrame:
    """Positions alone, in steps of 5 mm and 1024 counts a turn: larger than the sensors' noise."""
    steps = {"x": 0.005, "y": 0.005, "theta": 2 * np.pi / 1024}
    rounded = {name: (frame[name] / step).round() * step for name, step in steps.items()}
    return frame.assign(**rounded).drop(columns=["vx", "vy", "omega"])


def lossy(frame: pd.DataFrame) -> pd.DataFrame:
    """A fifth of the rows are lost, but for each trajectory's first and last."""
    ends = frame["step"].isin([0, frame["step"].max()])
    lost = (np.random.default_rng(4).random(len(frame)) < 0.2) & ~ends
    return frame.assign(**{name: frame[name].mask(lost) for name in STATE})


def rail(frame: pd.DataFrame) -> pd.DataFrame:
    """Neither y nor the angle ever moves, nor has noise."""
    never = ["y", "vy", "theta", "omega", "force_y", "torque"]
    return frame.assign(**{name: 0.0 * frame[name] for name in never})


@pytest.mark.parametrize("recorded", [encoder, lossy, rail])
def test_a_drag_is_found_in_what_a_sensor_leaves(
    recorded: Callable[[pd.DataFrame], pd.DataFrame],
) -> None:
    def frame(drag: float) -> pd.DataFrame:
        return recorded(Disc(8, 15, FINE, drag=drag).frame(np.random.default_rng(3)))

    clean, mean, sd = found(FINE, frame(0.0), "linear_drag")
    assert significant(clean) == []
    assert mean < 4 * sd  # that is all there is of it
    ranked, mean, sd = found(FINE, frame(DRAG), "linear_drag")
    assert ranked[0].candidate.effect == "linear_drag"
    assert ranked[0].candidate.p_value < 1e-6
    assert abs(mean - DRAG) < 3 * sd  # a false alarm in three hundred
    assert sd < 0.02 * DRAG


@pytest.mark.parametrize(
    ("rate", "trajectories"), [(100, 4), pytest.param(1000, 2, marks=pytest.mark.slow)]
)
def test_a_pivots_damping_is_found_from_the_angle_alone(rate, trajectories, make_history) -> None:
    """A second of swinging; the angle's noise is the same in ten times as many rows."""
    arm = Scene.load(MODELS / "pendulum" / "scene.toml")
    scene = arm.replace(time_step=1 / rate, substeps=2000 // rate + 2)
    setup = replace(
        make_history.PENDULUM, time_step=1 / rate, step=min(1e-3, 0.2 / rate), n_intervals=rate,
        n_train=trajectories, n_test=1,
    )  # fmt: skip

    def frame(damping: float) -> pd.DataFrame:
        train, _ = make_history.simulate(9, setup, pivot_damping=damping)
        return train.assign(**dict.fromkeys(("x", "y", "vx", "vy", "omega"), np.nan))

    clean, mean, sd = found(scene, frame(0.0), "pivot_damping")
    assert significant(clean) == []
    assert mean < 4 * sd
    ranked, mean, sd = found(scene, frame(DAMPING), "pivot_damping")
    assert ranked[0].candidate.effect == "pivot_damping"
    assert abs(mean - DAMPING) < 3 * sd
    assert sd < 0.02 * DAMPING
