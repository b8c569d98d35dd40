# %% [markdown]
# # Writing your own effect
#
# The catalogue has effects of many rigs: drags, springs, delays, offsets. An effect that is
# particular to your system takes a dozen lines: a law, its parameters with priors, and a sentence
# for the report. You pass it as an argument; there is no registry.

# %%
# %matplotlib inline
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.errors import BoundWarning, ConvergenceWarning, UninformedWarning
from pbrl_ppl.reporting import plot_candidates

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())

# %% [markdown]
# The constants below set how long this takes.

# %% tags=["parameters"]
TRAJECTORIES, INTERVALS = 12, 20  # of the simulated recording
METHOD = "importance"  # of the posteriors; "laplace" is quick
OUT = ROOT / "out" / "notebooks"

# %%
OUT.mkdir(parents=True, exist_ok=True)
# what is expected: a puck that touches nothing does not inform r and mu_c; short chains
for kind in (UninformedWarning, BoundWarning, ConvergenceWarning):
    warnings.simplefilter("ignore", kind)

# %% [markdown]
# ## The effect
#
# A fan in the middle of the room makes the air circulate: a force perpendicular to the line to the
# middle that grows with the distance, F = k (-y, x). The law runs inside the compiled engine loop,
# so it is plain arithmetic on four arrays: `state` (x, y, theta, vx, vy, omega), `command` (the
# wrench as commanded), `parameters`, and `wrench`, to which it adds (N, N, N m). At its null value,
# 0 by default, the effect must vanish.


# %%
def law(state, command, parameters, wrench):
    """A force across the line to the middle of the room."""
    wrench[0] -= parameters[0] * state[1]
    wrench[1] += parameters[0] * state[0]


swirl = pp.Effect(
    "swirl",
    (pp.EffectParameter("strength", "N/m", pp.Prior("normal", sigma=5.0)),),
    "a force round the middle of the room that grows with the distance from it",
    "solid-body rotation of the air, F = k (-y, x)",
    pp.Force(law),
)

# %% [markdown]
# ## A recording with this effect
#
# A puck that slides without friction is pushed at random. The recording is simulated with a swirl
# of 0.8 N/m, which the scene does not declare, and with measurement noise. `pp.Transition` is the
# engine as a function of initial states and wrenches.

# %%
STRENGTH = 0.8
NOISE = np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])  # m, m, rad, m/s, m/s, rad/s
scene = pp.Scene(time_step=0.1, bodies=(pp.Body("puck", pp.Shape.circle(0.2)),))
truth = {"mass": 2.0, "r": 0.2, "mu_c": 0.3, "swirl_strength": STRENGTH}
world = pp.Transition(scene, truth, [swirl], substeps=40)


def recording(seed: int) -> pp.History:
    """Pushes from random starts, measured with noise."""
    rng = np.random.default_rng(seed)
    start = rng.normal(0.0, [1.0, 1.0, 1.5, 0.7, 0.7, 0.5], (TRAJECTORIES, 1, 6))
    wrenches = rng.normal(0.0, [2.0, 2.0, 0.05], (TRAJECTORIES, INTERVALS, 1, 3))
    states = np.concatenate([start[:, None], world.predict(start, wrenches)], axis=1)[:, :, 0]
    states = states + NOISE * rng.standard_normal(states.shape)
    # the last row of a trajectory has no wrench
    last = np.full((TRAJECTORIES, 1, 3), np.nan)
    table = np.concatenate([states, np.concatenate([wrenches[:, :, 0], last], axis=1)], axis=2)
    columns = ["x", "y", "theta", "vx", "vy", "omega", "force_x", "force_y", "torque"]
    rows = pd.DataFrame(table.reshape(-1, 9), columns=columns)
    rows["trajectory"] = np.repeat(np.arange(TRAJECTORIES), INTERVALS + 1)
    rows["time"] = np.tile(scene.time_step * np.arange(INTERVALS + 1), TRAJECTORIES)
    return pp.History.from_dataframe(rows.assign(body="puck"), scene)


train, test = recording(seed=1), recording(seed=2)

# %% [markdown]
# ## Without it
#
# With the package's catalogue the loop detects that something is missing, but no effect explains
# it: the verdict is `unexplained`.

# %%
without = pp.close_loop(scene, train, test, seed=1, method=METHOD)
print(without)
print("verdict:", without.verdict, "; added:", [added.effect for added in without.added])

# %% [markdown]
# ## With it
#
# The same, with the effect among the candidates.

# %%
loop = pp.close_loop(scene, train, test, catalogue=(*pp.catalogue, swirl), seed=1, method=METHOD)
print(loop)
for added in loop.added:
    for name, found in added.parameters.items():
        low, high = found.hdi
        print(
            f"{added.effect} {name}: {found.mean:.3f} {found.unit}, 94 % in {low:.3f} to {high:.3f}"
        )
print(f"simulated with {STRENGTH} N/m")

# %% [markdown]
# The candidates' score statistics: how strongly the residual resembles each effect's signature. The
# dashes mark the value that clean data exceed in 1 % of cases. Effects that would explain a part of
# it come next.

# %%
figure = plot_candidates(loop)
figure.savefig(OUT / "04_candidates.png", dpi=100)
figure

# %% [markdown]
# Forecast errors on the test recording fall to the noise floor:

# %%
errors = pd.DataFrame(
    {
        "declared": loop.before.rollout_rmse,
        "without swirl in the catalogue": without.after.rollout_rmse,
        "with it": loop.after.rollout_rmse,
        "noise floor": loop.noise_floor.rollout_rmse,
    }
)
errors.round(4)

# %% [markdown]
# A posterior file holds the effect's name, not its code. Functions that read it take your effect
# as an argument: `pp.plan(idata, ..., effects=(*pp.catalogue, swirl))`, and `pp.update` and
# `pp.identify` likewise.
