# %% [markdown]
# # The paper's figures
#
# Scholz, Levihn, Isbell and Wingate (ICML 2014) let four agents push a shopping cart to a goal
# behind a wall, without noise (their figure 4a) and with it (4b). This notebook draws both from
# ten episodes of each agent that are stored in `analysis/results`, and compares them with the
# paper. `python analysis/04_shopping_cart.py` runs the episodes.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())

# %% [markdown]
# Intervals are percentiles of the bootstrap over episodes.

# %% tags=["parameters"]
RESULTS = ROOT / "analysis" / "results"  # or the folder of a run of your own
RESAMPLES = 9999  # of the bootstrap
OUT = ROOT / "out" / "notebooks"

# %%
OUT.mkdir(parents=True, exist_ok=True)
AGENTS = {"true": "true model", "pbrl": "PBRL", "oolwr": "OO-LWR", "lwr": "LWR"}
COLORS = dict(zip(AGENTS, ("#0072B2", "#D55E00", "#009E73", "#CC79A7"), strict=True))
runs = {}
for panel in ("a", "b"):
    with xr.open_dataset(RESULTS / f"figure_4{panel}.nc", engine="h5netcdf") as opened:
        runs[panel] = opened.load()
    print(f"4({panel}): {runs[panel].attrs['command']}; {runs[panel].attrs['versions']}")


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over episodes, the first axis, and the ends of its 95 % interval."""
    found = stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, method="percentile",
        rng=np.random.default_rng(1),
    )  # fmt: skip
    return values.mean(axis=0), *found.confidence_interval


# %% [markdown]
# The agents know the room, the cart's outline and the goal. Only the first knows the dynamics:
#
# - the *true model* plans with the parameters of the world;
# - *PBRL* has the physics engine as its prior, and the posterior given its observations so far;
# - *OO-LWR* has a locally weighted regression for each condition: which sides of the cart are in
#   contact;
# - *LWR* has one regression for all conditions.
#
# All plan with the same A\*, and act at random if they have no plan.
#
# ## Figures 4(a) and 4(b)
#
# The reward of a step is minus the distance from the goal. Lines are means over ten episodes,
# bands their 95 % intervals; a cart that has arrived, within 0.2 m, stays there. First it moves
# away from the goal, round the wall.

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
for axis, (panel, run) in zip(axes, runs.items(), strict=True):
    for agent, label in AGENTS.items():
        rewards = run["reward"].sel(agent=agent).transpose("seed", "time").to_numpy()
        mean, low, high = interval(rewards)
        axis.plot(mean, color=COLORS[agent], label=label)
        axis.fill_between(
            np.arange(len(mean)), low, high, color=COLORS[agent], alpha=0.2, linewidth=0
        )
    sigma = float(run.attrs["sigma"])
    title = f"4({panel}) " + (f"noise of {sigma:g}" if sigma else "without noise")
    axis.set_title(title, loc="left", fontsize=10)
    axis.set_xlabel("steps of 0.25 s")
axes[0].set_ylabel("reward: minus the distance to the goal (m)")
axes[1].legend(frameon=False, loc="lower right")
figure.savefig(OUT / "06_figure_4ab.png", dpi=100)

# %% [markdown]
# In numbers:


# %%
def table(run: xr.Dataset) -> pd.DataFrame:
    """One row an agent."""
    rows = []
    for agent, label in AGENTS.items():
        own = run.sel(agent=agent)
        reached = own["reached"].to_numpy() > 0
        steps = own["seconds"].notnull().sum("step").to_numpy()
        total, low, high = interval(own["reward"].sum("time").to_numpy())
        rows.append(
            {
                "agent": label,
                "reached the goal": int(reached.sum()),
                "steps, median of those": float(np.median(steps[reached])),
                "steps with bumps, mean": float(own["bumped"].sum("step").mean()),
                "sum of rewards (m)": float(total),
                "95 % from": float(low),
                "to": float(high),
            }
        )
    return pd.DataFrame(rows).set_index("agent")


tables = {panel: table(run) for panel, run in runs.items()}
tables["a"].round(1)

# %%
tables["b"].round(1)

# %% [markdown]
# ## PBRL's estimates
#
# Each line is the estimate (the mode) of one of the ten episodes, the dashes are the truth. The
# paper says that PBRL recovers the true model after two steps. Without noise the mass, the wheel's
# position and the friction along it are right after two or three. The friction across it, `mu_y`,
# takes longer, in 9 of 10 episodes 7 to 10 steps: before its wheel slides sideways, no data inform
# it.

# %%
# as of models/shopping_cart/task.py
TRUTH = {"mass": 8.0, "w_x": -0.25, "mu_x": 0.04, "mu_y": 0.45}
UNITS = {"mass": "mass (kg)", "w_x": "wheel's place (m)", "mu_x": "friction along the wheel",
         "mu_y": "friction across the wheel"}  # fmt: skip
figure, axes = plt.subplots(2, 4, figsize=(11, 5), sharex=True, sharey="col", layout="constrained")
for row, run in zip(axes, runs.values(), strict=True):
    learned = run["estimate"].sel(agent="pbrl")
    for axis, (name, value) in zip(row, TRUTH.items(), strict=True):
        axis.plot(
            learned["step"], learned.sel(parameter=f"{name}[cart]").transpose("step", "seed"),
            color=COLORS["pbrl"], linewidth=0.8,
        )  # fmt: skip
        axis.axhline(value, color="black", linestyle="--", linewidth=1)
        axis.set(xlim=(0, 25))
for axis, name in zip(axes[0], UNITS.values(), strict=True):
    axis.set_title(name, fontsize=10)
axes[0, 0].set(yscale="log", ylabel="without noise")
axes[1, 0].set(yscale="log", ylabel="with noise")
figure.supxlabel("steps", fontsize=10)
figure.savefig(OUT / "06_learned.png", dpi=100)

# %%
after_two = runs["a"]["estimate"].sel(agent="pbrl", step=2)
right = [
    np.abs(after_two.sel(parameter=f"{name}[cart]") / TRUTH[name] - 1) <= 0.03
    for name in ("mass", "w_x", "mu_x")
]
right_after_two = int(np.logical_and.reduce(right).sum())
print(f"mass, w_x and mu_x within 3 % after two steps: {right_after_two} of 10 episodes")
across = runs["a"]["estimate"].sel(agent="pbrl", parameter="mu_y[cart]")
known = np.abs(across / TRUTH["mu_y"] - 1) <= 0.03
first = known.idxmax("step").where(known.any("step"))
print("mu_y as well, from step:", first.to_series().to_dict())

# %% [markdown]
# ## Bumps
#
# The paper says that OO-LWR tends to bump into walls. Here this holds only with noise. Without it
# OO-LWR keeps away from walls, because it plans through no condition that it has not seen; PBRL
# slides along them, which costs nothing in this task.

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
for axis, (panel, run) in zip(axes, runs.items(), strict=True):
    for agent, label in AGENTS.items():
        bumps = run["bumped"].sel(agent=agent).fillna(0).cumsum("step").mean("seed")
        axis.plot(run["step"], bumps, color=COLORS[agent], label=label)
    axis.set_title(f"4({panel})", loc="left", fontsize=10)
    axis.set_xlabel("steps")
axes[0].set_ylabel("steps with bumps so far, mean")
axes[0].legend(frameon=False)
figure.savefig(OUT / "06_bumps.png", dpi=100)

# %% [markdown]
# ## Agreement with the paper
#
# | the paper says | here |
# |---|---|
# | PBRL recovers the true model after two steps | yes, in what two steps show |
# | it does nearly as well as the true model | yes: all arrive, four steps later |
# | OO-LWR is slower, and reaches the goal too | in part: 7 of 10 in twice PBRL's steps |
# | OO-LWR tends to bump into walls | no without noise, yes with it |
# | LWR stays before the wall | mostly: 4 of 10 slide round its end by chance |
# | with noise the same order, learning more gradual | in part: OO-LWR does no better than LWR |
#
# The paper prints no sizes, masses, forces or goals, so those of `models/shopping_cart` are ours,
# and numbers need not agree. Ten episodes leave the intervals above. Agents and world are the
# same engine here, so that PBRL's model can be exactly right; `04_shopping_cart.py --box2d` has
# the world in another. `analysis/paper.md` has all experiments, figure 4(c) included.
