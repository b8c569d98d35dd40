"""Findings with the posteriors of a quick fit, of a puck with drag."""

from dataclasses import replace
from functools import cache

import numpy as np
import xarray as xr

from pbrl_ppl.criticism.results import Estimate, Law, Loop, Unexplained
from pbrl_ppl.effects import catalogue
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model
from pbrl_ppl.modes import trajectory_mode
from pbrl_ppl.posterior import Fit
from pbrl_ppl.posterior.store import from_groups, groups
from pbrl_ppl.sampling import fit
from tests.helpers.free_puck import DISC, Disc
from tests.helpers.made_up import changed, made_up

DRAG = 0.8


@cache
def recordings() -> tuple[History, History]:
    """Return a training and a test recording."""
    dragged = Disc(trajectories=6, intervals=12, drag=DRAG)
    frames = (dragged.frame(np.random.default_rng(seed)) for seed in (1, 2))
    train, test = (History.from_dataframe(frame, DISC) for frame in frames)
    return train, test


@cache
def revised() -> Loop:
    """Findings as made up, with the posteriors of a puck without drag and with it."""
    train, test = recordings()
    drag = [effect for effect in catalogue if effect.name == "linear_drag"]
    models = (physics_model(DISC, train, e, likelihood="trajectories") for e in ((), drag))
    before, after = (
        Fit.of(fit(model, method="laplace", seed=1, draws=100, progress=False)) for model in models
    )
    modes = tuple(trajectory_mode(one.problem, *one.best) for one in (before, after))
    size = Estimate(DRAG, 0.01, (DRAG - 0.02, DRAG + 0.02), "kg/s")
    added = Law(
        "linear_drag", "puck", statistic=99.0, p_value=1e-9, parameters={"coefficient": size},
        elpd_difference=9.0, elpd_difference_se=1.0,
    )  # fmt: skip
    found = made_up()
    return changed(
        found,
        scene=DISC,
        candidates=tuple(replace(one, body="puck") for one in found.candidates),
        added=(added,),
        declared=replace(found.declared, fit=before, innovations=modes[0]),
        revised=replace(found.revised, fit=after, innovations=modes[1]),
        held_out=test,
    )


def unexplained() -> Loop:
    """The same where no effect has a name."""
    left = Unexplained("puck", "vx", "velocity x", 0.5, 0.001, "vx of puck depends on velocity x")
    known, found = revised(), made_up("unexplained")
    model = {"fit": known.declared.fit, "innovations": known.declared.innovations}
    return changed(
        found,
        scene=DISC,
        candidates=tuple(replace(one, body="puck") for one in found.candidates),
        unexplained=left,
        declared=replace(found.declared, **model),
        revised=replace(found.revised, **model),
        held_out=known.held_out,
    )


@cache
def diverging() -> Loop:
    """The same as revised, with a drag that pushes, so that the revised model diverges."""
    found = revised()
    after = found.revised.innovations
    drag = after.problem.layout.labels.index("linear_drag_coefficient[puck]")
    far_off = np.where(np.arange(len(after.phi)) == drag, -60.0, after.phi)
    datasets = groups(found.posterior_after)
    draws = datasets["posterior"]
    name = "linear_drag_coefficient"
    pushed = draws.assign({name: xr.full_like(draws[name], -60.0)})
    rollout, far = found.forecasts.rollout, dict.fromkeys(found.after.rollout_rmse, np.inf)
    lost = rollout.after.copy()
    lost[12:] = np.nan
    attrs = dict(found.posterior_after.attrs)
    fit = Fit(found.revised.fit.problem, from_groups(datasets | {"posterior": pushed}, attrs))
    return changed(
        found,
        revised=replace(found.revised, fit=fit, innovations=replace(after, phi=far_off)),
        after=replace(found.after, rollout_rmse=far),
        rollout=replace(rollout, after=lost),
    )


def every_verdict() -> dict[str, Loop]:
    """Return findings of each verdict, of effects beside which more is missing, and diverging."""
    added, left, nothing = revised(), unexplained(), made_up("adequate")
    worse = replace(added.after, normalised_rmse=1.8)
    return {
        "adequate": changed(
            left,
            verdict="adequate",
            unexplained=None,
            tests=nothing.tests,
            acceleration=nothing.acceleration,
            before=nothing.before,
            after=nothing.after,
        ),
        "effects-added": added,
        "unexplained": left,
        "unexplained-beside": changed(
            added,
            verdict="unexplained",
            unexplained=left.unexplained,
            tests=left.tests,
            acceleration=left.acceleration,
            after=worse,
        ),
        "not-converged": replace(added, verdict="not-converged"),
        "diverging": diverging(),
    }
