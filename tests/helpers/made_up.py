"""Small findings of each verdict, without a fit."""

from dataclasses import replace
from typing import Any

import arviz as az
import numpy as np

from pbrl_ppl.criticism.results import (
    Acceleration,
    ComparedModel,
    Errors,
    Estimate,
    Forecasts,
    Found,
    KindOfTest,
    Law,
    Loop,
    Misfit,
    Numerical,
    Recordings,
    ResidualTest,
    Rollout,
    Unexplained,
)
from pbrl_ppl.posterior import Fit
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import STATE, STATE_UNITS

#: Where a loop's findings are in its records.
PLACES = {
    **dict.fromkeys(("candidates", "added", "small", "lesser", "hypotheses", "lengths"), "found"),
    **dict.fromkeys(
        ("provenance", "held_out", "velocities_not_used", "bad_frames", "drawn"), "data"
    ),
    "tests": "misfit",
    **dict.fromkeys(("noise_floor", "rollout", "horizon"), "forecasts"),
}

DRAG = "a force against the motion that grows with the speed"


def idata(posterior: dict[str, np.ndarray], dims: dict[str, list[str]]) -> Any:
    """Return an InferenceData or a DataTree, as the installed ArviZ has it."""
    coords = {"body": ["cart"], "linear_drag_body": ["cart"], "state": list(STATE)}
    if az.__version__.startswith("0."):
        return az.from_dict(posterior, coords=coords, dims=dims)
    return az.from_dict({"posterior": posterior}, coords=coords, dims=dims)


def made_up_posterior(stuck: bool = False) -> Any:
    rng = np.random.default_rng(1)
    draws = {
        "mass": 6.5 + 0.1 * rng.normal(size=(4, 500, 1)),
        "w_x": -0.25 + 0.01 * rng.normal(size=(4, 500, 1)),
        "linear_drag_coefficient": 3.0 + 0.1 * rng.normal(size=(4, 500, 1)),
        "sigma": np.exp(0.1 * rng.normal(size=(4, 500, 6))),
    }
    if stuck:
        draws["w_x"] += np.arange(4).reshape(4, 1, 1)
    dims = {"mass": ["body"], "w_x": ["body"], "sigma": ["state"]}
    return idata(draws, dims | {"linear_drag_coefficient": ["linear_drag_body"]})


def made_up_errors(times: float) -> Errors:
    scales = dict(zip(STATE, (0.002, 0.002, 0.004, 0.01, 0.01, 0.02), strict=True))
    # drag is seen in the velocities more than in the rest
    grown = {d: s * (times if d in ("vx", "vy") else times**0.5) for d, s in scales.items()}
    far = {d: s * times * 4 for d, s in scales.items()}
    return Errors(grown, far, normalised_rmse=times, elpd=3000.0 - 300.0 * times)


def changed(loop: Loop, **values: Any) -> Loop:
    """Return a loop with other findings, by their names in whichever of its records holds them."""
    for name, value in values.items():
        if name in ("before", "after"):
            place = "declared" if name == "before" else "revised"
            loop = replace(loop, **{place: replace(getattr(loop, place), errors=value)})
        elif name in PLACES:
            record = replace(getattr(loop, PLACES[name]), **{name: value})
            loop = replace(loop, **{PLACES[name]: record})
        else:
            loop = replace(loop, **{name: value})
    return loop


def made_up(verdict: str = "effects-added", stuck: bool = False) -> Loop:
    """Small findings of each verdict, without a fit."""
    rng = np.random.default_rng(0)
    typical = {"force": 20.0, "torque": 10.0, "speed": 1.5, "turn_rate": 1.5, "range": 5.0}
    scene = Scene(time_step=0.1, bodies=(Body("cart", Shape.box(1.0, 0.6), typical=typical),))
    time = 0.1 * np.arange(31)
    turn = 2.8 + 1.5 * time
    motion = np.stack(
        [0.6 * time, np.sin(time), turn, 0.6 + 0 * time, np.cos(time), 1.5 + 0 * time]
    )
    wrapped = motion.copy()
    wrapped[2] = np.angle(np.exp(1j * turn))
    measured = wrapped + 0.01 * rng.normal(size=motion.shape)
    measured[1, 10:14] = np.nan
    off = motion * (1 + 0.05 * time) + 0.02 * time
    off[2] = np.angle(np.exp(1j * off[2]))
    found = verdict == "effects-added"
    candidates = tuple(
        Law(
            effect,
            "cart",
            sentence,
            s,
            dof,
            p,
            estimate,
            units,
            share,
            detectable=dict.fromkeys(estimate, 0.02),
        )
        for effect, sentence, s, dof, p, estimate, units, share in (
            (
                "linear_drag",
                DRAG,
                419.0,
                1,
                1e-80,
                {"coefficient": 3.01},
                {"coefficient": "kg/s"},
                0.48,
            ),
            (
                "quadratic_drag",
                "a force that grows with its square",
                401.5,
                1,
                1e-75,
                {"coefficient": 2.2},
                {"coefficient": "kg/m"},
                0.4,
            ),
            (
                "constant_force",
                "the floor slopes",
                11.0,
                2,
                0.04,
                {"force_x": 0.2, "force_y": -0.1},
                {"force_x": "N", "force_y": "N"},
                0.9,
            ),
            (
                "inertia_scale",
                "mass is not spread evenly",
                0.0,
                1,
                1.0,
                {"scale": 1.0},
                {"scale": "1"},
                0.0004,
            ),
        )
    )
    if not found:
        candidates = tuple(
            replace(c, statistic=c.statistic / 200, p_value=0.37) for c in candidates
        )
    added = Law(
        "linear_drag",
        "cart",
        DRAG,
        419.0,
        p_value=1e-80,
        parameters={"coefficient": Estimate(3.0, 0.1, (2.81, 3.19), "kg/s")},
        not_separable_from=("quadratic_drag",),
        elpd_difference=210.0,
        elpd_difference_se=19.0,
    )
    remains = Unexplained(
        "cart", "omega", "omega", 0.34, 0.002, "its omega is off in a way that depends on omega"
    )
    fit = Fit(None, made_up_posterior(stuck))  # a problem is not made up, nor is a mode
    before = made_up_errors(2.4 if verdict != "adequate" else 1.01)
    after = made_up_errors(1.02) if found else before
    predicted = off.T if found else wrapped.T
    rollout = Rollout("cart", time, STATE, STATE_UNITS, measured.T, predicted, wrapped.T)
    versions = {"pymc": "5.28"}
    return Loop(
        scene=scene,
        verdict=verdict,
        unexplained=remains if verdict == "unexplained" else None,
        numerical=Numerical(10, 40, 0.83) if found else Numerical(10, 10, 0.012),
        data=Recordings({"seed": 1, "versions": versions, "data_sha256": "ab" * 32}),
        found=Found(candidates, (added,) if found else ()),
        declared=ComparedModel(fit, None, before),
        revised=ComparedModel(fit, None, after),
        misfit=Misfit(made_up_tests(verdict), None),
        acceleration=made_up_acceleration(verdict),
        forecasts=Forecasts(made_up_errors(1.0), rollout, 20),
    )


def made_up_tests(verdict: str) -> tuple[ResidualTest, ...]:
    whole = verdict != "unexplained"
    said = "no acceleration is left" if whole else "an acceleration of 0.2 rad/s² in omega is left"
    p_value, share = (0.4, 0.001) if whole else (1e-9, 0.34)
    return (
        ResidualTest(KindOfTest.ACCELERATION, p_value, share, whole, said),
        ResidualTest(
            KindOfTest.WHITENESS, 0.3, 0.05, True, "errors say nothing of those of the next"
        ),
    )


def made_up_acceleration(verdict: str) -> Acceleration:
    names = ("vx", "vy", "omega")
    clean = dict(zip(names, (0.002, 0.002, 0.003), strict=True))
    off = {name: 50 * value for name, value in clean.items()}
    before, after = {
        "adequate": (clean, clean),
        "effects-added": (off, clean),
        "unexplained": (off, off),
    }.get(verdict, (off, off))
    shares = [{name: value / 2 for name, value in each.items()} for each in (before, after)]
    return Acceleration(before, after, *shares, dict.fromkeys(names, after is off))
